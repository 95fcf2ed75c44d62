"""Noise level of each step, in the space's unit ([m] for poses, [px] for pixels)."""

from posefilter.errors import UserError


class Constant:
    """The same sigma at every step.

    Args:
        sigma: Noise level.
    """

    def __init__(self, sigma: float) -> None:
        self.sigma = sigma

    def __call__(self, steps: int) -> list[float]:
        """Return `steps` values."""
        return [self.sigma] * steps


class Geometric:
    """Sigma changes by a constant factor from the first step to the last.

    Args:
        start: Noise level at the first step.
        stop: Noise level at the last step.

    Raises:
        UserError: A level is not above 0.
    """

    def __init__(self, start: float, stop: float) -> None:
        if not (start > 0 and stop > 0):
            raise UserError(f"schedule: start={start} and stop={stop} must be above 0")
        self.start, self.stop = start, stop

    def __call__(self, steps: int) -> list[float]:
        """Return `steps` values; a single step gets `stop`."""
        if steps == 1:
            return [self.stop]
        factor = (self.stop / self.start) ** (1 / (steps - 1))
        return [self.start * factor**number for number in range(steps)]
