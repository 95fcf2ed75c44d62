"""How an object may move from one frame to the next, relative to the camera."""

import math
from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.protocols import Space


class RandomWalk:
    """A random walk on SE(3), with the motion of the last frame continued in part.

    Between two frames a pose moves by `move_about` (geometry/pose.py): the object's center by a
    shift in the camera's axes, then a turn about that center in the object's own axes. Both are
    Gaussian with the standard deviations given, about `momentum` times the motion of the frame
    before. At momentum 0 the covariance of t frames is t times that of one; at momentum 1 the model
    is that of constant velocity (Bar-Shalom, Li and Kirubarajan 2001, section 6.3).

    Args:
        translation_mm: Standard deviation a frame along the camera's x, y, z, one for all or three
            [mm].
        rotation_deg: Standard deviation a frame about the object's x, y, z, one for all or three
            [degrees].
        momentum: Share of the last frame's motion that is expected again, in [0, 1].

    Raises:
        UserError: A number is out of range.
    """

    def __init__(
        self,
        translation_mm: float | Sequence[float] = 5.0,
        rotation_deg: float | Sequence[float] = 2.0,
        momentum: float = 0.0,
    ) -> None:
        shift = _three(translation_mm, "translation_mm")
        turn = _three(rotation_deg, "rotation_deg")
        if not 0 <= momentum <= 1:
            raise UserError(f"motion.momentum={momentum}: must lie between 0 and 1")
        self.scale = (*(x / 1000 for x in shift), *(math.radians(x) for x in turn))
        self.momentum = float(momentum)

    def __call__(
        self, state: Tensor, velocity: Tensor, space: Space, generator: Generator
    ) -> Tensor:
        """Move poses to the next frame.

        Args:
            state: (B, N, 4, 4) camera_from_object [m].
            velocity: (B, 6) motion of the last frame, shift [m] and turn [rad].
            space: The space of poses.
            generator: Source of randomness.

        Returns:
            Moved poses (B, N, 4, 4).
        """
        noise = torch.randn(
            *state.shape[:2], 6, generator=generator, device=state.device, dtype=state.dtype
        )
        drift = self.momentum * velocity[:, None]
        return space.move(state, drift + noise * state.new_tensor(self.scale))


def _three(value: float | Sequence[float], name: str) -> tuple[float, ...]:
    try:
        parts = tuple(float(x) for x in ([value] * 3 if isinstance(value, int | float) else value))
    except (TypeError, ValueError) as error:
        raise UserError(f"motion.{name}={value}: one number or three are due") from error
    if len(parts) != 3 or not all(math.isfinite(x) and x >= 0 for x in parts):
        raise UserError(f"motion.{name}={value}: one number or three, 0 or more")
    return parts
