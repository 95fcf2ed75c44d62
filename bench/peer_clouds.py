"""Images and models as the peers' programs are given them: files of NumPy, and clouds of them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

FAR = 2.0  # [m]; nothing of the benchmarks' objects is beyond


class Frame(NamedTuple):
    """An image of a depth camera."""

    depth: np.ndarray  # (H, W) [m], 0 where unknown
    mask: np.ndarray  # (H, W) bool, the object's visible part
    intrinsics: np.ndarray  # (3, 3) [px]


def write_frame(path: Path, frame: Frame, **more: np.ndarray) -> None:
    """Write an image, and what else is to be in its file."""
    np.savez(path, **frame._asdict(), **more)


def read_frame(path: str) -> Frame:
    """Read an image."""
    with np.load(path) as data:
        return Frame(data["depth"], data["mask"], data["intrinsics"])


def write_model(path: Path, points: np.ndarray, normals: np.ndarray) -> None:
    """Write a model's surface points (N, 3) [m] and their outward normals (N, 3)."""
    np.savez(path, points=points, normals=normals)


def read_model(path: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) [m] and normals (N, 3)."""
    with np.load(path) as data:
        return data["points"], data["normals"]


def back_project(frame: Frame, masked: bool) -> np.ndarray:
    """Return the points that the camera measured up to `FAR`, (N, 3) [m]; of the mask alone if it
    is told.
    """
    known = (frame.depth > 0) & (frame.depth < FAR)
    if masked:
        known &= frame.mask
    row, column = np.nonzero(known)
    z = frame.depth[row, column].astype(float)
    K = frame.intrinsics
    x = (column - K[0, 2]) / K[0, 0] * z
    y = (row - K[1, 2]) / K[1, 1] * z
    return np.stack([x, y, z], axis=1)


def thin(points: np.ndarray, voxel: float) -> np.ndarray:
    """Return the mean point of each voxel.  (N, 3) [m], side [m] -> (M, 3) [m]."""
    cell = np.floor((points - points.min(0)) / voxel).astype(np.int64)
    size = cell.max(0) + 1
    _, index, count = np.unique(
        (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2],
        return_inverse=True,
        return_counts=True,
    )
    sums = [np.bincount(index, points[:, axis]) for axis in range(3)]
    return np.stack(sums, axis=1) / count[:, None]
