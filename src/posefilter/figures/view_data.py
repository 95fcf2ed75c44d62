"""What the 3-D view shows, as plain arrays: a run of the filter on one image, in the camera's
frame.

Nothing here knows how it is displayed; figures/recording.py writes it to a file.
"""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.figures.canvas import to_image
from posefilter.figures.overlay import Shape, get_vertices
from posefilter.filters.modes import APART, find_pose_modes
from posefilter.geometry.camera import back_project, pixel_grid, project
from posefilter.geometry.pose import origin_of
from posefilter.geometry.spaces import PoseSpace
from posefilter.geometry.symmetries import densify, gather_copies
from posefilter.meshes.mesh import Mesh, creased_normals, face_normals, find_hull
from posefilter.protocols import Space
from posefilter.types import Batch, ObjectModel, Trace

_GREY = 170

_LEAST = 0.01  # of the weight: lighter modes are not shown
_MOST = 8  # modes that are shown, the estimate's not counted


class Moment(NamedTuple):
    """The particles at one of the filter's steps, or at the end."""

    poses: np.ndarray  # (N, 4, 4) camera_from_object that the particles stand for
    centers: np.ndarray  # (N, 3) where these put the object's center [m]
    pixels: np.ndarray  # (N, 2) where the particles are in the image [px]
    weights: np.ndarray  # (N,), summing to 1
    effective: float  # effective sample size over the number of particles
    sigma: float | None  # noise level of the step; None at the end


class Hypothesis(NamedTuple):
    """A pose that the belief holds for possible."""

    pose: np.ndarray  # (4, 4) camera_from_object
    weight: float  # share of the belief's weight


class Cloud(NamedTuple):
    """Pixels whose depth is known, as points."""

    points: np.ndarray  # (P, 3) back-projected [m]
    colors: np.ndarray  # (P, 3) uint8
    footprints: np.ndarray  # (P,) distance between neighbors at that depth [m]


class ViewData(NamedTuple):
    """All that is shown of one image."""

    name: str  # of the object
    rgb: np.ndarray  # (H, W, 3) uint8, as the filter saw it
    K: np.ndarray  # (3, 3) [px], pixel centers at integers
    cloud: Cloud
    mesh: Mesh
    center: np.ndarray  # (3,) of the object, in its own frame [m]
    radius: float  # of the object [m]
    unit: str  # of the noise level: "px", or "mm" where particles are poses
    moments: tuple[Moment, ...]  # one a step of the filter, then the belief
    estimate: Hypothesis  # as refined; its weight is that of the mode it belongs to
    others: tuple[Hypothesis, ...]  # the other modes, the heaviest first
    left_out: float  # share of the weight in modes too light to be shown
    score: float


def collect_view_data(
    trace: Trace,
    batch: Batch,
    object_model: ObjectModel,
    space: Space,
    shape: Shape,
    image: int = 0,
    draws: int | None = None,
) -> ViewData:
    """Gather what is shown of one of a trace's images.

    Args:
        trace: A finished run of the filter.
        batch: Its images.
        object_model: The object.
        space: Of the particles.
        shape: The object's mesh, or the vertices of its hull [m].
        image: Which of the images.
        draws: How many of the first poses of the trace's belief are draws about the estimate; None:
            it is not calibrated, and its poses are those of the last particles.
    """
    K = batch.intrinsics[image].detach().cpu().double()
    center = object_model.center.detach().cpu().double()
    rgb, depth = to_image(batch.rgb[image]), batch.depth[image, 0].detach().cpu().numpy()
    belief = trace.belief
    poses, best = (x[image].detach().cpu().double() for x in (belief.poses, belief.best))
    estimate, others, left_out, *_ = find_hypotheses(
        poses, belief.log_weights[image].detach().cpu(), best, object_model, draws or 0
    )
    unit = 1000.0 if isinstance(space, PoseSpace) else 1.0
    moments = []
    for particles, output, step in zip(trace.particles, trace.outputs, trace.steps, strict=True):
        pixels = None if isinstance(space, PoseSpace) else particles.state[image]
        sigma = float(step.sigma if step.sigma.ndim == 0 else step.sigma[image]) * unit
        moments.append(
            make_moment(output.pose[image], particles.log_weights[image], pixels, center, K, sigma)
        )
    at_centers = draws is not None or isinstance(space, PoseSpace)
    last = None if at_centers else trace.particles[-1].state[image]
    moments.append(
        make_moment(belief.poses[image], belief.log_weights[image], last, center, K, None)
    )
    return ViewData(
        name=object_model.name,
        rgb=rgb,
        K=K.numpy(),
        cloud=make_cloud(rgb, depth, K.numpy()),
        mesh=make_mesh(shape, object_model.name),
        center=center.numpy(),
        radius=object_model.radius,
        unit="mm" if isinstance(space, PoseSpace) else "px",
        moments=tuple(moments),
        estimate=estimate,
        others=others,
        left_out=left_out,
        score=float(belief.score[image]),
    )


def make_moment(
    poses: Tensor,
    log_weights: Tensor,
    pixels: Tensor | None,
    center: Tensor,
    K: Tensor,
    sigma: float | None,
) -> Moment:
    """Return the particles of one step.

    (N, 4, 4), (N,), (N, 2) [px]; pixels None: where the poses put the center.
    """
    poses = poses.detach().cpu().double()
    weights = torch.softmax(log_weights.detach().cpu().double(), 0)
    centers = origin_of(poses, center)
    at = project(centers, K) if pixels is None else pixels.detach().cpu().double()
    effective = float(1 / weights.square().sum() / len(weights))
    return Moment(poses.numpy(), centers.numpy(), at.numpy(), weights.numpy(), effective, sigma)


def make_cloud(rgb: np.ndarray, depth: np.ndarray, K: np.ndarray, every: int = 1) -> Cloud:
    """Back-project the pixels whose depth is known.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) [m].
        K: (3, 3) [px].
        every: Only each so many-th row and column.
    """
    z = np.where(np.isfinite(depth), depth, 0)[::every, ::every]
    known = z > 0
    pixels = pixel_grid(*depth.shape)[::every, ::every].double()[torch.from_numpy(known)]
    away = torch.from_numpy(z[known]).double()
    points = back_project(pixels, away, torch.from_numpy(np.asarray(K, np.float64))).numpy()
    return Cloud(points, rgb[::every, ::every][known], every * points[:, 2] / float(K[0, 0]))


class Hypotheses(NamedTuple):
    """What a belief holds for possible."""

    estimate: Hypothesis  # its weight is that of the mode it belongs to
    others: tuple[Hypothesis, ...]  # the other modes, the heaviest first
    left_out: float  # share of the weight in modes too light to be shown
    own: Tensor  # (N,) bool, which particles belong to the estimate's mode
    poses: Tensor  # (N, 4, 4) of each particle the equivalent pose that is nearest to the estimate


def find_hypotheses(
    poses: Tensor, log_weights: Tensor, best: Tensor, object_model: ObjectModel, draws: int = 0
) -> Hypotheses:
    """Return the estimate, the belief's other modes, and the weight in modes too light to be shown.

    The estimate stands for the mode of the particle nearest to it, and has that one's weight; where
    no particle is within a tenth of the diameter (a refinement led away from them all) it has none.
    The draws of a calibrated belief are its mode, however far apart.
    Poses that a symmetry makes of one another are one.
    (N, 4, 4), (N,), (4, 4); draws: so many of the first poses are draws about the estimate.
    """
    center, group = (x.detach().to(poses) for x in (object_model.center, object_model.symmetries))
    poses = gather_copies(poses, best, center, object_model.radius, densify(group))
    space = PoseSpace((*object_model.center.tolist(),), object_model.radius)
    weights = torch.softmax(log_weights.double(), 0)
    members, left = torch.arange(len(poses)) < draws, float(weights[draws:].sum())
    found: list[Hypothesis] = []
    if left > 0:
        modes = find_pose_modes(poses[draws:], log_weights[draws:], space, object_model.diameter)
        pairs = zip(modes.states, modes.weights, strict=True)
        found = [Hypothesis(pose.numpy(), left * float(mass)) for pose, mass in pairs]
        if not draws:
            distance, nearest = space.distance(poses, best).min(0)
            if float(distance) <= APART * object_model.diameter:
                own = int(modes.member[nearest])
                members = modes.member == own
                found.pop(own)
    others = tuple([one for one in found if one.weight >= _LEAST][:_MOST])
    estimate = Hypothesis(best.numpy(), float(weights[members].sum()))
    left_out = sum(one.weight for one in found) - sum(one.weight for one in others)
    return Hypotheses(estimate, others, max(0.0, left_out), members, poses)


def make_mesh(shape: Shape, name: str) -> Mesh:
    """Return the mesh to be shown: the object's own, or its convex hull in plain gray."""
    if isinstance(shape, Mesh):
        return shape
    vertices = get_vertices(shape).astype(np.float64)
    hull = find_hull(vertices)
    faces = hull.simplices.astype(np.int64)
    # Qhull's triangles turn either way
    inward = (face_normals(vertices, faces) * hull.equations[:, :3]).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    plain = np.full((1, 1, 3), _GREY, np.uint8)
    return Mesh(name, vertices, faces, None, plain, None, creased_normals(vertices, faces))
