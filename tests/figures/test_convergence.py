"""The animation of a cloud that closes in: poses move on straight ways, and what is found is shown
at the end.
"""

from io import BytesIO
from itertools import pairwise

import numpy as np
import pytest
import torch
from docs.convergence import (
    animate_convergence,
    choose_keyframes,
    encode_webp,
    interpolate_poses,
)
from PIL import Image
from test_animation import HULL, RGB, H, K, W, pose, trace_of

from posefilter.figures.canvas import ESTIMATE
from posefilter.geometry.pose import make_pose, origin_of, rotation_of
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.types import BeliefBatch

CENTER = torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)


def random_poses(seed: int, count: int = 20) -> torch.Tensor:
    g = torch.Generator().manual_seed(seed)
    turn = torch.randn(count, 3, generator=g, dtype=torch.float64)
    place = torch.randn(count, 3, generator=g, dtype=torch.float64) + torch.tensor([0.0, 0.0, 3.0])
    return make_pose(exp_so3(turn), place)


def test_a_way_begins_and_ends_where_it_should_and_is_the_shortest() -> None:
    a, b = random_poses(0), random_poses(1)
    assert torch.allclose(interpolate_poses(a, b, 0.0, CENTER), a, atol=1e-9)
    assert torch.allclose(interpolate_poses(a, b, 1.0, CENTER), b, atol=1e-9)
    for share in (0.25, 0.5, 0.9):
        between = interpolate_poses(a, b, share, CENTER)
        straight = torch.lerp(origin_of(a, CENTER), origin_of(b, CENTER), share)
        assert torch.allclose(origin_of(between, CENTER), straight, atol=1e-9)
        whole, part = (angle_between(rotation_of(a), rotation_of(x)) for x in (b, between))
        assert torch.allclose(part, share * whole, atol=1e-6)


def test_particles_come_from_where_their_ancestors_were() -> None:
    first, second = random_poses(2, 3), random_poses(3, 3)
    keys = choose_keyframes(trace_of([first, second], [[0, 1, 2], [2, 2, 0]]), 3)
    assert torch.equal(keys[0].before, keys[0].after)
    assert torch.equal(keys[1].after, second)
    assert torch.equal(keys[1].before, first[[2, 2, 0]])


@pytest.fixture(scope="module")
def frames() -> list[np.ndarray]:
    best = pose().double()
    trace = trace_of([random_poses(4, 8), pose().expand(8, 4, 4)], [list(range(8))] * 2)
    belief = BeliefBatch(best[None, None], torch.zeros(1, 1), best[None], torch.zeros(1))
    trace = trace._replace(belief=belief)
    return list(
        animate_convergence(
            RGB, K, trace, CENTER, HULL, HULL, width=160, count=8, between=3, hold=4
        )
    )


def test_frames_have_one_size_and_end_with_the_estimate(frames: list[np.ndarray]) -> None:
    assert len(frames) == 2 * 3 + 4
    assert len({frame.shape for frame in frames}) == 1
    shown = 160 * H // W
    pink = [(np.abs(frame[:shown].astype(int) - ESTIMATE).max(-1) < 40).sum() for frame in frames]
    assert pink[-1] > 100 > 10 * pink[0]


def test_the_progress_never_goes_back(frames: list[np.ndarray]) -> None:
    shown = 160 * H // W
    done = [
        (np.abs(frame[shown:].astype(int) - ESTIMATE).max(-1) < 40).any(0).sum() for frame in frames
    ]
    assert (np.diff(done) >= 0).all()
    assert done[-1] > done[0]


def test_it_is_packed_as_it_is(frames: list[np.ndarray]) -> None:
    with Image.open(BytesIO(encode_webp(frames, milliseconds=50, last=900, quality=90))) as moving:
        assert moving.format == "WEBP"
        # equal frames become one that is shown for longer
        changes = sum((a != b).any() for a, b in pairwise(frames))
        assert moving.n_frames == 1 + changes
        moving.seek(moving.n_frames - 1)
        shown = np.asarray(moving.convert("RGB")).astype(int)
    assert np.abs(shown - frames[-1]).mean() < 6
