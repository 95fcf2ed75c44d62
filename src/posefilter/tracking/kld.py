"""KLD sampling: as many particles as the spread of a belief calls for.

References:
    Fox: Adapting the sample size in particle filters through KLD-sampling. International Journal of
        Robotics Research 22 (2003).
"""

import math
from statistics import NormalDist

import torch
from torch import Tensor

from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.spaces import PoseSpace


def kld_size(bins: int, epsilon: float, quantile: float) -> int:
    """Return how many particles describe a distribution over so many bins (Fox 2003, eq. 7).

    With that many independent draws the Kullback-Leibler divergence between the draws' histogram
    and the distribution is below `epsilon` with probability `quantile`: 2 n times the divergence is
    chi-squared with bins - 1 degrees of freedom, whose quantile is taken by Wilson and Hilferty.

    Args:
        bins: Bins that the distribution occupies, 1 or more.
        epsilon: Bound of the divergence [nat].
        quantile: Probability that it holds, in (0, 1).

    Returns:
        The number of particles, 1 or more.
    """
    if bins < 2:
        return 1
    a = 2 / (9 * (bins - 1))
    z = NormalDist().inv_cdf(quantile)
    return max(1, math.ceil((bins - 1) / (2 * epsilon) * (1 - a + math.sqrt(a) * z) ** 3))


def bin_poses(poses: Tensor, about: Tensor, space: PoseSpace, width: float) -> Tensor:
    """Return the cell of a grid in the tangent space that each pose lies in.

    The grid is centered on a pose, so that a belief narrower than a cell occupies one.

    Args:
        poses: (N, 4, 4) camera_from_object [m].
        about: (4, 4) the pose at the middle of the cell 0.
        space: Turns count as the shift at its radius.
        width: Side of a cell [m].

    Returns:
        Cells (N, 6) int64.
    """
    twist = twist_between(about, poses, poses.new_tensor(space.center))
    twist = torch.cat([twist[:, :3], twist[:, 3:] * space.radius], dim=1)
    return (twist / width).round().long()


def count_needed(cells: Tensor, epsilon: float, quantile: float, min_draws: int) -> int:
    """Return after how many draws there are enough: the loop of KLD sampling.

    Draws are taken one after the other; each may occupy a new cell, which raises the number that is
    needed. The first number of draws that is not below `kld_size` of the cells so far is enough.

    Args:
        cells: (N, D) int64, the cell of each draw, in their order.
        epsilon: Bound of the divergence [nat].
        quantile: Probability that it holds.
        min_draws: Number of draws below which there are never enough.

    Returns:
        The number of draws, from `min_draws` to N; N where more would be needed.
    """
    seen, count = set[tuple[int, ...]](), 0
    needed = min_draws
    for count, own in enumerate(map(tuple, cells.tolist()), start=1):
        if own not in seen:
            seen.add(own)
            needed = max(min_draws, kld_size(len(seen), epsilon, quantile))
        if count >= needed:
            break
    return count
