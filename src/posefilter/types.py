"""The data types of the pipeline: NamedTuples of tensors, which collate, move and unpack as such.

Letters: B images, N particles, T steps, L latent width, P points, *S the shape of one state: (2,) a
pixel, (4, 4) a pose. Units: meters, radians, pixels.  `a_from_b` maps b into a, so neighbors
cancel: camera_from_world @ world_from_object.
"""

from typing import Any, NamedTuple

from torch import Tensor


class Batch(NamedTuple):
    """One object in each of B images; poses refer to the frame of the object's mesh file."""

    rgb: Tensor  # (B, 3, H, W) in [0, 1]
    depth: Tensor  # (B, 1, H, W) z-depth [m], 0 where unknown
    mask: Tensor  # (B, 1, H, W) bool, the visible part of the object
    intrinsics: Tensor  # (B, 3, 3) [px]
    camera_from_object: Tensor  # (B, 4, 4) [m]
    object_id: Tensor  # (B,) int64, index into the data module's objects
    frame_id: Tensor  # (B,) int64, index into the split's frames
    visibility: Tensor  # (B,) visible share of the object's pixels, in [0, 1]; NaN where unknown


class ObjectModel(NamedTuple):
    """The object's geometry as plain tensors, so that a checkpoint can hold it."""

    name: str
    points: Tensor  # (P, 3) surface points that ADD is defined on [m], mesh frame
    center: Tensor  # (3,) center of the bounding box [m]
    radius: float  # half the bounding box's diagonal [m]
    diameter: float  # largest distance between two points [m]
    # (S, 4, 4) object_from_object symmetry transforms, the identity first
    symmetries: Tensor
    hull: Tensor  # (V, 3) vertices of a convex hull [m], for outlines
    # (P, 3) by part: the vertices of its hull, and points of its surface [m]; see meshes/parts.py
    parts: dict[str, Tensor] | None = None
    # (Q, 9) surface points [m], outward unit normals, colors in [0, 1]; None: an earlier version's
    texture: Tensor | None = None
    # (G, 4, 4) turns that move the shape onto itself, whatever the texture; the identity first
    shape_symmetries: Tensor | None = None


class Particles(NamedTuple):
    """Weighted particles: the filter's whole state between two steps."""

    state: Tensor  # (B, N, *S)
    latent: Tensor  # (B, N, L); L = 0 for methods without a latent
    log_weights: Tensor  # (B, N), normalized: logsumexp over N is 0
    ancestors: Tensor  # (B, N) int64, index of each particle's ancestor at the previous step


class Resampled(NamedTuple):
    """The result of resampling M particles: N children, each of one ancestor or a mixture of
    several.
    """

    ancestors: Tensor  # (B, N) int64, each child's ancestor; of a mixture, the largest
    log_weights: Tensor  # (B, N) the children's weights, normalized
    # (B, N, M) weights of the mixtures, rows sum to 1; None: each child has one ancestor
    mixture_weights: Tensor | None = None


class Fragments(NamedTuple):
    """Predicted object point of each particle's measured point: a distribution over surface
    fragments.
    """

    # (B, N, K) log-probability of each fragment, given that the point is on the object
    log_prob: Tensor
    # (B, N, K, 3) the object point in each fragment, from the object's center, in radii
    position: Tensor
    centers: Tensor  # (B, K, 3) the fragments' centers, likewise
    mean_radius: Tensor  # () the fragments' mean radius, in radii of the object


class ParticleOutput(NamedTuple):
    """The method's output for each particle at one step."""

    log_likelihood: Tensor  # (B, N), up to a constant for each image
    # (B, N, D) predicted displacement in the space's tangent; zeros if there is none
    displacement: Tensor
    pose: Tensor  # (B, N, 4, 4) predicted camera_from_object
    latent: Tensor  # (B, N, L)
    # of each particle's measured point; None if the method predicts poses only
    fragments: Fragments | None = None


class Step(NamedTuple):
    """One step of the filter."""

    number: int  # 0 for the first
    steps: int  # number of steps of the run
    # () or (B,) noise level, in the space's unit ([m] or [px])
    sigma: Tensor


class BeliefBatch(NamedTuple):
    """A filter's result for B images: weighted poses and a point estimate of each.

    What users get of one image is `posefilter.Belief`, in numpy.
    """

    poses: Tensor  # (B, N, 4, 4) camera_from_object
    log_weights: Tensor  # (B, N), normalized
    best: Tensor  # (B, 4, 4) the estimate
    # (B,) as ParticleFilter.score_is says, most often the log-likelihood of the estimate up to a
    # constant of each image: it ranks poses of one image, and is no confidence
    score: Tensor


class Trace(NamedTuple):
    """All steps of one run: particles, outputs and the belief."""

    particles: tuple[Particles, ...]
    outputs: tuple[ParticleOutput, ...]
    steps: tuple[Step, ...]
    belief: BeliefBatch
    # (B, T) log of the summed weights at each step; None if no filter made the trace
    log_evidence: Tensor | None = None
    # the encoded images, as the method's `encode` returned them; None if it is not kept
    encoding: Any = None
