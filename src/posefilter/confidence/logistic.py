"""Logistic regression on few frames.

The maximum of a posterior (MAP): a logistic likelihood with Platt's targets (1999), which are a
little off 0 and 1 as few frames warrant, and a normal prior on the weights, which are not negative.
It is convex, so that the same frames give the same regression.

References:
    Platt: Probabilistic outputs for support vector machines. Advances in Large Margin Classifiers
        (1999).
"""

from dataclasses import dataclass

import numpy as np

_PENALTY = 1.0  # of the squared weights: the inverse variance of their prior


@dataclass(frozen=True)
class Logistic:
    """A logistic regression on standardized features."""

    weights: tuple[float, ...]  # >= 0
    bias: float


def fit_logistic(x: np.ndarray, label: np.ndarray, balance: np.ndarray | None = None) -> Logistic:
    """Return the logistic regression of highest posterior density, with weights of 0 or more.

    Args:
        x: (n, F) standardized features.
        label: (n,) bool.
        balance: (n,) how much each frame counts; None: 1.
    """
    from scipy.optimize import minimize  # slow to import, and most predictions fit nothing

    count = np.ones(len(x)) if balance is None else balance
    many, few = float(count[label].sum()), float(count[~label].sum())
    target = np.where(label, (many + 1) / (many + 2), 1 / (few + 2))

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        weights, bias = parameters[:-1], parameters[-1]
        z = x @ weights + bias
        value = (count * (np.logaddexp(0, z) - target * z)).sum()
        slope = count * (1 / (1 + np.exp(-z)) - target)
        gradient = np.append(x.T @ slope + _PENALTY * weights, slope.sum())
        return value + 0.5 * _PENALTY * weights @ weights, gradient

    start = np.zeros(x.shape[1] + 1)
    bounds = [(0, None)] * x.shape[1] + [(None, None)]
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, tol=1e-10).x
    return Logistic(tuple(found[:-1].tolist()), float(found[-1]))
