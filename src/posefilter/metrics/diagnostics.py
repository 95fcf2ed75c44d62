"""Diagnostics of filters whose particles are pixels: known failure modes, as numbers.

Functions take the particles of several images; NaN marks an undefined value.
"""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from posefilter.geometry.lookup import is_off_frame, nearest_mask_pixel, overlaps_mask
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.collect import concat_state
from posefilter.types import Batch, Trace


def pairwise_cosine(displacement: Tensor) -> Tensor:
    """Return the mean cosine between displacements of two particles of one image.

    1: all move in one direction, independent of the image; about 0: no common direction. Particles
    that do not move are left out. Computed from |sum of unit vectors|^2 = n + sum over pairs.

    (B, N, 2) -> (B,).
    """
    length = displacement.norm(dim=-1, keepdim=True)
    moving = (length > 1e-3).to(displacement.dtype)
    total = (displacement / length.clamp_min(1e-9) * moving).sum(1).square().sum(-1)
    n = moving.sum((1, 2))
    return torch.where(n > 1, (total - n) / (n * (n - 1)).clamp_min(1), torch.nan)


def r2_score(predicted: Tensor, true: Tensor) -> Tensor:
    """Return R2, the coefficient of determination of predicted against true offsets.

    0: no better than the mean offset; below 0: worse; 1: exact.  (M, 2) x 2 -> ().
    """
    residual = (predicted - true).square().sum()
    variance = (true - true.mean(0)).square().sum()
    return torch.where(variance > 0, 1 - residual / variance.clamp_min(1e-12), torch.nan)


def offset_cosine(displacement: Tensor, true: Tensor) -> Tensor:
    """Return the mean cosine between displacement and true offset of particles off the object.

    (M, 2) x 2 -> ().
    """
    far = true.norm(dim=-1) > 1.0
    cosine = torch.nn.functional.cosine_similarity(displacement[far], true[far], dim=-1)
    return cosine.mean() if len(cosine) else torch.tensor(torch.nan)


def auroc(score: Tensor, positive: Tensor) -> Tensor:
    """Return the area under the ROC curve: P(positive outscores negative), ties counting half.

    Mann-Whitney's U from mid-ranks.  (M,), (M,) bool -> ().
    """
    n, m = positive.sum(), (~positive).sum()
    if n == 0 or m == 0:
        return torch.tensor(torch.nan)
    _, inverse, counts = torch.unique(score.double(), return_inverse=True, return_counts=True)
    last = counts.cumsum(0).double()
    ranks = (last - (counts.double() - 1) / 2)[inverse]
    return ((ranks[positive].sum() - n * (n + 1) / 2) / (n * m)).float()


def near_edge(state: Tensor, width: int, height: int, share: float = 0.05) -> tuple[Tensor, Tensor]:
    """Return the shares of particles near an edge and near a corner of the frame.

    Near means within `share` of the frame's size; particles off the frame count as near.

    (B, N, 2) [px] -> (B,), (B,).
    """
    u, v = (state[..., 0] + 0.5) / width, (state[..., 1] + 0.5) / height
    side_u, side_v = (u < share) | (u > 1 - share), (v < share) | (v > 1 - share)
    return (side_u | side_v).float().mean(1), (side_u & side_v).float().mean(1)


def distinct(state: Tensor, cell_px: float = 0.1) -> Tensor:
    """Return the share of distinct positions among the particles.

    Resampling copies particles, so few positions can stand for many particles (sample
    impoverishment).  (B, N, 2) [px] -> (B,).
    """
    cells = (state / cell_px).round()
    return torch.stack([cells.new_tensor(len(one.unique(dim=0)) / len(one)) for one in cells])


def first_axis_share(state: Tensor) -> Tensor:
    """Return the share of the particles' variance that lies along their first principal axis.

    1: all on one line, whatever its direction; 0.5: no direction is preferred. Particles that are
    uniform in a frame of 4:3 have 0.64. NaN where all particles coincide or are not finite. All
    particles count, those off the frame too.

    (B, N, 2) [px] -> (B,).
    """
    u, v = (state - state.mean(1, keepdim=True)).unbind(-1)
    uu, vv, uv = u.square().sum(1), v.square().sum(1), (u * v).sum(1)
    # the larger eigenvalue of [[uu, uv], [uv, vv]] over their sum; a solver would refuse infinities
    share = 0.5 + torch.hypot((uu - vv) / 2, uv) / (uu + vv).clamp_min(1e-12)
    return torch.where(uu + vv > 1e-6, share, torch.nan)


class FilterDiagnostics(Metric):
    """The diagnostics of this module over many traces: numbers, and lists with one number for each
    step.

    Lists: off_frame, near_edge, near_corner, on_object, distinct, first_axis_share. Numbers:
    pairwise_cosine, the mean over images and steps; offset_r2 and offset_cosine, of displacements
    against the true offset to the mask's nearest pixel; auroc of the likelihood, with particles on
    the mask as positives and others in the frame as negatives. The last three are over all steps.

    Args:
        max_particles: Maximum number of particles of an image and step for the last three.
        **kwargs: Arguments of torchmetrics.Metric.
    """

    full_state_update = False
    shares: list[Tensor]
    lines: list[Tensor]
    cosine: list[Tensor]
    offsets: list[Tensor]
    scored: list[Tensor]

    def __init__(self, max_particles: int = 256, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.max_particles = max_particles
        for name in ("shares", "lines", "cosine", "offsets", "scored"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, trace: Trace, batch: Batch) -> None:
        """Accumulate the trace of a batch."""
        height, width = batch.rgb.shape[-2:]
        steps, lines = [], []
        for particles, output in zip(trace.particles, trace.outputs, strict=True):
            edge, corner = near_edge(particles.state, width, height)
            on = on_object(batch.mask, particles.state)
            off = is_off_frame(particles.state, width, height).float().mean(1)
            steps.append(torch.stack([on, off, edge, corner, distinct(particles.state)]))
            lines.append(first_axis_share(particles.state))
            self.cosine.append(pairwise_cosine(output.displacement))
            state = particles.state[:, : self.max_particles]
            displacement = output.displacement[:, : self.max_particles]
            true = nearest_mask_pixel(batch.mask, state) - state
            self.offsets.append(torch.cat([displacement, true], dim=-1).flatten(0, 1).float())
            positive = overlaps_mask(batch.mask, state).float()
            scored = torch.stack(
                [output.log_likelihood[:, : self.max_particles].float(), positive], dim=-1
            )
            self.scored.append(scored[~is_off_frame(state, width, height)])
        self.shares.append(torch.stack(steps).permute(2, 0, 1))  # (B, T, 5)
        self.lines.append(torch.stack(lines).T)  # (B, T)

    def compute(self) -> dict[str, Any]:
        """Return the diagnostics by name; none where no image was seen."""
        if not len(self.shares):
            return {}
        shares = concat_state(self.shares).mean(0)
        offsets, scored = concat_state(self.offsets), concat_state(self.scored)
        names = ("on_object", "off_frame", "near_edge", "near_corner", "distinct")
        lists = zip(names, shares.T.tolist(), strict=True)
        displacement, true = offsets[:, :2], offsets[:, 2:]
        return dict(lists) | {
            "first_axis_share": concat_state(self.lines).nanmean(0).tolist(),
            "pairwise_cosine": float(concat_state(self.cosine).nanmean()),
            "offset_r2": float(r2_score(displacement, true)),
            "offset_cosine": float(offset_cosine(displacement, true)),
            "auroc": float(auroc(scored[:, 0], scored[:, 1] > 0)),
        }
