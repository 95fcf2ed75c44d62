"""The motion model: its covariance grows with the frames, in the axes that it is stated in."""

import math

import pytest
import torch

from posefilter.errors import UserError
from posefilter.geometry.pose import pose_about
from posefilter.geometry.pose_statistics import covariance_about, twist_between
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.tracking.motion import ConstantVelocity

CENTER = (0.03, -0.05, 0.02)
SPACE = PoseSpace(CENTER, 0.1)
COUNT = 20_000


def simulate(
    motion: ConstantVelocity, frames: int, velocity: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Return a start (4, 4), and where many poses are after so many frames."""
    g = torch.Generator().manual_seed(0)
    start = pose_about(
        random_rotation(generator=g).double(),
        torch.tensor([0.1, 0.0, 0.8]).double(),
        torch.tensor(CENTER).double(),
    )
    state = start.expand(1, COUNT, 4, 4)
    for _ in range(frames):
        state = motion(state, motion.expect(velocity.double()), 1.0, SPACE, g)
    return start, state[0]


@pytest.mark.parametrize("frames", [1, 4])
def test_the_covariance_grows_with_the_frames(frames: int) -> None:
    """Shifts along the camera's axes, turns about the object's own, neither leaks into the other:
    the start is turned, and the object's center lies off its origin.
    """
    motion = ConstantVelocity(translation_mm=(2, 4, 8), rotation_deg=(0.5, 1.0, 2.0))
    start, state = simulate(motion, frames, torch.zeros(1, 6))
    found = covariance_about(
        start, state, torch.full((COUNT,), 1 / COUNT).double(), torch.tensor(CENTER).double()
    )
    deviations = torch.tensor([0.002, 0.004, 0.008, *(math.radians(x) for x in (0.5, 1, 2))])
    stated = frames * deviations.double().square()
    assert torch.allclose(found.diagonal(), stated, rtol=0.05)
    correlation = found / stated.sqrt().outer(stated.sqrt())
    assert (correlation - torch.eye(6)).abs().max() < 0.06


@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
def test_the_gain_is_the_share_of_the_last_motion_that_goes_on(gain: float) -> None:
    velocity = torch.tensor([[0.01, 0.0, -0.02, 0.0, 0.1, 0.0]])
    start, state = simulate(ConstantVelocity(1, 0.5, gain), 1, velocity)
    mean = twist_between(start, state, torch.tensor(CENTER).double()).mean(0)
    # 1 - 1 / d, where the motion is of d = 500 variances
    assert torch.allclose(mean, gain * (1 - 1 / 500) * velocity[0].double(), atol=1e-4)


def test_a_motion_that_the_noise_explains_is_not_continued() -> None:
    """James and Stein's estimate of a mean: at d = |shift|^2 / s^2 its share is 1 - 1 / d."""
    motion = ConstantVelocity(translation_mm=5)
    for shift, share in ((0.0, 0.0), (0.005, 0.0), (0.01, 0.75), (0.05, 0.99)):
        velocity = torch.tensor([[0.0, shift, 0.0, 0.3, 0.0, 0.0]])
        assert torch.allclose(motion.expect(velocity), share * velocity)


def test_the_noise_grows_with_large_innovations_and_falls_again() -> None:
    motion, still = ConstantVelocity(5, 2), torch.zeros(1, 6)
    large = torch.tensor([[0.02, 0.02, 0.02, 0.0, 0.0, 0.0]])  # four deviations on each axis
    known = motion.adapt(None, large)
    assert motion.noise_scale(known) == pytest.approx(4)
    assert motion.noise_scale(motion.adapt(known, large)) == pytest.approx(4)
    assert motion.noise_scale(motion.adapt(known, still)) == pytest.approx(4 / math.sqrt(2))
    for _ in range(4):
        known = motion.adapt(known, still)
    assert motion.noise_scale(known) == 1
    turned = torch.tensor([[0.0, 0, 0, *3 * [math.radians(10)]]])  # may be noise
    assert motion.noise_scale(motion.adapt(None, turned)) == 1
    assert not motion.is_jump(turned, 1.0)
    assert motion.is_jump(2 * turned, 1.0)
    assert motion.noise_scale(motion.adapt(None, 1e3 * large)) == motion.max_noise_scale
    assert motion.is_jump(large, 1.0)
    assert not motion.is_jump(large, 4.0)
    fixed = ConstantVelocity(5, 2, max_noise_scale=1)
    assert fixed.noise_scale(fixed.adapt(None, large)) == fixed.noise_scale(None) == 1


def test_an_axis_without_deviation_stays_still() -> None:
    motion = ConstantVelocity((5, 0, 0), 0)
    assert motion.noise_scale(motion.adapt(None, torch.tensor([[0.0, 1, 1, 1, 1, 1]]))) == 1
    _, state = simulate(motion, 1, torch.zeros(1, 6))
    assert state[:, 1, 3].std() < 1e-9


@pytest.mark.parametrize(
    "wrong",
    [
        {"translation_mm": -1},
        {"rotation_deg": (1, 2)},
        {"velocity_gain": 1.5},
        {"translation_mm": math.nan},
        {"max_noise_scale": 0.5},
        {"max_noise_scale": math.nan},
    ],
)
def test_what_is_no_motion_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UserError, match=rf"motion\.{next(iter(wrong))}="):
        ConstantVelocity(**wrong)
