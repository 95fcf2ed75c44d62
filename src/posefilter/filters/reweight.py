"""How much does what a particle has just read change its weight?

See protocols.Reweigh for the arguments.
"""

import math

from torch import Tensor


class Sequential:
    """Bayes's rule: weights times likelihood.  Each step's reading counts as a new, independent
    observation.

    Right for a sequence of images. Reading one and the same image T times counts its evidence T
    times: the belief then is too narrow (by sqrt(T) for a Gaussian), though its mode stays where it
    was.
    """

    def __call__(self, log_weights: Tensor, log_likelihood: Tensor, inherited: Tensor) -> Tensor:
        """Return (B, N)."""
        return log_weights + log_likelihood


class Annealed:
    """Weights from the score at this step's noise level alone, whatever they were before.

    A search: children crowd where the score was high, and the score counts there again. Where the
    cloud thins out the weights say how good each particle is, not how much mass it stands for.
    """

    def __call__(self, log_weights: Tensor, log_likelihood: Tensor, inherited: Tensor) -> Tensor:
        """Return (B, N)."""
        return log_likelihood - math.log(log_likelihood.shape[1])


class TemperedSMC:
    """Weights times the *change* of the score since the parent was read: the image's evidence
    counts once in all.

    An SMC sampler (Del Moral, Doucet and Jasra 2006) whose moves are their own backward kernels.
    However many steps and levels led there, the last cloud stands for exp(score_T) times the first
    cloud's density as diffused by the moves alone: flat if it was flat and moves are as likely
    there as back, and the proposals' own density if it was drawn from them.
    """

    def __call__(self, log_weights: Tensor, log_likelihood: Tensor, inherited: Tensor) -> Tensor:
        """Return (B, N)."""
        return log_weights + log_likelihood - inherited
