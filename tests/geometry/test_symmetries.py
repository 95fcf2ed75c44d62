"""Of the poses that symmetries make of one another, the nearest is found."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from posefilter.geometry.pose import make_pose, move_about, origin_of, rotation_of
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.geometry.symmetries import densify, gather_copies
from posefilter.meshes.symmetries import symmetry_group

CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64), 0.1


def turns(count: int) -> Tensor:
    """Return turns about an axis that misses the center."""
    angle = torch.arange(count, dtype=torch.float64)[:, None] * 2 * math.pi / count
    rotation = exp_so3(angle * torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64))
    point = torch.tensor([0.03, 0.0, 0.0], dtype=torch.float64)
    return make_pose(rotation, point - rotation @ point)


@pytest.mark.parametrize("count", [1, 2, 4, 36])
@pytest.mark.parametrize("noise", [0.05, 2.0])
def test_a_copy_is_the_nearest_of_all_that_symmetries_make(count: int, noise: float) -> None:
    generator = torch.Generator().manual_seed(count)
    group = densify(turns(count))
    about = make_pose(random_rotation(generator=generator).double(), CENTER + 0.5)
    twist = noise * torch.randn((50, 6), generator=generator, dtype=torch.float64)
    which = torch.randint(len(group), (50,), generator=generator)
    poses = move_about(about, twist, CENTER) @ group[which]
    found = gather_copies(poses, about, CENTER, RADIUS, group)
    copies = poses[:, None] @ group
    unit = torch.tensor([1.0] * 3 + [RADIUS] * 3, dtype=torch.float64)
    length = (twist_between(about, copies, CENTER) * unit).norm(dim=-1)
    nearest = copies[torch.arange(50), length.argmin(1)]
    assert torch.allclose(found, nearest, rtol=0, atol=1e-12)


def test_of_a_ball_the_copy_is_turned_as_the_pose_that_it_is_compared_to() -> None:
    lines = [
        (np.array([1.0, 0, 0]), np.array([0.3, 0.05, 0.02])),
        (np.array([0.0, 0.8, 0.6]), np.array([0.1, 0.13, 0.08])),
    ]
    group = torch.from_numpy(symmetry_group(continuous=lines, steps=36))
    middle = torch.tensor([0.1, 0.05, 0.02], dtype=torch.float64)  # of the ball
    about = make_pose(random_rotation().double(), torch.tensor([0.0, 0.0, 1.0]).double())
    poses = make_pose(random_rotation(20).double(), torch.randn(20, 3).double())
    found = gather_copies(poses, about, CENTER, RADIUS, group)
    assert torch.allclose(rotation_of(found), rotation_of(about).expand(20, 3, 3))
    assert torch.allclose(origin_of(found, middle), origin_of(poses, middle), atol=1e-9)
