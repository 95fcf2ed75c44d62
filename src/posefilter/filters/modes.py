"""The modes of a belief: the poses around which its weight concentrates."""

from typing import NamedTuple

import torch
from torch import Tensor

from posefilter.filters.estimate import kernel_mass
from posefilter.protocols import Space

# of the diameter: nearer poses belong to one mode, as in the recall of ADD < 0.1 d
APART = 0.1
_CHUNK = 1 << 20  # distances that are computed at a time


class Modes(NamedTuple):
    """The modes of one set of particles, by falling weight; every particle belongs to one."""

    states: Tensor  # (M, *S) the particle of highest density of each
    weights: Tensor  # (M,) total weight of its particles; sums to 1
    member: Tensor  # (N,) int64, which mode each particle belongs to


def find_modes(
    state: Tensor, log_weights: Tensor, space: Space, bandwidth: float, max_distance: float = 3.0
) -> Modes:
    """Cluster weighted particles by quick shift (Vedaldi and Soatto 2008).

    Each particle follows the nearest particle of higher kernel density within `max_distance`
    bandwidths. Particles that follow none are the modes, so a mode is always a particle. The number
    of modes need not be known.

    Args:
        state: (N, *S) particles.
        log_weights: (N,), normalized here.
        space: The space of the particles.
        bandwidth: Of the Gaussian kernel, in the space's unit.
        max_distance: Largest distance to a leader, in bandwidths.

    Returns:
        The modes, by falling weight.
    """
    weights = torch.softmax(log_weights.double(), 0)
    density = kernel_mass(state[None], weights.log()[None], space, bandwidth)[0]
    order = torch.argsort(density, descending=True, stable=True)
    leader = _find_leaders(state[order], space, max_distance * bandwidth)
    # pointer jumping: follow each chain to its root
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


def find_pose_modes(poses: Tensor, log_weights: Tensor, space: Space, diameter: float) -> Modes:
    """Find the modes of a belief over poses.

    Two particles belong to one mode where a chain of particles of ever higher density, each within
    a tenth of the diameter of the next, leads from one to the other.

    Args:
        poses: (N, 4, 4) [m].
        log_weights: (N,).
        space: The space of poses about the object's center.
        diameter: The object's diameter [m].
    """
    return find_modes(poses, log_weights, space, bandwidth=APART * diameter / 3, max_distance=3.0)


def _find_leaders(state: Tensor, space: Space, max_distance: float) -> Tensor:
    """Return the index of the particle that each one follows, itself if there is none.  -> (N,).

    Particles are sorted by falling density, so only earlier ones are candidates.
    """
    index = torch.arange(len(state), device=state.device)
    leaders = []
    for block in index.split(max(1, _CHUNK // len(state))):
        distance = space.distance(state[block][:, None], state[None])
        distance = distance.masked_fill(index[None] >= block[:, None], torch.inf)
        shortest, nearest = distance.min(1)
        leaders.append(torch.where(shortest <= max_distance, nearest, block))
    return torch.cat(leaders)
