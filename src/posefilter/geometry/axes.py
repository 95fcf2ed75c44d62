"""The axes that an object can be mistaken about: those of its smallest oriented box."""

import numpy as np
import torch
import trimesh
from torch import Tensor

_FLAT = 1e-4  # thickness of what counts as flat, over its width


def box_axes(points: Tensor) -> Tensor:
    """Return the axes of the smallest oriented box around points, the shortest side first.

    A mesh's own axes say little: YCB's gelatin box lies 13 degrees askew in its frame. Of equal
    sides, such as a can's two across, the axes are arbitrary.

    Args:
        points: (P, 3), not all on one line.

    Returns:
        Unit vectors as columns, (3, 3).
    """
    values = points.double().cpu().numpy()
    centered = values - values.mean(0)
    _, size, directions = np.linalg.svd(centered, full_matrices=False)
    if size[2] > _FLAT * size[0]:
        to_box, _ = trimesh.bounds.oriented_bounds(values)
        axes = to_box[:3, :3].T
    else:  # a sheet has no hull in 3-D; its own plane has
        to_box, sides = trimesh.bounds.oriented_bounds_2D(centered @ directions[:2].T)
        inside = to_box[:2, :2] @ directions[:2]
        axes = np.stack([directions[2], *inside[np.argsort(sides)]], axis=1)
    return torch.from_numpy(np.ascontiguousarray(axes)).to(points)
