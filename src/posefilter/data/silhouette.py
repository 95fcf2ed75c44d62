"""What a mesh says of a mask: which share of the object is seen, and which pixel belongs to which
of two instances.
"""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from posefilter.data.frames import Sample
from posefilter.geometry.rigid import move
from posefilter.meshes.store import Mesh, MeshStore
from posefilter.rendering.embree import EmbreeRenderer, render_depth


@dataclass(eq=False)
class Geometry:
    """Render the objects of a mesh store; safe to call from threads, and to send to other
    processes.
    """

    meshes: MeshStore
    without: set[str] = field(default_factory=set)  # classes whose mesh does not fit the dataset
    _local: Any = field(default_factory=threading.local, repr=False)

    def mesh(self, name: str) -> Mesh | None:
        """Return a class's mesh, None where there is none that fits."""
        fits = self.meshes.has(name) and name not in self.without
        return self.meshes.load(name) if fits else None

    def render(
        self,
        meshes: Sequence[Mesh],
        poses: Sequence[np.ndarray],
        K: np.ndarray,
        shape: tuple[int, int],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (H, W) [m] and the index of the mesh seen (H, W), -1 for none."""
        if not hasattr(self._local, "renderer"):
            self._local.renderer = EmbreeRenderer()
        return render_depth(meshes, poses, K, *shape, renderer=self._local.renderer)

    def visible_share(self, name: str, sample: Sample) -> float:
        """Return mask pixels over those that the object would have alone in an image without
        edges; NaN without a mesh.

        This is BOP's visible fraction: what the frame cuts off is not visible. As there, such an
        image is at most three times as wide and high as the frame.
        """
        mesh = self.mesh(name)
        if mesh is None:
            return float("nan")
        pose = sample.camera_from_object
        before, after = _margins(mesh.vertices, pose, sample.intrinsics, sample.mask.shape)
        K = sample.intrinsics.copy()
        K[:2, 2] += before[::-1]
        height, width = (int(side) for side in np.add(sample.mask.shape, before) + after)
        _, index = self.render([mesh], [pose], K, (height, width))
        alone = int((index == 0).sum())
        return min(float(sample.mask.sum()) / alone, 1.0) if alone else float("nan")

    def instances(
        self, name: str, poses: Sequence[np.ndarray], K: np.ndarray, mask: np.ndarray
    ) -> list[np.ndarray] | None:
        """Split the mask of one class into its instances': each pixel to the instance rendered
        there, or nearest.

        Returns None without a mesh.
        """
        mesh = self.mesh(name)
        if mesh is None:
            return None
        _, index = self.render([mesh] * len(poses), poses, K, (mask.shape[0], mask.shape[1]))
        nowhere = np.full(mask.shape, np.float32(mask.size))
        seen = [(index == k) for k in range(len(poses))]
        reach = [
            cv2.distanceTransform(1 - s.astype(np.uint8), cv2.DIST_L2, 5) if s.any() else nowhere
            for s in seen
        ]
        owner = np.argmin(np.stack(reach), axis=0)
        return [mask & (owner == k) for k in range(len(poses))]

    def __getstate__(self) -> dict[str, Any]:
        """Leave the renderer behind: it belongs to one process and thread."""
        return {"meshes": self.meshes, "without": self.without}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start with no renderer."""
        self.__dict__.update(state, _local=threading.local())


def _margins(
    vertices: np.ndarray, pose: np.ndarray, K: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return by how many rows and columns a frame must grow to hold a whole object: before the
    first and after the last, (2,) int each, none more than the frame has.

    Where the object reaches behind the camera, its image has no end, and the frame grows as far as
    it may.
    """
    size = np.array(shape)
    points = move(vertices, pose)
    if (points[:, 2] <= 0).any():
        return size, size
    pixels = (points[:, :2] / points[:, 2:]) @ K[:2, :2].T + K[:2, 2]
    rows = pixels[:, ::-1]
    before = np.ceil(-rows.min(0)).clip(0, size).astype(int)
    after = np.ceil(rows.max(0) - (size - 1)).clip(0, size).astype(int)
    return before, after
