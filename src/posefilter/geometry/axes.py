"""The axes that an object can be mistaken about: those of its smallest oriented box."""

import numpy as np
import torch
import trimesh
from torch import Tensor


def box_axes(points: Tensor) -> Tensor:
    """Return the axes of the smallest oriented box around points, the shortest side first.

    A mesh's own axes say little: YCB's gelatin box lies 13 degrees askew in its frame. Axes of
    equal sides, such as a can's, are any pair across the third.

    Args:
        points: (P, 3), not all in one plane.

    Returns:
        Unit vectors as columns, (3, 3).
    """
    to_box, _ = trimesh.bounds.oriented_bounds(points.double().cpu().numpy())
    axes = np.linalg.inv(to_box)[:3, :3]
    return torch.from_numpy(axes).to(points)
