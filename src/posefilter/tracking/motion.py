"""How an object may move from one frame to the next, relative to the camera."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import Space

_UNKNOWN = 2.0  # the noise scale while the last motion is not known
_JUMP = 3.0  # standard deviations of an innovation, beyond which it is no motion
_MEMORY = 0.5  # share of the frames before in the mean of what the innovations tell


class ConstantVelocity:
    """A damped constant-velocity model on SE(3), whose process noise adapts to the innovations.

    Between two frames a pose moves by `move_about` (geometry/pose.py): the object's center by a
    shift in the camera's axes, then a turn about that center in the object's own axes. Both are
    Gaussian about a drift, with the standard deviations s that are given, times a noise scale f.

    The drift is velocity_gain (1 - 1 / d)_+ v, where v is the last frame's motion, a difference of
    two estimates, and d the sum of its three shifts' squares, each over its own s^2: the
    positive-part estimator of James and Stein (1961). What the noise explains is not continued:
    below one s there is no drift. With a gain of 1 and a fast motion it is the model of constant
    velocity (Bar-Shalom, Li and Kirubarajan 2001, section 6.3); with a gain of 0, and f = 1, it is
    a random walk: the covariance of t frames is t times that of one.

    The noise scale follows the innovations e, which are the estimates less what was predicted
    (adjustable process noise; Bar-Shalom, Li and Kirubarajan 2001, section 11.2):
    f^2 = max(1, q), q <- (q + z^2) / 2, where z^2 is the mean of (e / s)^2 over the three shifts.
    In the first frame of a motion that is not known f is 2, and q then becomes z^2. Turns have no
    say in f or the drift, which are theirs too: a single frame tells them too badly.

    Args:
        translation_mm: Least standard deviation a frame along the camera's x, y, z, one for all or
            three [mm].
        rotation_deg: Least standard deviation a frame about the object's x, y, z, one for all or
            three [degrees].
        velocity_gain: Share of the last frame's motion that is expected again, in [0, 1].
        max_noise_scale: The noise scale at most; 1: the deviations stay as given.

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
        velocity_gain: float = 1.0,
        max_noise_scale: float = 10.0,
    ) -> None:
        shift = _three(translation_mm, "translation_mm")
        turn = _three(rotation_deg, "rotation_deg")
        if not (isinstance(velocity_gain, int | float) and 0 <= velocity_gain <= 1):
            raise UserError(f"motion.velocity_gain={velocity_gain}: must lie between 0 and 1")
        if not (isinstance(max_noise_scale, int | float) and 1 <= max_noise_scale < math.inf):
            raise UserError(
                f"motion.max_noise_scale={max_noise_scale}: must be a number, 1 or more"
            )
        self.scale = (*(x / 1000 for x in shift), *(math.radians(x) for x in turn))
        self.velocity_gain = float(velocity_gain)
        self.max_noise_scale = float(max_noise_scale)

    def expect(self, velocity: Tensor) -> Tensor:
        """Return the drift (1, 6) after a motion (1, 6) [m, rad]."""
        d = 3 * float(self._measure(velocity)[0])
        return velocity * (self.velocity_gain * max(0.0, 1 - 1 / d) if d else 0.0)

    def adapt(self, squared_innovation: float | None, innovation: Tensor) -> float:
        """Return q after an innovation (1, 6) [m, rad].

        Args:
            squared_innovation: q before; None where it is not known.
            innovation: The estimate less what was predicted.
        """
        found = float(self._measure(innovation)[0])
        if squared_innovation is not None:
            found = _MEMORY * squared_innovation + (1 - _MEMORY) * found
        return min(found, self.max_noise_scale**2)

    def is_jump(self, innovation: Tensor, squared_innovation: float | None) -> bool:
        """Return whether an innovation (1, 6) is so large that it is the end of an error rather
        than a motion, and tells nothing of the next: three standard deviations of shifts, or six of
        turns.
        """
        shift, turn = self._measure(innovation).tolist()
        return max(shift, turn / 4) > (_JUMP * self.noise_scale(squared_innovation)) ** 2

    def noise_scale(self, squared_innovation: float | None) -> float:
        """Return the noise scale f, 1 or more; the innovation as of `adapt`."""
        if squared_innovation is None:
            return min(_UNKNOWN, self.max_noise_scale)
        return math.sqrt(max(1.0, squared_innovation))

    def _measure(self, motion: Tensor) -> Tensor:
        """Return the mean squares (2,) of shift and turn, in standard deviations; an axis without
        noise counts as still.
        """
        scale = motion.new_tensor([x or math.inf for x in self.scale])
        return (motion[0] / scale).square().view(2, 3).mean(1)

    def __call__(
        self, state: Tensor, drift: Tensor, noise_scale: float, space: Space, generator: Generator
    ) -> Tensor:
        """Move poses to the next frame.

        Args:
            state: (B, N, 4, 4) camera_from_object [m].
            drift: (B, 6) expected motion, shift [m] and turn [rad].
            noise_scale: Of the standard deviations about it.
            space: The space of poses.
            generator: Source of randomness.

        Returns:
            Moved poses (B, N, 4, 4).
        """
        shape = (*state.shape[:2], 6)
        noise = torch.randn(shape, generator=generator, device=state.device, dtype=state.dtype)
        move = drift[:, None] + noise_scale * noise * state.new_tensor(self.scale)
        return space.move(state, move)


def _three(value: float | Sequence[float], name: str) -> tuple[float, ...]:
    try:
        parts = tuple(float(x) for x in ([value] * 3 if isinstance(value, int | float) else value))
    except (TypeError, ValueError) as error:
        raise UserError(f"motion.{name}={value}: expected one number or three") from error
    if len(parts) != 3 or not all(math.isfinite(x) and x >= 0 for x in parts):
        raise UserError(f"motion.{name}={value}: one number or three, 0 or more")
    return parts
