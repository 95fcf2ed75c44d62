"""The calibrated belief: how far a right estimate is off, by the particles and what speaks for it.

The particles of a finished filter surround the estimate, and their second moment C about it says in
which directions it is uncertain.  Its size is that of the filter's last noise level rather than of
the estimate's error: refinements move the estimate and not the particles.  What a refinement leaves
has a shape of its own, much the same in every image: a matrix F.  The calibration frames tell both
the size and F.  The error of a right estimate, a twist e (6,), is modeled as Student's t:

    e ~ t_n(0, s^2 (C + F)),    log s = bias + slope * logit(probability) + weights . features

with numbers that maximize the posterior over the frames whose estimate is right.  Where particles
are close together F decides, and where they spread, as they do under occlusion, C.  The degrees of
freedom n are 5, or others from 3 to 8 where these explain the frames better: an alignment that
succeeds in most frames, and not in all, leaves errors with heavier tails.  The features are those
of the calibration, standardized by it: by the probability alone beliefs would be as wide as
they should be over all images, and too narrow where the object is occluded.  A calibrated belief
has draws of this distribution about the estimate in place of the particles that are near it;
particles elsewhere are other hypotheses, and stay.

So the belief says where the pose is *if the estimate is right*; `probability` says whether it is.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.geometry.pose import move_about
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.symmetries import densify, gather_copies, spread_turns
from posefilter.types import BeliefBatch, ObjectModel

FEWEST_RIGHT = 10  # frames with a right estimate that a fit takes
DEGREES = 5  # of freedom, where frames are few, and of calibrations that do not say
# of others, by how much they must explain the frames better than these: minus a log prior [nat]
_DEGREES_COST = {3: 2.0, 4: 1.0, DEGREES: 0.0, 6: 1.0, 8: 2.0}
POSSIBLE_DEGREES = tuple(_DEGREES_COST)
_LOGIT = 5.0  # beyond, on either side, frames are too few to tell more
# mean and standard deviation of the prior, near the mean and the spread of ten objects' own fits
_BIAS, _SLOPE = (-0.5, 1.0), (-0.2, 0.1)
# of F's Cholesky factor, in units of the mean size of C: of the log of its diagonal, and the
# deviation of the rest in units of that diagonal
_DIAGONAL, _REST = (-0.2, 1.0), 0.5
_FARTHEST = 10.0  # of these numbers from 0
_WEIGHT = 0.1  # standard deviation of the prior of a weight, times that of its feature
_LEAST_SPREAD = 0.05  # of a feature: one that is nearly constant says nothing of the width
_MOST = 3.0  # of the log of the factor: features beyond those that were seen say no more
# before any particle an error of so many diameters, a turn as the shift at the radius, counts as
# much as so many particles: C has full rank also where few are near the estimate
_PRIOR_ERROR, _PRIOR_COUNT = 0.03, 4.0
_FEWEST_PARTICLES, _FEWEST_DRAWS = 200, 32
TRIANGLE = 21  # numbers of a triangle of 6 x 6
# by degrees of freedom: of 300, one whose draws have lengths near the distribution's, also those of
# the translation and of the rotation alone
_SEEDS = {3: 2, 4: 179, 5: 197, 6: 235, 8: 157}


@dataclass(frozen=True)
class BeliefScale:
    """How large the error of a right estimate is, relative to the particles' second moment about
    it; plain data, part of a calibration.

    Attributes:
        bias: Log of the factor at a probability of one half.
        slope: By how much it rises with the probability's logit.
        weights: By how much it rises with each standardized feature; none: of an earlier version.
        degrees: Of freedom, of Student's t.
        common: F by the lower triangle of its Cholesky factor, row by row [m], a turn as the shift
            at the object's radius, 21 numbers; none: of an earlier version, whose F is zero.
    """

    bias: float
    slope: float
    weights: tuple[float, ...] = ()
    degrees: int = DEGREES
    common: tuple[float, ...] = ()

    def find_factor(self, probability: Tensor, features: Tensor) -> Tensor:
        """Return the factors of B estimates.

        Args:
            probability: (B,) that each is right.
            features: (B, F), standardized; F may be anything where there are no weights.
        """
        log_factor = self.bias + self.slope * _limit_logit(probability)
        if self.weights:
            log_factor = log_factor + features.double() @ log_factor.new_tensor(self.weights)
        return log_factor.clamp(-_MOST, _MOST).exp()

    def find_shape(self, scatter: Tensor) -> Tensor:
        """Return C + F of the scatter C of particles.  (*, 6, 6) [m^2] -> the same."""
        if not self.common:
            return scatter
        factor = _fill_triangle(scatter.new_tensor(self.common))
        return scatter + factor @ factor.mT


class PoseSpread(NamedTuple):
    """Errors of n estimates and what their particles say of them, a turn as the shift [m] that it
    gives at the object's radius.
    """

    twist: Tensor  # (n, 6) from the estimate to the nearest equivalent of the truth
    scatter: Tensor  # (n, 6, 6) second moment of the particles about the estimate


def measure_spread(belief: BeliefBatch, truth: Tensor, object_model: ObjectModel) -> PoseSpread:
    """Return the errors of estimates, and the scatter of their particles, float64 on the CPU.

    Args:
        belief: B beliefs.
        truth: (B, 4, 4) true poses.
        object_model: The object; poses that its symmetries make of one another are one.
    """
    unit = _unit(object_model)
    twists, scatters = [], []
    for i, true in enumerate(truth.detach().cpu().double()):
        best = belief.best[i].detach().cpu().double()
        twists.append(_twist_near(best, true[None], object_model)[0] * unit)
        scatters.append(_measure_scatter(belief, i, object_model)[0])
    return PoseSpread(torch.stack(twists), torch.stack(scatters))


def fit_belief_scale(
    spread: PoseSpread, probability: Tensor, features: Tensor
) -> BeliefScale | None:
    """Fit the scale to frames whose estimate is right; None where they are too few.

    Args:
        spread: Of n frames, see `measure_spread`.
        probability: (n,) of each, by a calibration that has not seen it.
        features: (n, F) of each, standardized.
    """
    from scipy.optimize import minimize  # slow to import, prediction needs none

    if len(probability) < FEWEST_RIGHT:
        return None
    logit = _limit_logit(probability)
    x = torch.column_stack([torch.ones_like(logit), logit, features.double()])
    count = x.shape[1]  # of what the scale depends on; what decides F follows
    unit = float(torch.linalg.slogdet(spread.scatter)[1].div(12).mean().exp())  # of length
    twist, scatter = spread.twist / unit, spread.scatter / unit**2
    own_spread = x[:, 2:].var(0, correction=0).sqrt().clamp_min(_LEAST_SPREAD)
    is_diagonal = _fill_triangle(torch.arange(TRIANGLE)).diagonal()
    mean = torch.zeros(count + TRIANGLE, dtype=torch.float64)
    mean[0], mean[1] = _BIAS[0], _SLOPE[0]
    mean[count + is_diagonal] = _DIAGONAL[0]
    deviation = torch.full_like(mean, _REST)
    deviation[0], deviation[1] = _BIAS[1], _SLOPE[1]
    deviation[2:count] = _WEIGHT / own_spread
    deviation[count + is_diagonal] = _DIAGONAL[1]

    # errors of exactly 0 have no scale; and F stays where its Cholesky factor is finite
    bounds = [(None, None)] * count + [(-_FARTHEST, _FARTHEST)] * TRIANGLE
    bounds[0] = (-_MOST, _MOST)

    def find_root(w: Tensor) -> Tensor:
        """Return the Cholesky factor of F, (6, 6), in units of the mean size of C."""
        lower = _fill_triangle(w[count:])
        diagonal = lower.diagonal().exp()
        return diagonal[:, None] * (lower.tril(-1) + torch.eye(6, dtype=lower.dtype))

    def negative_log_posterior(w: np.ndarray, degrees: int) -> tuple[float, np.ndarray]:
        """Return it up to a constant, the same for all degrees of freedom, and its gradient."""
        at = torch.from_numpy(w).requires_grad_()
        log_factor, root = x @ at[:count], find_root(at)
        lower = torch.linalg.cholesky(scatter + root @ root.mT)
        within = torch.linalg.solve_triangular(lower, twist[..., None], upper=False)[..., 0]
        ratio = within.square().sum(-1) * (-2 * log_factor).exp() / degrees
        constant = math.lgamma(degrees / 2) - math.lgamma(degrees / 2 + 3) + 3 * math.log(degrees)
        own = constant + 6 * log_factor + lower.diagonal(dim1=1, dim2=2).log().sum(1)
        own = own + 0.5 * (degrees + 6) * torch.log1p(ratio)
        cost = own.sum() + 0.5 * ((at - mean) / deviation).square().sum()
        cost.backward()
        assert at.grad is not None
        return float(cost.detach()), at.grad.numpy()

    def fit(degrees: int) -> tuple[float, BeliefScale]:
        """Return the negative log-posterior at its minimum, and where that is."""
        found = minimize(
            negative_log_posterior, mean.numpy(), (degrees,), "L-BFGS-B", jac=True, bounds=bounds
        )
        bias, slope, *weights = found.x[:count].tolist()
        lower = unit * find_root(torch.from_numpy(found.x))
        common = tuple(lower[torch.tril_indices(6, 6).unbind()].tolist())
        return float(found.fun), BeliefScale(bias, slope, tuple(weights), degrees, common)

    fits = [fit(degrees) for degrees in POSSIBLE_DEGREES]
    return min(fits, key=lambda one: one[0] + _DEGREES_COST[one[1].degrees])[1]


def calibrate_belief(
    belief: BeliefBatch,
    probability: Tensor,
    features: Tensor,
    scale: BeliefScale,
    object_model: ObjectModel,
    widening: float = 1.0,
) -> tuple[BeliefBatch, Tensor]:
    """Return beliefs that are as wide as the errors of right estimates are.

    Args:
        belief: B beliefs, as a filter leaves them.
        probability: (B,) that the estimate is right.
        features: (B, F) of each, standardized.
        scale: Of the calibration.
        object_model: The object.
        widening: By how much the errors are larger than those that the calibration has seen.

    Returns:
        B beliefs of as many particles, 200 at least, with the same estimates and scores.  The
        draws are always the same ones, moved, so that the same input has the same belief.  Where an
        estimate is not finite they are the particles alone.  And of each, how many of the first
        poses are draws about the estimate, (B,) int64.
    """
    factors = widening * scale.find_factor(probability.detach().cpu(), features.detach().cpu())
    count = max(belief.log_weights.shape[1], _FEWEST_PARTICLES)
    rows = [
        _redraw(belief, i, float(factor), count, object_model, scale)
        for i, factor in enumerate(factors)
    ]
    poses, log_weights, draws = zip(*rows, strict=True)
    whole = belief._replace(
        poses=torch.stack(poses).to(belief.poses),
        log_weights=torch.stack(log_weights).to(belief.log_weights),
    )
    return whole, torch.tensor(draws)


def _redraw(
    belief: BeliefBatch,
    i: int,
    factor: float,
    count: int,
    object_model: ObjectModel,
    scale: BeliefScale,
) -> tuple[Tensor, Tensor, int]:
    """Return the poses (count, 4, 4) and log weights (count,) of one calibrated belief, float64,
    and how many of the first are draws.
    """
    best, poses = (x[i].detach().cpu().double() for x in (belief.best, belief.poses))
    weights = belief.log_weights[i].detach().cpu().double().softmax(0)
    if not bool(best.isfinite().all()):  # no estimate: the particles are all that is known
        even = torch.full((count,), -math.log(count), dtype=torch.float64)
        return _resample(poses, weights, count), even, 0
    scatter, near = _measure_scatter(belief, i, object_model)
    mass = float(weights[near].sum())
    own = max(round(count * mass), _FEWEST_DRAWS)
    rest = count - own
    if own == _FEWEST_DRAWS or not rest:  # few particles are near the estimate, or all are
        mass = max(mass, own / count)
    draws = factor * draw_student_t(own, scale.degrees)
    twist = draws @ torch.linalg.cholesky(scale.find_shape(scatter)).mT / _unit(object_model)
    drawn = spread_turns(
        move_about(best, twist, object_model.center.detach().cpu().double()),
        object_model.symmetries.detach().cpu().double(),
    )
    log_weights = torch.full((count,), math.log(mass / own), dtype=torch.float64)
    if rest:
        log_weights[own:] = math.log((1 - mass) / rest)
        drawn = torch.cat([drawn, _resample(poses, weights.masked_fill(near, 0), rest)])
    return drawn, log_weights, own


def _resample(poses: Tensor, weights: Tensor, count: int) -> Tensor:
    """Return some of N poses by systematic resampling, each as often as its weight says.

    (N, 4, 4), (N,) >= 0 -> (count, 4, 4).
    """
    ladder = weights.cumsum(0)
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count * ladder[-1]
    return poses[torch.searchsorted(ladder, steps).clamp_max(len(weights) - 1)]


def draw_student_t(count: int, degrees: int = DEGREES) -> Tensor:
    """Return draws (count, 6) of Student's t about 0, in opposite pairs.

    Their second moment is exactly that of the distribution, n / (n - 2) along each axis.  Pairs
    follow each other, so that the first ones are as good as all.

    Args:
        count: 32 at least.
        degrees: Of freedom, n.
    """
    generator = torch.Generator().manual_seed(_SEEDS[degrees])
    half = torch.randn((count + 1) // 2, 6, generator=generator, dtype=torch.float64)
    squares = torch.randn((len(half), degrees), generator=generator, dtype=torch.float64).square()
    half = half * (degrees / squares.sum(1, keepdim=True)).sqrt()
    draws = torch.stack([half, -half], dim=1).flatten(0, 1)[:count]
    own = torch.linalg.cholesky(draws.mT @ draws / count)
    wanted = math.sqrt(degrees / (degrees - 2))
    return wanted * torch.linalg.solve_triangular(own, draws.mT, upper=False).mT


def _measure_scatter(
    belief: BeliefBatch, i: int, object_model: ObjectModel
) -> tuple[Tensor, Tensor]:
    """Return the second moment (6, 6) of the particles near an estimate, and which these are (N,).

    Near is within the object's radius, a turn counted as the shift there.
    """
    best, poses = (x[i].detach().cpu().double() for x in (belief.best, belief.poses))
    weights = belief.log_weights[i].detach().cpu().double().softmax(0)
    twist = _twist_near(best, poses, object_model) * _unit(object_model)
    near = (twist.norm(dim=1) < object_model.radius) & (weights > 0)
    share = weights * near
    count = float(share.sum()) ** 2 / max(float(share.square().sum()), 1e-300)  # effective
    moment = (share[:, None] * twist).mT @ twist / share.sum().clamp_min(1e-300)
    prior = (_PRIOR_ERROR * object_model.diameter) ** 2 * torch.eye(6, dtype=torch.float64)
    return (count * moment + _PRIOR_COUNT * prior) / (count + _PRIOR_COUNT), near


def _twist_near(best: Tensor, poses: Tensor, object_model: ObjectModel) -> Tensor:
    """Return the twists (N, 6) from a pose to the nearest equivalent of each of many."""
    center, group = (
        x.detach().cpu().double() for x in (object_model.center, object_model.symmetries)
    )
    copies = gather_copies(poses, best, center, object_model.radius, densify(group))
    return twist_between(best, copies, center)


def _fill_triangle(values: Tensor) -> Tensor:
    """Return a lower triangular matrix by its rows.  (21,) -> (6, 6)."""
    lower = values.new_zeros(6, 6)
    lower[torch.tril_indices(6, 6).unbind()] = values
    return lower


def _limit_logit(probability: Tensor) -> Tensor:
    """Return the log odds of probabilities, as far as frames can tell them."""
    return torch.special.logit(probability.double()).clamp(-_LOGIT, _LOGIT)


def _unit(object_model: ObjectModel) -> Tensor:
    """Return what makes a turn the shift at the object's radius, (6,)."""
    return torch.tensor([1.0] * 3 + [float(object_model.radius)] * 3, dtype=torch.float64)
