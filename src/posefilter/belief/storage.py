"""A belief's file: arrays in an .npz, without pickle, whole or not there."""

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from posefilter.errors import UserError, find_reason
from posefilter.files import open_whole
from posefilter.limits import MOST_BYTES


def write_arrays(path: str | Path, poses: np.ndarray, weights: np.ndarray, **others: Any) -> None:
    """Write poses (N, 4, 4) and weights (N,) in float32, and others as they are.

    Raises:
        UserError: The file cannot be written.
    """
    file = _name_file(path, "write")
    poses, weights = poses.astype(np.float32), weights.astype(np.float32)
    with open_whole(file, sync=False) as stream:
        np.savez_compressed(stream, poses=poses, weights=weights, **others)


def _name_file(path: str | Path, to: str) -> Path:
    """Return the file of a belief: its path, or that with the ending."""
    if not isinstance(path, str | os.PathLike):
        raise UserError(f"{path!r}: expected the path of a belief's file")
    file = Path(path)
    if file.is_dir():  # the file would be beside it
        raise UserError(f"{path}: is a folder; name the file to {to}")
    return file if file.suffix == ".npz" else file.with_name(f"{file.name}.npz")


def read_arrays(path: str | Path) -> dict[str, Any]:
    """Return what `write_arrays` wrote, as the arguments of `Belief`.

    Raises:
        UserError: The file is missing, or holds no belief.
    """
    named = _name_file(path, "read")
    file = Path(path) if Path(path).is_file() else named
    if not file.is_file():
        raise UserError(f"{path}: no such file")
    try:
        with zipfile.ZipFile(file) as archive:
            if sum(part.file_size for part in archive.infolist()) > MOST_BYTES:
                raise UserError(f"{path}: is larger than a belief can be")
        with np.load(file, allow_pickle=False) as stored:
            read: dict[str, Any] = {name: stored[name] for name in stored.files}
        if "center" not in read and "im_id" in read:
            raise UserError(
                f"{path}: holds the beliefs of many images, as evaluate.py writes them; read its "
                "arrays by numpy.load (Belief.save writes one with what its methods need)"
            )
        weights = read["weights"].astype(np.float64)
        poses = np.ascontiguousarray(read["poses"], dtype=np.float64)
        if weights.ndim != 1 or poses.shape != (len(weights), 4, 4):
            raise ValueError(f"weights {weights.shape} of poses {poses.shape}")
        if not (np.isfinite(poses).all() and (weights >= 0).all() and 0 < weights.sum() < np.inf):
            raise ValueError("poses that are not finite, or weights that are none")
        return {
            "samples": poses,
            "weights": weights / weights.sum(),
            "center": read["center"].astype(np.float64).reshape(3),
            "radius": float(read["radius"]),
            "diameter": float(read["diameter"]),
            "object": str(read["object"]),
            # of later files alone
            "symmetries": np.array(read.get("symmetries", np.eye(4)[None]), dtype=np.float64),
            "draws": int(read.get("draws", 0)),
        }
    except UserError:
        raise
    # a damaged archive, a header that lies of its array: their readers raise anything
    except Exception as error:
        reason = find_reason(error)
        raise UserError(f"{path}: holds no belief as posefilter writes it ({reason})") from error
