"""Signs of failure of filters whose particles are pixels: what the paper's pictures show, as numbers.

Each function takes particles of several images and gives one number; NaN where the number has no meaning.
"""

import torch
from torch import Tensor

from posefilter.geometry.lookup import touches


def pairwise_cosine(motion: Tensor) -> Tensor:
    """Return the mean cosine between the displacements of two particles of one image.  (B, N, 2) -> (B,).

    1: all move in one direction, as if what they saw said nothing; about 0: each its own way. Particles that stand still
    do not count. From the length of the sum of unit vectors: |sum|^2 = n + sum over pairs.
    """
    length = motion.norm(dim=-1, keepdim=True)
    moving = (length > 1e-3).to(motion.dtype)
    total = (motion / length.clamp_min(1e-9) * moving).sum(1).square().sum(-1)
    n = moving.sum((1, 2))
    return torch.where(n > 1, (total - n) / (n * (n - 1)).clamp_min(1), torch.nan)


def explained(predicted: Tensor, true: Tensor) -> Tensor:
    """Return R2, the share of the true offsets' variance that the predicted ones explain.  (M, 2) x 2 -> ().

    0: no better than the mean offset; below 0: worse; 1: exact.
    """
    residual = (predicted - true).square().sum()
    variance = (true - true.mean(0)).square().sum()
    return torch.where(variance > 0, 1 - residual / variance.clamp_min(1e-12), torch.nan)


def heading(motion: Tensor, true: Tensor) -> Tensor:
    """Return the mean cosine between displacement and true offset, over particles off the object.  (M, 2) x 2 -> ()."""
    far = true.norm(dim=-1) > 1.0
    cosine = torch.nn.functional.cosine_similarity(motion[far], true[far], dim=-1)
    return cosine.mean() if len(cosine) else torch.tensor(torch.nan)


def auroc(score: Tensor, positive: Tensor) -> Tensor:
    """Return the chance that a positive outscores a negative, ties counting half.  (M,), (M,) bool -> ().

    Mann-Whitney's U from mid-ranks.
    """
    n, m = positive.sum(), (~positive).sum()
    if n == 0 or m == 0:
        return torch.tensor(torch.nan)
    _, inverse, counts = torch.unique(score.double(), return_inverse=True, return_counts=True)
    last = counts.cumsum(0).double()
    ranks = (last - (counts.double() - 1) / 2)[inverse]
    return ((ranks[positive].sum() - n * (n + 1) / 2) / (n * m)).float()


def on_object(state: Tensor, mask: Tensor, margin_px: int = 0) -> Tensor:
    """Return the share of particles within `margin_px` of the mask.  (B, N, 2) [px], (B, 1, H, W) bool -> (B,)."""
    return touches(mask, state, 2 * margin_px + 1).float().mean(1)


def off_frame(state: Tensor, width: int, height: int) -> Tensor:
    """Return the share of particles that left the frame.  (B, N, 2) [px] -> (B,)."""
    u, v = state.unbind(-1)
    return ((u < -0.5) | (u > width - 0.5) | (v < -0.5) | (v > height - 0.5)).float().mean(1)


def near_edge(state: Tensor, width: int, height: int, share: float = 0.05) -> tuple[Tensor, Tensor]:
    """Return the shares within `share` of the frame of an edge, and of a corner; off the frame counts as on its edge.

    (B, N, 2) [px] -> (B,), (B,).
    """
    u, v = (state[..., 0] + 0.5) / width, (state[..., 1] + 0.5) / height
    side_u, side_v = (u < share) | (u > 1 - share), (v < share) | (v > 1 - share)
    return (side_u | side_v).float().mean(1), (side_u & side_v).float().mean(1)
