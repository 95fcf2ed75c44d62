"""The proposal network's inputs and votes against truth that is known exactly."""

import pytest
import torch
from torch import Tensor

from posefilter.geometry.camera import intrinsics, pixel_grid, rays
from posefilter.geometry.fragments import nearest_fragment, sample_farthest_points
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.nets.coordinates import (
    STRIDE,
    Cells,
    Coordinates,
    coordinate_loss,
    true_coordinates,
)
from posefilter.nets.encoding import masked_mean_pool, normals_from_depth
from posefilter.nets.pose_votes import draw_poses, measure_cells
from posefilter.nets.proposals import ObjectCoordinateNet

H, W = 64, 96
# of eight fragments
MIDDLES = torch.tensor([[x, y, z] for x in (-0.4, 0.4) for y in (-0.4, 0.4) for z in (-0.4, 0.4)])
K = intrinsics(120.0, 130.0, 47.0, 30.0)[None]
CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03]), 0.15


def plane(normal: Tensor, distance: float) -> Tensor:
    """Return the z-depth (1, 1, H, W) of the plane normal . x = -distance (the normal faces the
    camera).
    """
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
    # the first choice of cell (0, 0): the next one must serve
    depth[..., middle - 1, middle - 1] = 0
    depth[..., STRIDE : 2 * STRIDE, :STRIDE] = 0
    cells = measure_cells(depth, K)
    assert cells.point.shape == (1, H // STRIDE, W // STRIDE, 3)
    assert not cells.valid[0, 1, 0]
    assert cells.valid.sum() == cells.valid.numel() - 1
    assert (cells.point[cells.valid] @ normal + 0.8).abs().max() < 1e-5


def test_a_cell_on_the_object_is_lifted_from_a_pixel_on_the_object() -> None:
    """Wherever the object's rim lies in a cell: what lies behind it is no point of the object."""
    for shift in range(STRIDE):
        mask = torch.zeros(1, 1, H, W, dtype=torch.bool)
        mask[..., shift:24, shift:24] = True
        cells = measure_cells(torch.where(mask, 0.8, 0.85), K)
        pose = make_pose(torch.eye(3), torch.tensor([0.0, 0.0, 0.8]))[None]
        _, on, usable = true_coordinates(cells, mask, pose, torch.zeros(3), 1.0)
        assert on.any()
        assert torch.equal(on, usable)
        assert (cells.point[on][:, 2] - 0.8).abs().max() < 1e-6


def test_a_hole_at_the_rim_is_not_filled_with_what_lies_beside_the_object() -> None:
    mask = torch.zeros(1, 1, H, W, dtype=torch.bool)
    mask[..., :12, :12] = True  # of cell (1, 1) one central pixel
    depth = torch.where(mask, 0.8, 0.85)
    depth[..., 11, 11] = 0
    cells = measure_cells(depth, K)
    assert cells.pixel[0, 1, 1].tolist() == [12, 12]
    pose = make_pose(torch.eye(3), torch.tensor([0.0, 0.0, 0.8]))[None]
    _, on, usable = true_coordinates(cells, mask, pose, torch.zeros(3), 1.0)
    assert (on & ~usable)[0].nonzero().tolist() == [[1, 1]]


def world(noise: float = 0.0, doubt: float = 0.0) -> tuple[Coordinates, Cells, Tensor]:
    """Return what a network says of cells on an object at a known pose, with Gaussian noise of so
    many radii.

    doubt: the share it gives to the point turned half round the object's z axis, as of two faces
    that look alike.
    """
    g = torch.Generator().manual_seed(0)
    h, w = 6, 8
    pose = make_pose(exp_so3(torch.tensor([0.4, -0.7, 0.2])), torch.tensor([0.1, 0.05, 0.9]))[None]
    thing = (torch.rand(1, h, w, 3, generator=g) * 2 - 1) * 0.6
    point = (thing * RADIUS + CENTER) @ pose[0, :3, :3].T + pose[0, :3, 3]
    logit = torch.full((1, h, w), 6.0)
    logit[:, :, : w // 2] = -12.0  # background, whose coordinates are nonsense
    said = torch.where(
        logit[..., None] > 0, thing + noise * torch.randn(thing.shape, generator=g), torch.zeros(3)
    )
    turned = said * torch.tensor([-1.0, -1.0, 1.0])
    right, wrong = nearest_fragment(said, MIDDLES[None]), nearest_fragment(turned, MIDDLES[None])
    share = torch.full((1, h, w, 8), 1e-6)
    share.scatter_(-1, wrong[..., None], max(doubt, 1e-6)).scatter_(-1, right[..., None], 1 - doubt)
    place = MIDDLES.expand(1, h, w, 8, 3).clone()
    for fragment, where in ((wrong, turned), (right, said)):
        place.scatter_(3, fragment[..., None, None].expand(1, h, w, 1, 3), where[..., None, :])
    valid = torch.ones(1, h, w, dtype=torch.bool)
    return (
        Coordinates(logit, share.log(), place, MIDDLES[None], torch.zeros(1, h, w, 0)),
        Cells(point, valid, measure_cells(torch.zeros(1, 1, h * STRIDE, w * STRIDE), K).pixel),
        pose,
    )


def test_perfect_votes_give_the_pose() -> None:
    said, cells, pose = world()
    got = draw_poses(said, cells, CENTER, RADIUS, 200, torch.Generator().manual_seed(1))
    good = angle_between(got[:, :, :3, :3], pose[:, None, :3, :3])[0] < 0.02
    near = (got[0, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1) < 3e-3
    # the rest drew background, or nearly collinear points
    assert (good & near).float().mean() > 0.95


def test_noisy_votes_scatter_round_the_pose() -> None:
    said, cells, pose = world(noise=0.03)
    got = draw_poses(said, cells, CENTER, RADIUS, 500, torch.Generator().manual_seed(1))
    shift = (got[0, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1)
    assert 1e-3 < shift.median() < 0.03


def test_votes_in_doubt_agree_with_each_other() -> None:
    """Of two poses that the cells cannot tell apart, each draw holds one, not a mixture."""
    said, cells, pose = world(doubt=0.4)
    got = draw_poses(said, cells, CENTER, RADIUS, 400, torch.Generator().manual_seed(1))
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))
    right = angle_between(got[:, :, :3, :3], pose[:, None, :3, :3])[0] < 0.05
    turned = angle_between(got[:, :, :3, :3], pose[:, None, :3, :3] @ half_turn)[0] < 0.05
    assert right.float().mean() > 0.3  # four votes agree by chance in 0.6^4 = 0.13 of the draws
    assert turned.float().mean() > 0.15
    assert (right | turned).float().mean() > 0.45


def test_an_image_without_depth_does_not_disturb_the_others() -> None:
    said, cells, pose = world()
    both = Coordinates(*(torch.cat([x, x]) for x in said))
    blind = Cells(
        torch.cat([torch.zeros_like(cells.point), cells.point]),
        torch.cat([~cells.valid, cells.valid]),
        torch.cat([cells.pixel, cells.pixel]),
    )
    got = draw_poses(both, blind, CENTER, RADIUS, 50, torch.Generator().manual_seed(1))
    assert torch.isfinite(got).all()
    assert ((got[1, :, :3, 3] - pose[0, :3, 3]).norm(dim=-1) < 3e-3).float().mean() > 0.9


def test_the_loss_is_least_for_the_truth() -> None:
    said, cells, pose = world()
    mask = (said.logit > 0)[:, None].float()
    mask = torch.nn.functional.interpolate(mask, scale_factor=STRIDE) > 0.5
    right, error = coordinate_loss(said, cells, mask, pose, CENTER, RADIUS, 0.3)
    assert error.item() < 1e-6
    wrong, wrong_error = coordinate_loss(
        said._replace(position=said.position + 0.1), cells, mask, pose, CENTER, RADIUS, 0.3
    )
    assert wrong_error.item() == pytest.approx(0.1 * 3**0.5 * RADIUS, rel=1e-4)
    flipped, _ = coordinate_loss(
        said._replace(logit=-said.logit), cells, mask, pose, CENTER, RADIUS, 0.3
    )
    unsure, _ = coordinate_loss(world(doubt=0.4)[0], cells, mask, pose, CENTER, RADIUS, 0.3)
    assert right < wrong
    assert right < flipped
    assert right < unsure


def test_an_image_without_the_object_has_no_error_and_teaches_its_absence() -> None:
    said, cells, pose = world()
    none = torch.zeros_like(said.logit)[:, None].repeat_interleave(STRIDE, 2)
    none = none.repeat_interleave(STRIDE, 3) > 0
    loss, error = coordinate_loss(said, cells, none, pose, CENTER, RADIUS, 0.3)
    assert error.isnan().all()
    assert loss.isfinite().all()


def test_fragments_spread_over_the_surface() -> None:
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    points = points / points.norm(dim=-1, keepdim=True)
    middles, reach = sample_farthest_points(points, 20)
    assert (middles[:, None] - points).norm(dim=-1).amin(1).max() == 0  # each is one of the points
    apart = (torch.cdist(middles, middles) + 9 * torch.eye(20)).min()
    assert apart > 0.5  # 20 even caps of a sphere have middles about 0.8 apart
    assert reach == pytest.approx(torch.cdist(points, middles).amin(1).mean().item(), rel=1e-4)
    assert torch.equal(
        nearest_fragment(points[None], middles[None])[0], torch.cdist(points, middles).argmin(1)
    )


def test_the_network_learns_coordinates_of_a_toy() -> None:
    from tests.models.toy import scenes, square

    torch.manual_seed(0)
    net, model = ObjectCoordinateNet((16, 24, 32, 32), fragments=12), square()
    net.set_object(model.points, model.center, model.radius)
    cut = net.centers.clone()
    assert cut.norm(dim=-1).max() <= 1 + 1e-5
    # other points of the same object, to judge it by
    net.set_object(model.points.flip(0) * 0.9, model.center, model.radius)
    assert torch.equal(net.centers, cut)
    optimizer = torch.optim.AdamW(net.parameters(), 3e-3)
    errors = []
    for step in range(60):
        batch = scenes(8, seed=step)
        said = net(batch.rgb, batch.depth, batch.intrinsics)
        cells, size = (
            measure_cells(batch.depth, batch.intrinsics),
            (model.center, model.radius, float(net.reach)),
        )
        loss, error = coordinate_loss(said, cells, batch.mask, batch.camera_from_object, *size)
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
        errors.append(error.mean().item())
    assert sum(errors[-5:]) / 5 < 0.4 * errors[0]
