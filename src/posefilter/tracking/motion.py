"""How an object may move from one frame to the next, relative to the camera."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import Space

_UNKNOWN = 2.0  # the factor while the last motion is not known
_JUMP = 3.0  # standard deviations of an innovation, beyond which it is no motion
_MEMORY = 0.5  # share of the frames before in the mean of what the innovations tell


class RandomWalk:
    """A random walk on SE(3) about the motion of the last frame, as wide as innovations tell.

    Between two frames a pose moves by `move_about` (geometry/pose.py): the object's center by a
    shift in the camera's axes, then a turn about that center in the object's own axes. Both are
    Gaussian about a drift, with the standard deviations s that are given, times a factor f.

    The drift is momentum (1 - 1 / d)_+ v, where v is the last frame's motion, a difference of two
    estimates, and d the sum of its three shifts' squares, each over its own s^2: the positive-part
    estimator of James and Stein (1961). What the walk explains is not continued: below one s there
    is no drift. With momentum 1 and a fast motion it is the model of constant velocity (Bar-Shalom,
    Li and Kirubarajan 2001, section 6.3); with momentum 0, and f = 1, the covariance of t frames is
    t times that of one.

    The factor follows the innovations e, which are the estimates less what was predicted
    (adjustable process noise; Bar-Shalom, Li and Kirubarajan 2001, section 11.2):
    f^2 = max(1, q), q <- (q + z^2) / 2, where z^2 is the mean of (e / s)^2 over the three shifts.
    In the first frame of a motion that is not known f is 2, and q then becomes z^2. Turns have no
    say in f or the drift, which are theirs too: a single frame tells them too badly.

    Args:
        translation_mm: Least standard deviation a frame along the camera's x, y, z, one for all or
            three [mm].
        rotation_deg: Least standard deviation a frame about the object's x, y, z, one for all or
            three [degrees].
        momentum: Share of the last frame's motion that is expected again, in [0, 1].
        widest: The factor at most; 1: the deviations stay as given.

    Raises:
        UserError: A number is out of range.

    References:
        James, Stein: Estimation with quadratic loss. Berkeley Symposium (1961).
        Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation (2001).
    """

    def __init__(
        self,
        translation_mm: float | Sequence[float] = 5.0,
        rotation_deg: float | Sequence[float] = 2.0,
        momentum: float = 1.0,
        widest: float = 10.0,
    ) -> None:
        shift = _three(translation_mm, "translation_mm")
        turn = _three(rotation_deg, "rotation_deg")
        if not 0 <= momentum <= 1:
            raise UserError(f"motion.momentum={momentum}: must lie between 0 and 1")
        if not 1 <= widest < math.inf:
            raise UserError(f"motion.widest={widest}: must be a number, 1 or more")
        self.scale = (*(x / 1000 for x in shift), *(math.radians(x) for x in turn))
        self.momentum, self.widest = float(momentum), float(widest)

    def expect(self, velocity: Tensor) -> Tensor:
        """Return the drift (1, 6) after a motion (1, 6) [m, rad]."""
        d = 3 * float(self._measure(velocity)[0])
        return velocity * (self.momentum * max(0.0, 1 - 1 / d) if d else 0.0)

    def adapt(self, square: float | None, innovation: Tensor) -> float:
        """Return q after an innovation (1, 6) [m, rad]; `square` is q before, None if unknown."""
        found = float(self._measure(innovation)[0])
        if square is not None:
            found = _MEMORY * square + (1 - _MEMORY) * found
        return min(found, self.widest**2)

    def is_jump(self, innovation: Tensor, square: float | None) -> bool:
        """Return whether an innovation (1, 6) is so large that it is the end of an error rather
        than a motion, and tells nothing of the next: three standard deviations of shifts, or six of
        turns.
        """
        shift, turn = self._measure(innovation).tolist()
        return max(shift, turn / 4) > (_JUMP * self.widen(square)) ** 2

    def widen(self, square: float | None) -> float:
        """Return the factor f of the standard deviations, 1 or more; `square` as of `adapt`."""
        if square is None:
            return min(_UNKNOWN, self.widest)
        return math.sqrt(max(1.0, square))

    def _measure(self, motion: Tensor) -> Tensor:
        """Return the mean squares (2,) of shift and turn, in standard deviations."""
        scale = motion.new_tensor([x or math.inf for x in self.scale])
        return (motion[0] / scale).square().view(2, 3).mean(1)

    def __call__(
        self, state: Tensor, drift: Tensor, factor: float, space: Space, generator: Generator
    ) -> Tensor:
        """Move poses to the next frame.

        Args:
            state: (B, N, 4, 4) camera_from_object [m].
            drift: (B, 6) expected motion, shift [m] and turn [rad].
            factor: Of the standard deviations about it.
            space: The space of poses.
            generator: Source of randomness.

        Returns:
            Moved poses (B, N, 4, 4).
        """
        noise = torch.randn(
            *state.shape[:2], 6, generator=generator, device=state.device, dtype=state.dtype
        )
        return space.move(state, drift[:, None] + factor * noise * state.new_tensor(self.scale))


def _three(value: float | Sequence[float], name: str) -> tuple[float, ...]:
    try:
        parts = tuple(float(x) for x in ([value] * 3 if isinstance(value, int | float) else value))
    except (TypeError, ValueError) as error:
        raise UserError(f"motion.{name}={value}: one number or three are due") from error
    if len(parts) != 3 or not all(math.isfinite(x) and x >= 0 for x in parts):
        raise UserError(f"motion.{name}={value}: one number or three, 0 or more")
    return parts
