"""Candidates are where they are said to be, and persistent particles live on in the object's own
frame.
"""

import math

import pytest
import torch
from tests.models.toy import scenes, square

from posefilter.filters.candidates import PersistentParticles, perturb, sample_around_truth
from posefilter.filters.initialize import draw_from_depth
from posefilter.filters.propagate import HalfTurnRotations
from posefilter.geometry.camera import project
from posefilter.geometry.pose import make_pose, origin_of
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import Step

MODEL = square()
SPACE = PoseSpace((0.0, 0.0, 0.0), MODEL.radius)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_candidates_hold_the_truth_and_every_kind() -> None:
    batch = scenes(3)
    poses = sample_around_truth(
        batch, MODEL, SPACE, 8, (0.004, 0.25), generator(), HalfTurnRotations(1.0)
    )
    assert poses.shape == (3, 1 + 4 * 8 + 4, 4, 4)
    torch.testing.assert_close(poses[:, 0], batch.camera_from_object)
    distance = SPACE.distance(poses, batch.camera_from_object[:, None])
    assert distance[:, 1:9].min() < 0.01
    flipped = angle_between(poses[:, -8:, :3, :3], batch.camera_from_object[:, None, :3, :3])
    assert flipped.median() > 2.8
    placed = poses[:, 25:29]
    assert (origin_of(placed, MODEL.center) - batch.camera_from_object[:, None, :3, 3]).norm(
        dim=-1
    ).median() < 0.15


def test_each_kind_is_as_far_from_the_truth_as_it_is_said_to_be() -> None:
    batch, count = scenes(1), 4000
    poses = sample_around_truth(
        batch, MODEL, SPACE, count, (0.02, 0.02), generator(), HalfTurnRotations(1.0)
    )
    offset = (poses - batch.camera_from_object[:, None])[0, :, :3, 3]
    nearby, shifted, turned = (
        offset[1 : 1 + count],
        offset[-count * 3 // 2 : -count],
        offset[-count:],
    )
    for moved, share in ((nearby, 0.6), (shifted, 0.5), (turned, 0.3)):
        torch.testing.assert_close(moved.std(0), torch.full((3,), 0.02 * share), atol=0, rtol=0.05)
    # levels are drawn log-uniformly: their median is the geometric mean of the bounds
    poses = sample_around_truth(
        batch, MODEL, SPACE, count, (1e-4, 0.1), generator(), HalfTurnRotations(1.0)
    )
    size = (poses - batch.camera_from_object[:, None])[0, 1 : 1 + count, :3, 3].norm(dim=-1)
    # the noise is 0.6 of the level, and the length of three normal numbers has the median 1.538
    assert abs(size.median().item() / (0.6 * 1.538 * math.sqrt(1e-4 * 0.1)) - 1) < 0.15


def test_half_turns_are_half_turns_about_the_center() -> None:
    batch = scenes(2)
    center = torch.tensor([0.03, 0.01, -0.02])
    poses = batch.camera_from_object[:, None].expand(-1, 6, -1, -1)
    space, step = PoseSpace((0.03, 0.01, -0.02), MODEL.radius), Step(0, 1, torch.tensor(0.1))
    turned = HalfTurnRotations(1.0)(poses, poses, step, space, generator())
    torch.testing.assert_close(origin_of(turned, center), origin_of(poses, center))
    assert (angle_between(turned[..., :3, :3], poses[..., :3, :3]) - torch.pi).abs().max() < 2e-3


def test_jitter_has_the_given_size() -> None:
    poses = torch.eye(4).expand(1, 20_000, 4, 4)
    moved = perturb(poses, torch.full((1, 20_000), 0.02), SPACE, generator())
    assert abs(moved[0, :, 0, 3].std().item() - 0.02) < 5e-4
    turn = angle_between(moved[..., :3, :3], poses[..., :3, :3])
    assert abs(turn.square().mean().sqrt().item() - 3**0.5 * 0.02 / MODEL.radius) < 5e-3


def test_persistent_particles_follow_their_frame_under_another_camera() -> None:
    batch = scenes(2)._replace(frame_id=torch.tensor([7, 9]))
    kept = PersistentParticles(particles=5, levels=3, sharpest=0.01, step=0.0)
    fresh = draw_from_depth(batch.depth, batch.intrinsics, SPACE, 5, generator())
    poses, sigma = kept.recall(batch, fresh, 0.1)
    torch.testing.assert_close(poses, fresh)
    torch.testing.assert_close(sigma, torch.tensor([0.1, 0.1]))
    scores = torch.full((2, 5), -100.0)
    scores[:, 2] = 0.0  # one survivor
    kept.advance(batch, poses, scores, sigma, torch.tensor([True, False]), SPACE, generator(1))
    roll = make_pose(exp_so3(torch.tensor([0.0, 0.0, 0.5])), torch.zeros(3))
    rolled = batch._replace(camera_from_object=roll @ batch.camera_from_object)
    fresh = draw_from_depth(rolled.depth, rolled.intrinsics, SPACE, 5, generator(2))
    again, sigma = kept.recall(rolled, fresh, 0.1)
    torch.testing.assert_close(sigma, torch.tensor([0.1**0.5 * 0.01**0.5, 0.1]))
    torch.testing.assert_close(again[0], (roll @ poses[0, 2]).expand(5, 4, 4), atol=1e-5, rtol=0)
    torch.testing.assert_close(again[1], fresh[1])  # not used, so drawn anew


def test_after_the_last_level_particles_start_anew() -> None:
    batch = scenes(1)
    kept = PersistentParticles(particles=4, levels=2, sharpest=0.01)
    used = torch.tensor([True])
    for expected in (0.1, 0.01, 0.1):
        poses, sigma = kept.recall(
            batch, draw_from_depth(batch.depth, batch.intrinsics, SPACE, 4, generator()), 0.1
        )
        torch.testing.assert_close(sigma, torch.tensor([expected]))
        kept.advance(batch, poses, torch.zeros(1, 4), sigma, used, SPACE, generator())


def test_a_resumed_run_has_the_same_particles_and_levels() -> None:
    batch = scenes(2)._replace(frame_id=torch.tensor([9, 4]))
    kept, resumed = (PersistentParticles(particles=3, levels=4, sharpest=0.01) for _ in range(2))
    assert kept.state() == {}
    both = torch.tensor([True, True])
    fresh = draw_from_depth(batch.depth, batch.intrinsics, SPACE, 3, generator())
    for used in (both, torch.tensor([False, True])):
        poses, sigma = kept.recall(batch, fresh, 0.08)
        kept.advance(batch, poses, torch.zeros(2, 3), sigma, used, SPACE, generator(1))
    state = kept.state()
    assert state["frames"].tolist() == [4, 9]
    assert state["levels"].tolist() == [2, 1]
    resumed.restore(state)
    for one, other in zip(
        kept.recall(batch, fresh, 0.08), resumed.recall(batch, fresh, 0.08), strict=True
    ):
        assert torch.equal(one, other)
    torch.testing.assert_close(
        kept.recall(batch, fresh, 0.08)[1], torch.tensor([0.08 / 2, 0.08 / 4])
    )
    resumed.restore({})
    assert resumed.state() == {}


def test_after_the_last_level_a_frames_own_particles_are_gone() -> None:
    batch = scenes(1)
    kept = PersistentParticles(particles=4, levels=2, sharpest=0.01)
    fresh = [
        draw_from_depth(batch.depth, batch.intrinsics, SPACE, 4, generator(seed))
        for seed in range(3)
    ]
    found = []
    for one in fresh:
        poses, sigma = kept.recall(batch, one, 0.1)
        found.append(poses)
        kept.advance(
            batch, poses, torch.zeros(1, 4), sigma, torch.tensor([True]), SPACE, generator()
        )
    assert torch.equal(found[0], fresh[0])
    assert not torch.equal(found[1], fresh[1])
    assert torch.equal(found[2], fresh[2])


def test_candidates_on_the_object_are_now_and_then_beside_it() -> None:
    """A pixel of the object has 51 times the weight of another."""
    batch, count = scenes(1), 8000
    poses = sample_around_truth(
        batch, MODEL, SPACE, count, (0.01, 0.1), generator(), HalfTurnRotations()
    )
    pixels = project(origin_of(poses[:, 1 + count : 1 + 2 * count], MODEL.center), batch.intrinsics)
    u, v = pixels[0].round().long().unbind(-1)
    on = batch.mask[0, 0, v, u].double().mean()
    seen, all_of_them = int(batch.mask.sum()), batch.mask.numel()
    assert float(on) == pytest.approx(51 * seen / (51 * seen + all_of_them - seen), abs=0.015)
