"""The modes of a belief: the poses round which its weight gathers, and how much of it each has."""

from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.filters.estimate import kernel_mass
from posefilter.protocols import Space


class Modes(NamedTuple):
    """The modes of one cloud, the heaviest first; every particle belongs to one."""

    states: Tensor  # (M, *S) the densest particle of each
    weights: Tensor  # (M,) of the particles that belong to it; they sum to 1
    member: Tensor  # (N,) int64, which mode each particle belongs to


def find_modes(
    state: Tensor, log_weights: Tensor, space: Space, bandwidth: float, reach: float = 3.0
) -> Modes:
    """Split a weighted cloud into its modes by quick shift (Vedaldi & Soatto 2008).

    Every particle follows the nearest one in denser surroundings, if there is one within `reach`
    bandwidths; those that follow nobody are the modes. So a mode is always a particle, never a mean
    that nobody voted for, and no number of modes is asked for. (N, *S), (N,); bandwidth: of the
    Gaussian kernel, in the space's unit.
    """
    weights = torch.softmax(log_weights.double(), 0)
    density = kernel_mass(state[None], weights.log()[None], space, bandwidth)[0]
    order = torch.argsort(density, descending=True, stable=True)
    leader = _leaders(state[order], space, reach * bandwidth)
    # leaders have leaders: jump to the end of the chain
    while not torch.equal(leader, leader[leader]):
        leader = leader[leader]
    root, member = leader.unique(return_inverse=True)
    mass = torch.zeros(len(root), dtype=weights.dtype, device=weights.device).index_add(
        0, member, weights[order]
    )
    rank = torch.argsort(mass, descending=True, stable=True)
    back = torch.empty_like(member)
    back[order] = torch.argsort(rank)[member]
    return Modes(state[order][root[rank]], mass[rank], back)


def _leaders(state: Tensor, space: Space, far: float, chunk: int = 1 << 20) -> Tensor:
    """Return whom each particle, the densest first, follows: itself, where none before it is within
    `far`.  -> (N,).
    """
    number = torch.arange(len(state), device=state.device)
    parts = []
    for some in number.split(max(1, chunk // len(state))):
        distance = space.distance(state[some][:, None], state[None])
        distance = distance.masked_fill(number[None] >= some[:, None], torch.inf)
        least, nearest = distance.min(1)
        parts.append(torch.where(least <= far, nearest, some))
    return torch.cat(parts)
