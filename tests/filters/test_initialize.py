"""First clouds: where they are drawn, and how often."""

import pytest
import torch
from torch import Generator, Tensor

from posefilter.filters.initialize import (
    FromDepth,
    FromObjectness,
    FromProposals,
    Informed,
    UniformPixels,
    draw_from_depth,
)
from posefilter.geometry.camera import intrinsics, project
from posefilter.geometry.lookup import overlaps_mask
from posefilter.geometry.pose import is_rigid, make_pose, origin_of, rotation_of
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.protocols import Initialize
from posefilter.types import Batch

H, W = 20, 30
SPACE = PoseSpace((0.02, 0.0, -0.03), 0.1)
CENTER = torch.tensor(SPACE.center)


class Pixels:
    space = PixelSpace()


class Poses:
    space = SPACE

    def propose_poses(self, encoding: Tensor, particles: int, generator: Generator) -> Tensor:
        return make_pose(torch.eye(3), encoding + torch.rand(2, particles, 3, generator=generator))


class Map:
    def __init__(self, objectness: Tensor) -> None:
        self.objectness = objectness


def images() -> Batch:
    depth = torch.zeros(2, 1, H, W)
    depth[0, 0, 5:10, 3:9] = 0.8
    depth[1] = 1.0 + torch.arange(W) / 100
    mask = torch.zeros(2, 1, H, W, dtype=torch.bool)
    mask[0, 0, 8:10, 20:24] = True
    K = intrinsics(40.0, 42.0, 14.5, 9.5).expand(2, 3, 3)
    ids = torch.arange(2)
    return Batch(
        torch.zeros(2, 3, H, W),
        depth,
        mask,
        K,
        torch.eye(4).expand(2, 4, 4),
        ids,
        ids,
        torch.ones(2),
    )


def run(
    piece: Initialize, method: object, encoding: object = None, particles: int = 4000, seed: int = 0
) -> Tensor:
    return piece(images(), encoding, method, particles, Generator().manual_seed(seed))


def test_uniform_pixels_fill_the_frame() -> None:
    state = run(UniformPixels(), Pixels())
    assert state.shape == (2, 4000, 2)
    assert state.min() >= -0.5
    assert (state.amax((0, 1)) < torch.tensor([W - 0.5, H - 0.5])).all()
    torch.testing.assert_close(
        state.mean((0, 1)), torch.tensor([(W - 1) / 2, (H - 1) / 2]), atol=0.3, rtol=0
    )
    cells = torch.histogramdd(state[0], [3, 2], range=[-0.5, W - 0.5, -0.5, H - 0.5]).hist
    assert cells.min() > 0.85 * 4000 / 6


def test_poses_start_behind_measured_points() -> None:
    poses = run(FromDepth((0.2, 0.6)), Poses())
    assert is_rigid(poses)
    center = origin_of(poses, CENTER)
    pixels = project(center, images().intrinsics)
    # on the rays of whole pixels
    torch.testing.assert_close(pixels, pixels.round(), atol=1e-3, rtol=0)
    u, v = pixels[0].round().unbind(-1)
    assert ((u >= 3) & (u < 9) & (v >= 5) & (v < 10)).all()  # nothing was measured elsewhere
    surface = center[0] / center[0, :, 2:] * 0.8
    behind = (center[0] - surface).norm(dim=-1) * (center[0] - surface)[:, 2].sign()
    assert behind.min() >= 0.02 - 1e-5
    assert behind.max() <= 0.06 + 1e-5
    assert float(behind.mean()) == pytest.approx(0.04, abs=0.001)
    counts = torch.bincount(((v - 5) * 6 + u - 3).long(), minlength=30)
    assert counts.min() > 80  # 133 on average
    assert rotation_of(poses).mean((0, 1)).abs().max() < 0.05


def test_a_prior_says_where() -> None:
    batch = images()
    prior = torch.zeros(2, 1, H, W)
    prior[:, :, 6, 4] = 1.0
    poses = draw_from_depth(
        batch.depth, batch.intrinsics, SPACE, 50, Generator().manual_seed(0), prior
    )
    pixels = project(origin_of(poses, CENTER), batch.intrinsics)
    torch.testing.assert_close(pixels, torch.tensor([4.0, 6.0]).expand(2, 50, 2), atol=1e-3, rtol=0)


def test_without_any_depth_poses_start_a_meter_away() -> None:
    batch = images()
    none = draw_from_depth(
        batch.depth * 0,
        batch.intrinsics,
        SPACE,
        500,
        Generator().manual_seed(0),
        depth_offset=(0.0, 0.0),
    )
    torch.testing.assert_close(origin_of(none, CENTER)[..., 2], torch.ones(2, 500))


def test_objectness_draws_its_cells_and_little_else() -> None:
    weight = torch.zeros(2, 1, 5, 10)
    weight[0, 0, 1, 7] = 3.0
    weight[1, 0, :, 0] = 0.1
    state = run(FromObjectness(uniform_fraction=0.2), Pixels(), Map(weight))
    in_cell = (
        (state[0] >= torch.tensor([20.5, 3.5])) & (state[0] < torch.tensor([23.5, 7.5]))
    ).all(-1)
    assert float(in_cell.float().mean()) == pytest.approx(0.8 + 0.2 / 50, abs=0.02)
    assert float((state[1, :, 0] < 2.5).float().mean()) == pytest.approx(0.8 + 0.2 / 10, abs=0.02)
    chosen = state[0][in_cell]
    torch.testing.assert_close(chosen.mean(0), torch.tensor([22.0, 5.5]), atol=0.1, rtol=0)
    empty = run(FromObjectness(uniform_fraction=0.0), Pixels(), Map(torch.zeros(2, 1, 5, 10)))
    assert empty.std(1).min() > 4  # no opinion: everywhere


def test_proposals_are_the_methods_own() -> None:
    poses = run(FromProposals(), Poses(), torch.tensor([5.0, 0.0, 0.0]), 7)
    assert poses.shape == (2, 7, 4, 4)
    assert (poses[..., 0, 3] >= 5).all()


def test_informed_starts_read_the_mask_in_training_only() -> None:
    piece = Informed(UniformPixels(), object_fraction=0.5, sigma_px=0.0)
    seen, unseen = run(piece.train(), Pixels())
    on = overlaps_mask(images().mask, torch.stack([seen, unseen]))[0]
    assert on[:2000].all()
    assert float(on[2000:].float().mean()) < 0.05
    assert unseen.std(0).min() > 4  # an image whose object is hidden is searched everywhere
    assert torch.equal(run(piece.eval(), Pixels()), run(UniformPixels(), Pixels()))
    around = run(Informed(UniformPixels(), 1.0, 3.0).train(), Pixels())[0]
    assert float(around.std(0)[1]) == pytest.approx((9 + 0.25) ** 0.5, abs=0.3)


@pytest.mark.parametrize(
    "piece",
    [UniformPixels(), FromObjectness(), Informed(UniformPixels())],
    ids=lambda x: type(x).__name__,
)
def test_the_same_generator_draws_the_same(piece: Initialize) -> None:
    encoding = Map(torch.rand(2, 1, 5, 10, generator=Generator().manual_seed(0)))
    assert torch.equal(
        run(piece, Pixels(), encoding, seed=4), run(piece, Pixels(), encoding, seed=4)
    )
    assert not torch.equal(
        run(piece, Pixels(), encoding, seed=4), run(piece, Pixels(), encoding, seed=5)
    )


def test_centers_lie_a_tenth_to_nine_tenths_of_a_radius_behind_the_surface() -> None:
    """At one measured pixel, on the axis: all of the offset is depth."""
    depth = torch.zeros(1, 1, 3, 3)
    depth[0, 0, 1, 1] = 0.5
    K = intrinsics(100.0, 100.0, 1.0, 1.0)[None]
    for poses in (
        draw_from_depth(depth, K, SPACE, 2000, Generator().manual_seed(0)),
        draw_from_depth(
            depth, K, SPACE, 2000, Generator().manual_seed(0), depth_offset=FromDepth().depth_offset
        ),
    ):
        behind = origin_of(poses, CENTER)[0, :, 2] - 0.5
        assert float(behind.min()) == pytest.approx(0.01, abs=2e-4)
        assert float(behind.max()) == pytest.approx(0.09, abs=2e-4)


def test_the_seed_decides_where_and_how_poses_are_turned() -> None:
    one, same, other = (run(FromDepth(), Poses(), particles=20, seed=s) for s in (3, 3, 4))
    assert torch.equal(one, same)
    assert not torch.equal(rotation_of(one), rotation_of(other))


@pytest.mark.parametrize(("fraction", "near"), [(0.0, 0), (0.5, 1), (1.0, 2)])
def test_none_one_or_all_of_two_start_at_the_object(fraction: float, near: int) -> None:
    piece = Informed(UniformPixels(), object_fraction=fraction, sigma_px=0.0).train()
    state = run(piece, Pixels(), particles=2)
    plain = run(UniformPixels(), Pixels(), particles=2)
    assert torch.equal(state[:, near:], plain[:, near:])
    assert overlaps_mask(images().mask, state)[0, :near].all()
    assert not overlaps_mask(images().mask, state)[0, near:].any()
