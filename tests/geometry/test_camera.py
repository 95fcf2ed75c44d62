"""Cameras: projecting and lifting undo each other, and images may be resized and cropped."""

import cv2
import numpy as np
import torch
from torch import Generator

from posefilter.geometry.camera import (
    back_project,
    intrinsics,
    pixel_grid,
    project,
    rays,
    resize_intrinsics,
)

K = intrinsics(500.0, 480.0, 320.5, 238.0)


def scattered(*shape: int) -> torch.Tensor:
    g = Generator().manual_seed(0)
    return torch.rand(*shape, 3, generator=g, dtype=torch.float64) * torch.tensor(
        [2.0, 2.0, 1.5]
    ) + torch.tensor([-1.0, -1.0, 0.3])


def test_projecting_then_lifting_is_the_identity() -> None:
    for shape in [(9,), (2, 9), (3, 1, 9)]:
        points = scattered(*shape)
        camera = K.double().expand(*shape[:-1], 3, 3)
        pixels = project(points, camera)
        torch.testing.assert_close(back_project(pixels, points[..., 2], camera), points)
        # depth along a ray moves no pixel
        again = project(back_project(pixels, points[..., 2] * 2, camera), camera)
        torch.testing.assert_close(again, pixels)
        shifted = back_project(pixels + 0.5, points[..., 2], camera)  # the classic half pixel
        assert (shifted - points).abs().max() > 1e-4


def test_projection_is_opencvs() -> None:
    points = scattered(50)
    found, _ = cv2.projectPoints(points.numpy(), np.zeros(3), np.zeros(3), K.double().numpy(), None)
    np.testing.assert_allclose(project(points, K.double()), found[:, 0], atol=1e-9)


def test_points_behind_the_camera_stay_finite() -> None:
    assert project(torch.tensor([[0.1, 0.2, 0.0], [0.1, 0.2, -1.0]]), K).isfinite().all()


def test_the_middle_ray_looks_ahead() -> None:
    torch.testing.assert_close(
        rays(torch.tensor([[320.5, 238.0]]), K), torch.tensor([[0.0, 0.0, 1.0]])
    )


def test_resizing_moves_pixels_as_it_moves_the_image() -> None:
    points = scattered(40).float()
    pixels = project(points, K)
    small = project(points, resize_intrinsics(K, 0.5, 0.25))
    # A pixel's outer edges, half a pixel out, scale with the image.
    torch.testing.assert_close(
        small + 0.5, (pixels + 0.5) * torch.tensor([0.5, 0.25]), atol=1e-4, rtol=0
    )


def test_the_grid_lies_on_the_cells_centers() -> None:
    grid = pixel_grid(8, 12, 4)
    assert grid.shape == (2, 3, 2)
    assert grid[1, 2].tolist() == [9.5, 5.5]
    assert pixel_grid(3, 2)[2, 1].tolist() == [1.0, 2.0]


def test_gradients() -> None:
    points = scattered(6).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: project(p, K.double()), points)
    pixels, depth = (
        project(points, K.double()).detach().requires_grad_(),
        points[:, 2].detach().requires_grad_(),
    )
    assert torch.autograd.gradcheck(lambda u, z: back_project(u, z, K.double()), (pixels, depth))
