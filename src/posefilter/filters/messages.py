"""Message passing between the parts of an object, on particles.

Each part has particles of its own, and what it thinks of them is its unary potential. What the
other parts think of them comes by pull messages (Desingh, Lu, Opipari and Jenkins: Efficient
nonparametric belief propagation for pose estimation and manipulation of articulated objects.
Science Robotics 4, 2019; for tools: Pavlasek, Lewis, Desingh and Jenkins, IROS 2020): each particle
of a part asks the weighted particles of another how well their poses agree with its own,

    m_ts(x_s^i) = sum_j w_t^j psi(x_s^i, x_t^j)
    belief(x_s^i) ~ unary(x_s^i) prod_t m_ts(x_s^i)

The weights are of the sender's unary potential alone. Of two parts that is exact belief
propagation. Of more, each part's belief is that of a star about it: nothing counts twice.

The tools are rigid. So a particle of a part is a pose of the whole object, as the part sees it, and
two parts agree where their poses are the same.
"""

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Generator, Tensor

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.resample import normalize_log_weights
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import angle_of_chord
from posefilter.geometry.spaces import PartsSpace
from posefilter.protocols import Resample, Space
from posefilter.types import Particles, Resampled


def log_kernel(
    receiver: Tensor, sender: Tensor, joint: Tensor, shift: Tensor, turn: Tensor
) -> Tensor:
    """Return how well poses of two parts agree: a Gaussian of shift and angle, 1 for equal poses.

    The shift is that of the joint, so that a small turn about it costs little: it leaves the parts
    joined.

    Args:
        receiver: (B, N, 4, 4) camera_from_object [m], as one part sees it.
        sender: (B, M, 4, 4) camera_from_object [m], as the other sees it.
        joint: (3,) the point where the parts meet, in the object's frame [m].
        shift: () or (B, 1, 1) standard deviation of the joint's shift [m].
        turn: () or (B, 1, 1) standard deviation of the angle between the poses [rad].

    Returns:
        Log potentials (B, N, M), at most 0.
    """
    exact = "donot_use_mm_for_euclid_dist"  # products would round small distances
    one, other = origin_of(receiver, joint), origin_of(sender, joint)
    distance = torch.cdist(one, other, compute_mode=exact)
    chord = torch.cdist(
        rotation_of(receiver).flatten(2), rotation_of(sender).flatten(2), compute_mode=exact
    )
    angle = angle_of_chord(chord)
    return -0.5 * ((distance / shift).square() + (angle / turn).square())


def pull_message(log_potential: Tensor, log_weights: Tensor) -> Tensor:
    """Return the log message at each of the receiver's particles.

    Args:
        log_potential: (B, N, M) between the receiver's and the sender's particles.
        log_weights: (B, M) of the sender's particles; they are normalized here.

    Returns:
        (B, N).
    """
    return (log_potential + log_weights.log_softmax(1)[:, None]).logsumexp(2)


def pass_messages(
    log_unary: Tensor,
    states: Tensor,
    blocks: Sequence[slice],
    joints: Tensor,
    shift: Tensor,
    turn: Tensor,
) -> Tensor:
    """Return the log beliefs of all parts' particles, up to a constant of each image.

    Unary potentials of two parts differ by what is known of neither. So a message carries the mean
    of its sender's potential, too: beliefs of different parts can then be compared, and two parts
    have the same mass where they have as many particles.

    Args:
        log_unary: (B, N) each particle's log-likelihood of its own part.
        states: (B, N, 4, 4) camera_from_object [m].
        blocks: Which particles are of each of the K parts.
        joints: (K, K, 3) where two parts meet, in the object's frame [m].
        shift: () or (B, 1, 1) standard deviation at the joint [m].
        turn: () or (B, 1, 1) standard deviation of the angle [rad].

    Returns:
        (B, N).
    """
    beliefs = []
    for s, own in enumerate(blocks):
        belief = log_unary[:, own]
        for t, other in enumerate(blocks):
            sent = log_unary[:, other]
            if t == s or sent.shape[1] == 0:
                continue
            potential = log_kernel(states[:, own], states[:, other], joints[s, t], shift, turn)
            log_mean = sent.logsumexp(1, keepdim=True) - math.log(sent.shape[1])
            belief = belief + pull_message(potential, sent) + log_mean
        beliefs.append(belief)
    return torch.cat(beliefs, dim=1)


class WithinParts:
    """Resample within each part's particles, so that a part keeps its number and its weight.

    The choice `filter/resample=within_parts`.

    Args:
        resampler: The scheme that draws the ancestors of each part.
    """

    provides: ClassVar[Capabilities] = ("within_parts",)
    requires: ClassVar[Capabilities] = ("parts",)

    def __init__(self, resampler: Resample) -> None:
        self.resampler = resampler

    def __call__(
        self, particles: Particles, count: int, space: Space, generator: Generator
    ) -> Resampled:
        """Return children; those of a part follow one another.

        Raises:
            UserError: The scheme mixes particles.
        """
        assert isinstance(space, PartsSpace)  # of what `requires` says
        ancestors, log_weights = [], []
        old = space.split(particles.log_weights.shape[1])
        for block, new in zip(old, space.split(count), strict=True):
            part, log_part = normalize_log_weights(Particles(*(x[:, block] for x in particles)))
            drawn = self.resampler(part, new.stop - new.start, space, generator)
            if drawn.mixture_weights is not None:
                raise UserError("filter/resample=within_parts needs a scheme that draws ancestors")
            ancestors.append(drawn.ancestors + block.start)
            log_weights.append(drawn.log_weights + log_part)
        return Resampled(torch.cat(ancestors, dim=1), torch.cat(log_weights, dim=1))
