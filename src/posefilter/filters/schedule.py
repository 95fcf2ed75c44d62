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
        initial_sigma: Noise level at the first step.
        final_sigma: Noise level at the last step.

    Raises:
        UserError: A level is not above 0.
    """

    def __init__(self, initial_sigma: float, final_sigma: float) -> None:
        if not (initial_sigma > 0 and final_sigma > 0):
            raise UserError(
                f"schedule: initial_sigma={initial_sigma} and final_sigma={final_sigma} must "
                f"be above 0"
            )
        self.initial_sigma, self.final_sigma = initial_sigma, final_sigma

    def __call__(self, steps: int) -> list[float]:
        """Return `steps` values; a single step gets `final_sigma`."""
        if steps == 1:
            return [self.final_sigma]
        factor = (self.final_sigma / self.initial_sigma) ** (1 / (steps - 1))
        return [self.initial_sigma * factor**number for number in range(steps)]
