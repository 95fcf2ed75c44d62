"""What flows through posefilter.  Plain NamedTuples of tensors: they collate, move and unpack as
they are.

Letters: B images, N particles, T steps, L latent width, P points, *S the shape of one state: (2,) a
pixel, (4, 4) a pose. Units: meters, radians, pixels.  `a_from_b` maps b into a, so neighbors
cancel: camera_from_world @ world_from_object.
"""

from typing import NamedTuple

from torch import Tensor


class Batch(NamedTuple):
    """One object of interest in each of B images, in the frame of the object's own mesh file."""

    rgb: Tensor  # (B, 3, H, W) in [0, 1]
    depth: Tensor  # (B, 1, H, W) z-depth [m], 0 where unknown
    mask: Tensor  # (B, 1, H, W) bool, the visible part of the object
    intrinsics: Tensor  # (B, 3, 3) [px]
    camera_from_object: Tensor  # (B, 4, 4) [m]
    object_id: Tensor  # (B,) int64, index into the data module's objects
    frame_id: Tensor  # (B,) int64, index into the split's frames
    visibility: Tensor  # (B,) visible share of the object's pixels, in [0, 1]; NaN where unknown


class ObjectModel(NamedTuple):
    """What a method may know of the object: a few plain tensors, so that a checkpoint can carry
    them.
    """

    name: str
    points: Tensor  # (P, 3) surface points that ADD is defined on [m], mesh frame
    center: Tensor  # (3,) center of the bounding box [m]
    radius: float  # half the bounding box's diagonal [m]
    diameter: float  # largest distance between two points [m]
    # (S, 4, 4) object_from_object transforms that change nothing, the identity first
    symmetries: Tensor
    hull: Tensor  # (V, 3) vertices of a convex hull [m], for outlines


class Particles(NamedTuple):
    """All that a filter remembers from one step to the next."""

    state: Tensor  # (B, N, *S)
    latent: Tensor  # (B, N, L), the latent; L = 0 where a method has none
    log_weights: Tensor  # (B, N), normalized: logsumexp over N is 0
    ancestors: Tensor  # (B, N) int64, each particle's parent in the previous cloud


class Resampled(NamedTuple):
    """What a resampling made of a weighted cloud of M: N children, each of one parent, or a mix of
    several.
    """

    ancestors: Tensor  # (B, N) int64, each child's (main) parent
    log_weights: Tensor  # (B, N) that the children start with, normalized
    # (B, N, M) how much of each parent a child is, rows sum to 1; None: all of its one parent
    shares: Tensor | None = None


class Fragments(NamedTuple):
    """Which point of the object each particle's own measured point may be: a fragment of the
    surface, and where in it.
    """

    # (B, N, K) log-probability of each fragment, given that the point is the object's
    log_share: Tensor
    # (B, N, K, 3) the object's point if it is that fragment, over the radius, from the object's
    # center
    place: Tensor
    centers: Tensor  # (B, K, 3) the fragments' middles, likewise
    reach: Tensor  # () the fragments' mean reach, over the radius


class ParticleOutput(NamedTuple):
    """What a method makes of each particle at one step."""

    log_likelihood: Tensor  # (B, N), up to a constant an image
    # (B, N, D) learned displacement in the space's tangent; zeros where the filter only diffuses
    displacement: Tensor
    pose: Tensor  # (B, N, 4, 4) camera_from_object that the particle stands for
    latent: Tensor  # (B, N, L)
    # of the particles' own points; None where a method tells no more than `pose`
    fragments: Fragments | None = None


class Step(NamedTuple):
    """Where in its run the filter stands."""

    number: int  # 0 for the first cloud
    steps: int  # how many clouds there will be
    # () or (B,) noise level, in the space's unit ([m] or [px]); falls where the filter anneals
    sigma: Tensor


class Belief(NamedTuple):
    """The filter's last word: weighted poses, and the one pose that it would bet on."""

    poses: Tensor  # (B, N, 4, 4) camera_from_object
    log_weights: Tensor  # (B, N), normalized
    best: Tensor  # (B, 4, 4) the estimate
    score: Tensor  # (B,) confidence in the estimate, comparable between images of one method


class Trace(NamedTuple):
    """Every step of one run: the clouds, what was read of them, and the belief at the end."""

    particles: tuple[Particles, ...]
    outputs: tuple[ParticleOutput, ...]
    steps: tuple[Step, ...]
    belief: Belief
    # (B, T) log of the mean weight at each step; None where no filter made the trace
    log_evidence: Tensor | None = None
