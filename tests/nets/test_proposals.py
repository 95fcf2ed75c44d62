"""The proposal network's inputs and votes against truth that is known exactly."""

import pytest
import torch
from torch import Tensor

from posefilter.geometry.camera import intrinsics, pixel_grid, rays
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.nets.proposals import (
    STRIDE,
    Cells,
    Coordinates,
    ObjectCoordinateNet,
    coordinate_loss,
    draw_poses,
    masked_mean_pool,
    measure_cells,
    normals_from_depth,
)

H, W = 64, 96
K = intrinsics(120.0, 130.0, 47.0, 30.0)[None]
CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03]), 0.15


def plane(normal: Tensor, distance: float) -> Tensor:
    """Return the z-depth (1, 1, H, W) of the plane normal . x = -distance (the normal faces the camera)."""
    view = rays(pixel_grid(H, W).reshape(1, -1, 2), K)
    return (-distance / (view @ normal)).reshape(1, 1, H, W)


def test_normals_of_a_plane_are_its_normal() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -0.9]), dim=0)
    got = normals_from_depth(plane(normal, 0.8), K)
    assert got.shape == (1, 3, H // 2, W // 2)
    inner = got[0, :, 2:-2, 2:-2].flatten(1)
    assert (inner - normal[:, None]).abs().max() < 2e-3


def test_normals_are_zero_where_depth_is_missing() -> None:
    depth = plane(torch.tensor([0.0, 0.0, -1.0]), 1.0)
    depth[..., 20:30, 40:60] = 0
    got = normals_from_depth(depth, K)
    assert got[0, :, 11:14, 21:29].abs().max() == 0
    assert (got[0, :, 20:28, 5:15].norm(dim=0) - 1).abs().max() < 1e-4


def test_masked_mean_ignores_unknown_pixels() -> None:
    depth = torch.tensor([[1.0, 0.0], [3.0, 2.0]])[None, None]
    mean, share = masked_mean_pool(depth, 2)
    assert mean.item() == pytest.approx(2.0)
    assert share.item() == pytest.approx(0.75)


def test_cells_lie_on_the_surface_and_skip_holes() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -0.9]), dim=0)
    depth = plane(normal, 0.8)
    middle = STRIDE // 2
    depth[..., middle - 1, middle - 1] = 0  # the first choice of cell (0, 0): the next one must serve
    depth[..., STRIDE : 2 * STRIDE, :STRIDE] = 0
    cells = measure_cells(depth, K)
    assert cells.point.shape == (1, H // STRIDE, W // STRIDE, 3)
    assert not cells.valid[0, 1, 0]
    assert cells.valid.sum() == cells.valid.numel() - 1
    assert (cells.point[cells.valid] @ normal + 0.8).abs().max() < 1e-5


def world(noise: float = 0.0) -> tuple[Coordinates, Cells, Tensor]:
    """Return what a perfect network says of cells on an object at a known pose, with Gaussian noise of so many radii."""
    g = torch.Generator().manual_seed(0)
    h, w = 6, 8
    pose = make_pose(exp_so3(torch.tensor([0.4, -0.7, 0.2])), torch.tensor([0.1, 0.05, 0.9]))[None]
    thing = (torch.rand(1, h, w, 3, generator=g) * 2 - 1) * 0.6
    point = (thing * RADIUS + CENTER) @ pose[0, :3, :3].T + pose[0, :3, 3]
    logit = torch.full((1, h, w), 6.0)
    logit[:, :, : w // 2] = -12.0  # background, whose coordinates are nonsense
    said = torch.where(logit[..., None] > 0, thing + noise * torch.randn(thing.shape, generator=g), torch.zeros(3))
    return Coordinates(logit, said, torch.full((1, h, w), -4.0)), Cells(point, torch.ones(1, h, w, dtype=torch.bool)), pose


def test_perfect_votes_give_the_pose() -> None:
    said, cells, pose = world()
    got = draw_poses(said, cells, CENTER, RADIUS, 200, torch.Generator().manual_seed(1))
    good = angle_between(got[:, :, :3, :3], pose[:, None, :3, :3])[0] < 0.02
    near = (got[0, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1) < 3e-3
    assert (good & near).float().mean() > 0.95  # the rest drew background, or nearly collinear points


def test_noisy_votes_scatter_round_the_pose() -> None:
    said, cells, pose = world(noise=0.03)
    got = draw_poses(said, cells, CENTER, RADIUS, 500, torch.Generator().manual_seed(1))
    shift = (got[0, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1)
    assert 1e-3 < shift.median() < 0.03


def test_an_image_without_depth_does_not_disturb_the_others() -> None:
    said, cells, pose = world()
    both = Coordinates(*(torch.cat([x, x]) for x in said))
    blind = Cells(torch.cat([torch.zeros_like(cells.point), cells.point]), torch.cat([~cells.valid, cells.valid]))
    got = draw_poses(both, blind, CENTER, RADIUS, 50, torch.Generator().manual_seed(1))
    assert torch.isfinite(got).all()
    assert ((got[1, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1) < 3e-3).float().mean() > 0.9


def test_the_loss_is_least_for_the_truth() -> None:
    said, cells, pose = world()
    mask = (said.logit > 0)[:, None].float()
    mask = torch.nn.functional.interpolate(mask, scale_factor=STRIDE) > 0.5
    right, error = coordinate_loss(said, cells, mask, pose, CENTER, RADIUS)
    assert error.item() < 1e-6
    wrong, wrong_error = coordinate_loss(said._replace(coordinate=said.coordinate + 0.1), cells, mask, pose, CENTER, RADIUS)
    assert wrong_error.item() == pytest.approx(0.1 * 3**0.5 * RADIUS, rel=1e-4)
    flipped, _ = coordinate_loss(said._replace(logit=-said.logit), cells, mask, pose, CENTER, RADIUS)
    assert right < wrong
    assert right < flipped


def test_the_network_learns_coordinates_of_a_toy() -> None:
    from tests.models.toy import scenes, square

    torch.manual_seed(0)
    net, model = ObjectCoordinateNet((16, 24, 32, 32)), square()
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    errors = []
    for step in range(60):
        batch = scenes(8, seed=step)
        said = net(batch.rgb, batch.depth, batch.intrinsics)
        cells = measure_cells(batch.depth, batch.intrinsics)
        loss, error = coordinate_loss(said, cells, batch.mask, batch.camera_from_object, model.center, model.radius)
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
        errors.append(error.mean().item())
    assert sum(errors[-5:]) / 5 < 0.5 * errors[0]
