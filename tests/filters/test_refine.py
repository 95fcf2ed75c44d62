"""Refinement: rescoring, mean shift and gradient ascent on a score of known maximum."""

import math

import pytest
import torch
from torch import Generator, Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.refine import Compose, Gradient, MeanShift, NoRefine, Rescore
from posefilter.geometry.pose import is_rigid, make_pose, origin_of, rotation_of
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import BeliefBatch

SPACE = PoseSpace((0.05, 0.0, -0.02), 0.1)
CENTER = torch.tensor(SPACE.center)


class Peak(nn.Module):
    """Scores a pose by how near it is to the image's own; `weight` stands for a network's
    parameters.
    """

    space = SPACE

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(()))
        self.asked: list[tuple[int, float, int]] = []

    def score_poses(
        self, encoding: Tensor, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        self.asked.append((poses.shape[1], sigma, pixels))
        shift = (origin_of(poses, CENTER) - origin_of(encoding, CENTER)[:, None]).square().sum(-1)
        turn = (rotation_of(poses) - rotation_of(encoding)[:, None]).square().sum((-1, -2)) / 2
        noise = 0.01 / pixels**0.5 * torch.randn(1, 1, generator=generator)  # common to all poses
        return self.weight * -(shift + turn * SPACE.radius**2) / (2 * 0.02**2) + noise


def truth() -> Tensor:
    g = Generator().manual_seed(0)
    return make_pose(random_rotation(3, generator=g), torch.randn(3, 3, generator=g))


def belief_around(sigma: float, count: int = 30) -> BeliefBatch:
    g = Generator().manual_seed(1)
    scale = SPACE.noise_scale(torch.tensor(sigma))
    poses = SPACE.move(
        truth()[:, None].expand(3, count, 4, 4), scale * torch.randn(3, count, 6, generator=g)
    )
    log_w = torch.randn(3, count, generator=g).log_softmax(1)
    return BeliefBatch(poses, log_w, poses[:, 0], torch.full((3,), -math.inf))


def off(belief: BeliefBatch) -> Tensor:
    return SPACE.distance(belief.best, truth())


def test_rescoring_bets_on_the_best_of_the_heaviest() -> None:
    method, belief = Peak(), belief_around(0.02)
    found = Rescore(top_k=8, pixels=1024, sigma=0.004)(belief, truth(), method, Generator())
    assert method.asked == [(9, 0.004, 1024)]
    for b in range(3):
        heavy = belief.log_weights[b].argsort(descending=True)[:8].tolist()
        scores = method.score_poses(truth(), belief.poses, 0.004, Generator(), 10**9)[b]
        best = max([0, *heavy], key=lambda n: scores[n].item())
        assert torch.equal(found.best[b], belief.poses[b, best])
    assert torch.equal(found.poses, belief.poses)
    assert not found.score.requires_grad
    few = Rescore(top_k=100)(belief, truth(), method, Generator())
    assert (off(few) <= off(found) + 1e-6).all()


@pytest.mark.parametrize("starts", [1, 4])
def test_climbing_finds_the_top(starts: int) -> None:
    method, belief = Peak(), belief_around(0.015)
    with torch.no_grad():  # as in validation
        found = Gradient(steps=60, lr=2e-3, starts=starts)(
            belief, truth(), method, Generator().manual_seed(0)
        )
    assert off(belief).min() > 0.005
    assert off(found).max() < 0.002
    assert is_rigid(found.best, 1e-4)
    assert method.weight.grad is None
    assert not found.best.requires_grad
    assert method.asked[0] == (starts, 0.006, 256)
    assert method.asked[-1] == (1 + starts, 0.004, 1024)
    assert len(method.asked) == 61


def test_a_climb_that_ends_lower_is_not_followed() -> None:
    class Slope(Peak):
        """A gradient that leads away."""

        def score_poses(
            self, encoding: Tensor, poses: Tensor, sigma: float, generator: Generator, pixels: int
        ) -> Tensor:
            right = super().score_poses(encoding, poses, sigma, generator, pixels)
            return right if pixels == 1024 else -right

    belief = belief_around(0.01)
    found = Gradient(steps=20)(belief, truth(), Slope(), Generator().manual_seed(0))
    assert torch.equal(found.best, belief.best)


def test_images_climb_apart_and_alike() -> None:
    belief, method = belief_around(0.015), Peak()
    whole = Gradient(steps=20)(belief, truth(), method, Generator().manual_seed(0))
    again = Gradient(steps=20)(belief, truth(), method, Generator().manual_seed(0))
    assert torch.equal(whole.best, again.best)
    single = Gradient(steps=20)(
        BeliefBatch(*(x[1:2] for x in belief)), truth()[1:2], method, Generator().manual_seed(0)
    )
    torch.testing.assert_close(single.best, whole.best[1:2], atol=1e-5, rtol=0)


def test_a_mean_shift_finds_the_top() -> None:
    method, belief = Peak(), belief_around(0.015)
    found = MeanShift(iterations=12, antithetic_pairs=200, initial_scale=0.02, final_scale=0.01)(
        belief, truth(), method, Generator().manual_seed(0)
    )
    assert off(belief).min() > 0.005
    assert off(found).max() < 0.002
    assert is_rigid(found.best, 1e-4)
    assert method.asked == [(400, 0.004, 256)] * 12 + [(1, 0.004, 256)]
    assert torch.equal(found.poses, belief.poses)
    assert not found.best.requires_grad


class Bumpy(Peak):
    """A peak with bumps of 3 mm on it, steep enough to hold whatever climbs."""

    def score_poses(
        self, encoding: Tensor, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        smooth = super().score_poses(encoding, poses, sigma, generator, pixels)
        return smooth + (origin_of(poses, CENTER) * (2 * math.pi / 0.003)).sin().sum(-1)


def test_a_mean_shift_walks_over_the_bumps_that_hold_a_climb() -> None:
    belief = belief_around(0.015)
    shifted = MeanShift(iterations=12, antithetic_pairs=500, initial_scale=0.02, final_scale=0.01)(
        belief, truth(), Bumpy(), Generator().manual_seed(0)
    )
    climbed = Gradient(steps=60, lr=1e-3, sigma=0.004)(
        belief, truth(), Bumpy(), Generator().manual_seed(0)
    )
    assert off(shifted).max() < 0.003
    assert off(climbed).mean() > 2 * off(shifted).mean()


def test_a_mean_shift_on_even_ground_stays() -> None:
    class Flat(Peak):
        def score_poses(
            self, encoding: Tensor, poses: Tensor, sigma: float, generator: Generator, pixels: int
        ) -> Tensor:
            return torch.zeros(poses.shape[:2])

    belief = belief_around(0.015)
    found = MeanShift()(belief, truth(), Flat(), Generator().manual_seed(0))
    torch.testing.assert_close(found.best, belief.best, atol=1e-5, rtol=0)
    assert (found.score == 0).all()


@pytest.mark.parametrize(
    "wrong",
    [{"iterations": 0}, {"antithetic_pairs": 0}, {"initial_scale": 0.005}, {"final_scale": 0.0}],
)
def test_a_mean_shift_to_nowhere_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UserError, match="mean shift needs"):
        MeanShift(**wrong)


def test_chains_and_nothing() -> None:
    belief = belief_around(0.02)
    assert NoRefine()(belief, truth(), Peak(), Generator()) is belief
    found = Compose([Rescore(), Gradient(steps=60)])(
        belief, truth(), Peak(), Generator().manual_seed(0)
    )
    assert off(found).max() < 0.002


def test_a_gradient_is_refused_where_there_are_none() -> None:
    with torch.inference_mode(), pytest.raises(UserError, match="inference_mode"):
        Gradient()(belief_around(0.02), truth(), Peak(), Generator())
