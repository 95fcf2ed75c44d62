"""The axes of an object's smallest box."""

import torch

from posefilter.geometry.axes import box_axes
from posefilter.geometry.rotation import random_rotation


def test_axes_of_a_box_that_lies_askew() -> None:
    generator = torch.Generator().manual_seed(0)
    sides = torch.tensor([0.03, 0.07, 0.09])
    points = (torch.rand(2000, 3, generator=generator) - 0.5) * sides
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * sides
    for _ in range(5):
        R = random_rotation(1, generator=generator)[0]
        axes = box_axes(torch.cat([points, corners]) @ R.T)
        # the same axes, but for their signs, the shortest side first
        torch.testing.assert_close((R.T @ axes).abs(), torch.eye(3), atol=1e-3, rtol=0)


def test_axes_of_a_sheet() -> None:
    generator = torch.Generator().manual_seed(1)
    points = torch.rand(500, 3, generator=generator) * torch.tensor([0.2, 0.0, 0.1])
    corners = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3) * torch.tensor([0.2, 0, 0.1])
    R = random_rotation(1, generator=generator)[0]
    axes = box_axes(torch.cat([points, corners]) @ R.T)
    expected = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close((R.T @ axes).abs(), expected, atol=1e-3, rtol=0)
