"""Signs of failure of filters whose particles are pixels: what the paper's pictures show, as
numbers.

Each function takes particles of several images and gives one number; NaN where the number has no
meaning.
"""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from posefilter.geometry.lookup import nearest_true, touches
from posefilter.metrics.beliefs import on_object
from posefilter.metrics.collect import joined
from posefilter.types import Batch, Trace


def pairwise_cosine(displacement: Tensor) -> Tensor:
    """Return the mean cosine between the displacements of two particles of one image.  (B, N, 2) ->
    (B,).

    1: all move in one direction, as if what they saw said nothing; about 0: each its own way.
    Particles that stand still do not count. From the length of the sum of unit vectors: |sum|^2 = n
    + sum over pairs.
    """
    length = displacement.norm(dim=-1, keepdim=True)
    moving = (length > 1e-3).to(displacement.dtype)
    total = (displacement / length.clamp_min(1e-9) * moving).sum(1).square().sum(-1)
    n = moving.sum((1, 2))
    return torch.where(n > 1, (total - n) / (n * (n - 1)).clamp_min(1), torch.nan)


def explained(predicted: Tensor, true: Tensor) -> Tensor:
    """Return R2, the share of the true offsets' variance that the predicted ones explain.  (M, 2) x
    2 -> ().

    0: no better than the mean offset; below 0: worse; 1: exact.
    """
    residual = (predicted - true).square().sum()
    variance = (true - true.mean(0)).square().sum()
    return torch.where(variance > 0, 1 - residual / variance.clamp_min(1e-12), torch.nan)


def heading(displacement: Tensor, true: Tensor) -> Tensor:
    """Return the mean cosine between displacement and true offset, over particles off the object.

    (M, 2) x 2 -> ().
    """
    far = true.norm(dim=-1) > 1.0
    cosine = torch.nn.functional.cosine_similarity(displacement[far], true[far], dim=-1)
    return cosine.mean() if len(cosine) else torch.tensor(torch.nan)


def auroc(score: Tensor, positive: Tensor) -> Tensor:
    """Return the chance that a positive outscores a negative, ties counting half.  (M,), (M,) bool
    -> ().

    Mann-Whitney's U from mid-ranks.
    """
    n, m = positive.sum(), (~positive).sum()
    if n == 0 or m == 0:
        return torch.tensor(torch.nan)
    _, inverse, counts = torch.unique(score.double(), return_inverse=True, return_counts=True)
    last = counts.cumsum(0).double()
    ranks = (last - (counts.double() - 1) / 2)[inverse]
    return ((ranks[positive].sum() - n * (n + 1) / 2) / (n * m)).float()


def left(state: Tensor, width: int, height: int) -> Tensor:
    """Tell which particles are off the frame.  (B, N, 2) [px] -> (B, N) bool."""
    u, v = state.unbind(-1)
    return (u < -0.5) | (u > width - 0.5) | (v < -0.5) | (v > height - 0.5)


def off_frame(state: Tensor, width: int, height: int) -> Tensor:
    """Return the share of particles that left the frame.  (B, N, 2) [px] -> (B,)."""
    return left(state, width, height).float().mean(1)


def near_edge(state: Tensor, width: int, height: int, share: float = 0.05) -> tuple[Tensor, Tensor]:
    """Return the shares within `share` of the frame of an edge, and of a corner; off the frame
    counts as on its edge.

    (B, N, 2) [px] -> (B,), (B,).
    """
    u, v = (state[..., 0] + 0.5) / width, (state[..., 1] + 0.5) / height
    side_u, side_v = (u < share) | (u > 1 - share), (v < share) | (v > 1 - share)
    return (side_u | side_v).float().mean(1), (side_u & side_v).float().mean(1)


def distinct(state: Tensor, cell_px: float = 0.1) -> Tensor:
    """Return the share of particles with a place of their own: copies of one another count once.
    (B, N, 2) [px] -> (B,).

    Resampling copies the likely particles, so a cloud of which all are on the object may be a few
    places many times over.
    """
    cells = (state / cell_px).round()
    return torch.stack([cells.new_tensor(len(one.unique(dim=0)) / len(one)) for one in cells])


class SignsOfFailure(Metric):
    """All of the above over many runs of a filter: numbers, and lists with one number a step.

    off_frame, near_edge, near_corner, on_object, distinct: lists; pairwise_cosine: mean over images
    and steps; offset_r2, heading: displacements against the true offset to the mask's nearest
    pixel; auroc: of the likelihood, particles on the mask being the positives, those in the rest of
    the frame the negatives: who left it sees nothing, and to tell that is no skill. The last three
    are over all steps.
    """

    full_state_update = False
    shares: list[Tensor]
    cosine: list[Tensor]
    offsets: list[Tensor]
    judged: list[Tensor]

    def __init__(self, most: int = 256, **kwargs: Any) -> None:
        """most: particles of an image that are kept a step."""
        super().__init__(**kwargs)
        self.most = most
        for name in ("shares", "cosine", "offsets", "judged"):
            self.add_state(name, default=[], dist_reduce_fx="cat")

    def update(self, trace: Trace, batch: Batch) -> None:
        """Collect a run."""
        height, width = batch.rgb.shape[-2:]
        kinds = []
        for particles, output in zip(trace.particles, trace.outputs, strict=True):
            edge, corner = near_edge(particles.state, width, height)
            on, off = (
                on_object(batch.mask, particles.state),
                off_frame(particles.state, width, height),
            )
            kinds.append(torch.stack([on, off, edge, corner, distinct(particles.state)]))
            self.cosine.append(pairwise_cosine(output.displacement))
            some, displacement = (
                particles.state[:, : self.most],
                output.displacement[:, : self.most],
            )
            true = nearest_true(batch.mask, some) - some
            self.offsets.append(torch.cat([displacement, true], dim=-1).flatten(0, 1).float())
            positive = touches(batch.mask, some).float()
            judged = torch.stack([output.log_likelihood[:, : self.most].float(), positive], dim=-1)
            self.judged.append(judged[~left(some, width, height)])
        self.shares.append(torch.stack(kinds).permute(2, 0, 1))  # (B, T, 5)

    def compute(self) -> dict[str, Any]:
        """Return the signs by name."""
        shares, offsets, judged = (
            joined(self.shares).mean(0),
            joined(self.offsets),
            joined(self.judged),
        )
        names = ("on_object", "off_frame", "near_edge", "near_corner", "distinct")
        lists = zip(names, shares.T.tolist(), strict=True)
        displacement, true = offsets[:, :2], offsets[:, 2:]
        return dict(lists) | {
            "pairwise_cosine": float(joined(self.cosine).nanmean()),
            "offset_r2": float(explained(displacement, true)),
            "heading": float(heading(displacement, true)),
            "auroc": float(auroc(judged[:, 0], judged[:, 1] > 0)),
        }
