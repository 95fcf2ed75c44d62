"""Weight updates from the log-likelihoods of a step; see protocols.Reweight for the arguments."""

import math

from torch import Tensor


class SequentialBayes:
    """Bayes' rule: multiply the weights by the likelihood (Gordon et al. 1993).

    The choice `filter/reweight=sequential_bayes`.

    Each step counts as an independent observation, as in a sequence of images. If all T steps
    measure one image, its evidence counts T times: the mode is kept, but the belief is too narrow
    (by sqrt(T) for a Gaussian).
    """

    def __call__(
        self, log_weights: Tensor, log_likelihood: Tensor, ancestor_log_likelihood: Tensor
    ) -> Tensor:
        """Return (B, N)."""
        return log_weights + log_likelihood


class CurrentLikelihood:
    """Weights from this step's likelihood alone; earlier weights are discarded.

    The choice `filter/reweight=current_likelihood`. There is no temperature: what falls over the
    steps is the schedule's noise level.

    As in the annealed particle filter (Deutscher, Blake and Reid 2000). It is a search: particles
    concentrate where the likelihood was high, and the likelihood counts there again. Weights rank
    particles and are no estimate of posterior mass.
    """

    def __call__(
        self, log_weights: Tensor, log_likelihood: Tensor, ancestor_log_likelihood: Tensor
    ) -> Tensor:
        """Return (B, N)."""
        return log_likelihood - math.log(log_likelihood.shape[1])


class LikelihoodRatio:
    """Multiply the weights by the *ratio* of the likelihoods of a particle and of its ancestor.

    The choice `filter/reweight=likelihood_ratio`.

    A sequential Monte Carlo sampler (Del Moral, Doucet and Jasra 2006) in which each move serves as
    its own backward kernel. The image's evidence counts once, however many steps and noise levels
    there are: the last particles target exp(score_T) times the initial density as diffused by the
    moves alone. That density is flat if the initial one is and the moves are symmetric.
    """

    def __call__(
        self, log_weights: Tensor, log_likelihood: Tensor, ancestor_log_likelihood: Tensor
    ) -> Tensor:
        """Return (B, N); -inf where the ancestor's likelihood was zero, and so its weight."""
        weights = log_weights + log_likelihood - ancestor_log_likelihood
        return weights.masked_fill(ancestor_log_likelihood.isneginf(), -math.inf)
