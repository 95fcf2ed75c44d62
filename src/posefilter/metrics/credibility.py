"""How dense a belief is at the truth, and how often credible sets hold it."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.geometry.pose_density import fit_density, log_density, log_density_held_out
from posefilter.metrics.collect import Rows, lies_within
from posefilter.types import BeliefBatch, ObjectModel

LEVELS = tuple(round(0.05 * k, 2) for k in range(1, 20))  # of the coverage curve
SHOWN = (50, 80, 90, 95)  # [%] levels with a number of their own
_ROUNDING = 1e-9  # of ranks
QUARTERS = ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0))  # of visibility


class TruthScores(NamedTuple):
    """How beliefs see the truth."""

    log_density: Tensor  # (B,) [nat]; the measure is that of geometry.pose_density
    rank: Tensor  # (B,) share of the belief that is denser than the truth
    nonconformity: Tensor  # (B,) mean log density of the belief, less that at the truth [nat]


def score_truth(belief: BeliefBatch, truth: Tensor, object_model: ObjectModel) -> TruthScores:
    """Return the density of beliefs at the truth, and the share of each that is denser.

    The credible set of a level p holds the truth where the rank is below p.  If truths were drawn
    from the beliefs, ranks would be uniform on [0, 1].

    Args:
        belief: B beliefs.
        truth: (B, 4, 4) true poses.
        object_model: The object; its symmetries are known to the density.

    Returns:
        (B,) float64 each, on the CPU.
    """
    rows = []
    poses, log_weights = belief.poses.detach().cpu(), belief.log_weights.detach().cpu()
    for particles, weights, true in zip(poses, log_weights, truth.detach().cpu(), strict=True):
        normalized = weights.double().log_softmax(0)
        size = (float(object_model.radius), float(object_model.diameter))
        density = fit_density(
            particles, normalized, object_model.center.cpu(), *size, object_model.symmetries.cpu()
        )
        at_truth = log_density(density, true[None])[0]
        at_particles = log_density_held_out(density)
        weights = density.log_weights.exp()
        rank, mean = weights @ (at_particles > at_truth).double(), weights @ at_particles
        rows.append(torch.stack([at_truth, rank, mean - at_truth]))
    return TruthScores(*(torch.stack(rows) if rows else torch.zeros(0, 3)).double().T)


class CredibilityColumns(NamedTuple):
    """How the beliefs of N images see the truth: (N,) each."""

    log_density: Tensor  # as of `TruthScores`
    rank: Tensor
    nonconformity: Tensor
    visibility: Tensor  # share of the object that is visible, NaN where unknown


class Credibility(Rows[CredibilityColumns]):
    """The density of beliefs at the truth, and the coverage of credible sets, by visibility.

    log_density, log_density_p50: of the truth, mean and median [nat].  coverage_50, ...: percentage
    of the images whose credible set of that level holds the truth.  levels, all, quarters: curves.
    """

    columns = CredibilityColumns

    def update(self, scores: TruthScores, visibility: Tensor) -> None:
        """Accumulate scores (B,) with the objects' visible shares (B,), NaN where unknown."""
        self.append(CredibilityColumns(*scores, visibility.cpu()))

    def compute(self) -> dict[str, Any]:
        """Return the numbers; empty without images."""
        density, rank, _, visibility = self.all()
        if not len(rank):
            return {}
        median = float(np.median(density.numpy()))
        out = {"log_density": float(density.mean()), "log_density_p50": median}
        for percent in SHOWN:
            out[f"coverage_{percent}"] = 100 * measure_coverage(rank, percent / 100)
        return {**out, **trace_curves(rank, visibility)}


def trace_curves(rank: Tensor, visible: Tensor) -> dict[str, Any]:
    """Return the shares that the sets of each level cover, of all images and of each quarter of
    visibility that has any.  (M,) x 2.
    """
    quarters = []
    for low, high in QUARTERS:
        inside = lies_within(visible, low, high)
        if bool(inside.any()):
            quarter = {"from": low, "to": high, "instances": int(inside.sum())}
            quarters.append({**quarter, "coverage": trace_curve(rank[inside])})
    return {"levels": list(LEVELS), "all": trace_curve(rank), "quarters": quarters}


def trace_curve(rank: Tensor) -> list[float]:
    """Return the share of the truths that the sets of each of `LEVELS` hold.  (M,)."""
    return [measure_coverage(rank, level) for level in LEVELS]


def measure_coverage(rank: Tensor, level: float) -> float:
    """Return the share of the truths that the credible sets of a level hold.  (M,)."""
    # a rank is a sum of weights, and may be less than the level by rounding alone
    return float((rank < level - _ROUNDING).double().mean()) if len(rank) else math.nan
