"""Which rotation of a shape fits the colors of the image, by the texture alone.

A learned likelihood and the depth hardly tell the turns of a can apart, where only texture does.
Here the colors that the mesh has are compared with those that the image shows, without learning.
"""

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor
from torch.utils.weak import WeakIdKeyDictionary

from posefilter.capabilities import Capabilities
from posefilter.errors import UserError
from posefilter.filters.refine import object_of
from posefilter.filters.resample import inverse_cdf
from posefilter.geometry.camera import project
from posefilter.geometry.lookup import gather_pixels, nearest_pixel, sample
from posefilter.geometry.pose import origin_of, rotation_of, transform
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Encoding, HasColor, Method, ScoresPoses
from posefilter.types import BeliefBatch, ObjectModel

DARK = 0.03  # added to colors before the logarithm, so that black does not decide
_GRAZING = 0.25  # cosine of the angle between a surface and the way to the camera
_NEAR = (0.004, 0.03)  # [m, diameters] between a point and what is measured at its pixel
_BLUR = 0.33  # of the distance between neighboring points
_SHARPEST = 0.5  # [px]
_INDEPENDENT = 0.4  # share of the points that see something of their own
_PIXELS = 2.0  # that a point needs for itself
_LARGEST = 0.99  # correlation
_COARSE = 800  # textured points, by which turns are compared
_WALL = 0.05  # of the diameter: how far apart the two sides of a thin wall count
_SHIFT = 0.002  # [focal lengths], a pixel of the width at which networks see
_MOST = 12  # turns that are compared with shifts
_BESIDE = 5  # turns beside one that is tried first, and itself
_APART = 10.0  # [degrees] between the turns that are tried first
LEARNED_PIXELS = 256  # image points of a learned score that is added to the evidence
LEARNED_SIGMA = 0.004  # [m] its noise level
_MISSING = (
    "filter/refine: the checkpoint carries no texture of '{name}', as those of earlier versions; "
    "choose filter/refine=mean_shift_icp, or train again"
)
_OWN = 0.2  # [diameters] a particle that is farther from every turn is of another place


# the coarser textures of objects' textures, by number of points: as long as those are there
_COARSENED: MutableMapping[Tensor, dict[int, Tensor]] = WeakIdKeyDictionary()


class Print(NamedTuple):
    """An object's textured points."""

    points: Tensor  # (P, 3) [m]
    normals: Tensor  # (P, 3) unit
    color: Tensor  # (P, 3) logarithm
    spacing: float  # [m] between neighbors


def measure_texture(
    poses: Tensor, encoding: HasColor, object_model: ObjectModel, shift: float = _SHIFT
) -> Tensor:
    """Return how much better the object's texture explains the image than plain shading does.

    With y the logarithm of the image's colors at the surface points that are seen, and x that of
    the object's, a regression y = shading + gain x is compared with y = shading, where the shading
    is linear in the normal. The ratio of their maximum likelihoods depends on the partial
    correlation r of x and y alone: n / 2 times -log(1 - r^2), for n independent points. Exposure,
    white balance and a light from anywhere change nothing. A plain object has 0 at every pose.

    Args:
        poses: (B, C, 4, 4) camera_from_object [m].
        encoding: B images with color and depth.
        object_model: The object.
        shift: The best of nine shifts of the image counts, which lie so far apart [focal lengths],
            since fine texture does not correlate where a pose is a millimeter off. 0: none.

    Returns:
        Log-likelihood ratios (B, C) [nat], 0 or more.

    Raises:
        UserError: The object has no texture.
    """
    texture = read_print(object_model, poses)
    images = zip(
        poses, encoding.measured_color, encoding.measured_depth, encoding.intrinsics, strict=True
    )
    return torch.stack([_compare(*image, texture, object_model, shift) for image in images])


def read_print(object_model: ObjectModel, like: Tensor | None = None) -> Print:
    """Return an object's textured points, as `like` is.

    Raises:
        UserError: The object has no texture.
    """
    if object_model.texture is None:
        raise UserError(_MISSING.format(name=object_model.name))
    texture = object_model.texture.float() if like is None else object_model.texture.to(like)
    # by a sphere's area: a cylinder's or a box's differs by less than matters for a blur
    spacing = object_model.radius * (4 * torch.pi / 3 / len(texture)) ** 0.5
    return Print(texture[:, :3], texture[:, 3:6], (texture[:, 6:] + DARK).log(), spacing)


def coarsen_texture(object_model: ObjectModel, most: int = _COARSE) -> ObjectModel:
    """Return the object with `most` textured points at most, each with the mean color of those
    around it: enough to tell turns apart, in a fraction of the time.
    """
    texture = object_model.texture
    if texture is None or len(texture) <= most:
        return object_model
    by_count = _COARSENED.setdefault(texture, {})
    if most not in by_count:
        # a point on the other side of a thin wall is not near
        by_count[most] = _average(texture, most, _WALL * object_model.diameter)
    return object_model._replace(texture=by_count[most])


def _average(texture: Tensor, most: int, side: float) -> Tensor:
    """Return some textured points, each with the mean color of those nearest to it.

    Args:
        texture: (P, 9) point, normal, color.
        most: How many.
        side: By which opposite sides of the surface count as apart [m].

    Returns:
        (most, 9).
    """
    places = torch.cat([texture[:, :3], side * texture[:, 3:6]], dim=1).float()
    # every so many: points are drawn face by face, and the first ones are of some faces alone
    chosen = torch.arange(most, device=texture.device) * len(texture) // most
    nearest = torch.cdist(places, places[chosen]).argmin(1)
    nearest[chosen] = torch.arange(most, device=nearest.device)  # whatever rounding says
    total = places.new_zeros(most, 4).index_add(
        0, nearest, torch.cat([texture[:, 6:].float(), places.new_ones(len(texture), 1)], dim=1)
    )
    coarse = torch.cat([texture[chosen, :6].float(), total[:, :3] / total[:, 3:]], dim=1)
    return coarse.to(texture.dtype)


def _compare(
    poses: Tensor,
    color: Tensor,
    depth: Tensor,
    K: Tensor,
    texture: Print,
    object_model: ObjectModel,
    shift: float,
) -> Tensor:
    """Return the ratios of poses in one image.  (C, 4, 4), (3, H, W), (H, W), (3, 3) -> (C,)."""
    points, normals, cosine, pixels, seen = look_at_print(poses, depth, K, texture, object_model)
    weights = seen * cosine
    focal = float(K[0, 0])
    spacing = texture.spacing * focal / points[..., 2].clamp_min(0.05)  # [px]
    covered = (weights * spacing.square()).sum(-1)
    count = _INDEPENDENT * torch.minimum(seen.sum(-1), covered / _PIXELS)
    basis = torch.cat([torch.ones_like(cosine)[..., None], normals], dim=-1)
    if not bool(seen.any()):
        return torch.zeros_like(count)
    x = remove_linear(texture.color.expand_as(points), basis, weights)
    middle = float(origin_of(poses, object_model.center.to(poses))[:, 2].median().clamp_min(0.05))
    sigma, step = choose_blur(texture, focal, middle), shift * focal
    image, corner = blur_around(color, pixels[seen], sigma, step)
    offsets = torch.cartesian_prod(*2 * [pixels.new_tensor([-step, 0, step] if step else [0])])
    moved = (pixels - corner)[:, :, None] + offsets.reshape(-1, 2)  # (C, P, S, 2)
    y = sample((image + DARK).log()[None], moved.flatten(0, 2)[None])[0]
    y = remove_linear(y.reshape(*cosine.shape, -1), basis, weights).unflatten(-1, (-1, 3))
    best = _correlate(x[:, :, None], y, weights).amax(1).clamp_min(0)
    return -0.5 * count * torch.log1p(-best.clamp_max(_LARGEST).square())


class View(NamedTuple):
    """Textured points at C poses."""

    points: Tensor  # (C, P, 3) [m] in the camera's frame
    normals: Tensor  # (C, P, 3) likewise
    cosine: Tensor  # (C, P) of the angle between the surface and the way to the camera
    pixels: Tensor  # (C, P, 2) [px]
    seen: Tensor  # (C, P) bool: it faces the camera, and is what is measured at its pixel


def look_at_print(
    poses: Tensor, depth: Tensor, K: Tensor, texture: Print, object_model: ObjectModel
) -> View:
    """Return where textured points are, and which of them an image shows.

    Args:
        poses: (C, 4, 4) camera_from_object [m].
        depth: (H, W) of the image [m].
        K: (3, 3) of its camera.
        texture: The object's textured points.
        object_model: The object.
    """
    points = transform(poses, texture.points)
    normals = texture.normals @ rotation_of(poses).mT
    cosine = -(normals * F.normalize(points, dim=-1)).sum(-1)
    pixels = project(points, K)
    at = nearest_pixel(pixels).flatten(0, 1)
    z = gather_pixels(depth[None, None], at[None])[0, :, 0].unflatten(0, cosine.shape)
    near = (z - points[..., 2]).abs() < _NEAR[0] + _NEAR[1] * object_model.diameter
    return View(points, normals, cosine, pixels, (z > 0) & near & (cosine > _GRAZING))


def choose_blur(texture: Print, focal: float, distance: float) -> float:
    """Return the blur that an image needs to be compared with textured points [px].

    Args:
        texture: The points.
        focal: Focal length [px].
        distance: Of the object [m].
    """
    return max(_SHARPEST, _BLUR * texture.spacing * focal / distance)


def blur_around(
    image: Tensor, pixels: Tensor, sigma: float, margin: float
) -> tuple[Tensor, Tensor]:
    """Return the part of a blurred image that some pixels are in, since the rest costs time.

    Args:
        image: (3, H, W).
        pixels: (P, 2) [px].
        sigma: Of the Gaussian [px].
        margin: By which the pixels may be moved [px].

    Returns:
        The part (3, h, w), and the pixel (2,) that its corner is.
    """
    wide = torch.tensor([image.shape[2], image.shape[1]], device=pixels.device)
    low = (pixels.amin(0) - margin).floor().long().clamp_min(0)
    high = torch.minimum((pixels.amax(0) + margin).floor().long() + 2, wide)
    half = _half_width(sigma)
    first, last = (low - half).clamp_min(0), torch.minimum(high + half, wide)
    (left, top), (right, bottom) = first.tolist(), last.tolist()
    (u, v), (width, height) = (low - first).tolist(), (high - low).tolist()
    blurred = blur(image[:, top:bottom, left:right], sigma)
    return blurred[:, v : v + height, u : u + width], low


def _correlate(x: Tensor, y: Tensor, weights: Tensor) -> Tensor:
    """Return weighted correlations of colors without means.

    (C, P, 1, 3), (C, P, S, 3), (C, P) -> (C, S).
    """
    weights = weights[..., None, None]
    xy, xx, yy = ((weights * product).sum((1, 3)) for product in (x * y, x * x, y * y))
    return xy / (xx * yy).sqrt().clamp_min(1e-9)


def remove_linear(values: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    """Return what a weighted regression on a basis leaves.  (C, P, V), (C, P, 4), (C, P)."""
    # of a plane, or of two, normals are linearly dependent but for the ridge: too much for float32
    exact, weighted = basis.double(), (basis * weights[..., None]).double()
    gram = weighted.mT @ exact
    ridge = 1e-6 * weights.double().sum(-1)[:, None, None] + 1e-9
    eye = torch.eye(basis.shape[-1], device=basis.device, dtype=exact.dtype)
    solved = torch.linalg.solve(gram + ridge * eye, weighted.mT @ values.double())
    return values - (exact @ solved).to(values)


def blur(image: Tensor, sigma: float) -> Tensor:
    """Blur an image by a Gaussian, repeating its edge.  (C, H, W), [px] -> (C, H, W)."""
    half = min(_half_width(sigma), min(image.shape[1:]) - 1)
    at = torch.arange(-half, half + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-0.5 * (at / sigma).square())
    kernel = (kernel / kernel.sum())[None, None, None]
    padded = F.pad(image[:, None], (half, half, half, half), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel), kernel.mT)[:, 0]


def _half_width(sigma: float) -> int:
    """Return how far a Gaussian of that deviation reaches [px]."""
    return max(1, round(3 * sigma))


@dataclass(eq=False)
class TextureRotations:
    """Turn the estimate, and the particles, by the texture.

    The turns that move the object's shape onto itself are what the depth leaves open. Each has the
    log-posterior e + w l, with e the evidence of the texture (`measure_texture`) and l the learned
    log-likelihood. The estimate takes the best of them. Particles draw theirs, so that the belief
    is spread over turns that the texture does not distinguish either. An object whose shape has no
    such turn stays as it is.

    Args:
        learned_weight: w. The learned likelihood's scale is arbitrary.
        pixels: Image points of each learned score.
        sigma: Its noise level [m].

    Raises:
        UserError: A number is out of range.
    """

    requires: ClassVar[Capabilities] = ("color", "depth", "pose")

    learned_weight: float = 1.0
    pixels: int = LEARNED_PIXELS
    sigma: float = LEARNED_SIGMA

    def __post_init__(self) -> None:
        if self.learned_weight < 0 or min(self.pixels, self.sigma) <= 0:
            raise UserError(
                "refine: turns by texture need learned_weight >= 0, pixels and sigma above 0; got "
                f"{self.learned_weight}, {self.pixels} and {self.sigma}"
            )

    @torch.no_grad()
    def __call__(
        self, belief: BeliefBatch, encoding: Encoding, method: Method, generator: Generator
    ) -> BeliefBatch:
        """Return the belief with the estimate and its particles turned; the score stays.

        Raises:
            UserError: The object has no texture.
        """
        object_model = coarsen_texture(object_of(method))
        first = belief.best
        turns, first_tried = list_rotations(object_model)
        if len(turns) == 1:
            return belief
        turns, first_tried = turns.to(first), first_tried.to(first.device)
        log_posterior, tried = self._score(
            first, turns, first_tried, encoding, method, object_model, generator
        )
        chosen = turns[tried.gather(1, log_posterior.argmax(1, keepdim=True))[:, 0]]
        best = self._rotate_finely(first, chosen, turns, encoding, object_model)
        poses = _rotate_particles(
            belief, turns[first_tried], turns[tried], log_posterior, object_model, generator
        )
        return belief._replace(best=best, poses=poses)

    @torch.no_grad()
    def rotate_nearby(self, best: Tensor, encoding: Encoding, method: Method) -> Tensor | None:
        """Return estimates (B, 4, 4) turned by less than ten degrees, where the shape leaves any
        angle open; None where it leaves a few turns open, or none.

        It costs a fraction of a search of all turns.

        Raises:
            UserError: As when called.
        """
        object_model = coarsen_texture(object_of(method))
        turns, first_tried = list_rotations(object_model)
        if len(first_tried) <= _MOST:
            return None
        identity = torch.eye(4).expand_as(best).to(best)
        return self._rotate_finely(best, identity, turns.to(best), encoding, object_model)

    def _score(
        self,
        best: Tensor,
        turns: Tensor,
        first_tried: Tensor,
        encoding: HasColor,
        method: Method,
        object_model: ObjectModel,
        generator: Generator,
    ) -> tuple[Tensor, Tensor]:
        """Score the turns that are tried first, the most promising at the best turn beside them.

        Fine texture does not correlate where a turn is some degrees off, and a can's is up to five
        from the nearest that is tried first. The learned score is of the turn tried first: over
        five degrees it hardly changes, and to score the best anew would draw other image points.

        Args:
            best: (B, 4, 4) the estimates.
            turns: (S, 4, 4).
            first_tried: (F,) indices of some of them.
            encoding: The images.
            method: Scores poses, or not.
            object_model: The object.
            generator: Draws the image points.

        Returns:
            The log-posterior of each, (B, F), and the index of the turn that stands for it, (B, F).
        """
        poses = best[:, None] @ turns[first_tried]
        learned = torch.zeros_like(poses[..., 0, 0])
        if isinstance(method, ScoresPoses) and self.learned_weight:
            scores = method.score_poses(encoding, poses, self.sigma, generator, self.pixels)
            learned = self.learned_weight * scores
        chosen = first_tried.expand(learned.shape).clone()
        if len(first_tried) <= _MOST:
            return measure_texture(poses, encoding, object_model) + learned, chosen
        evidence = measure_texture(poses, encoding, object_model, shift=0)
        top = (evidence + learned).topk(_MOST, dim=1).indices
        rows = torch.arange(len(best), device=best.device)[:, None]
        angles = rotation_angles(turns[first_tried], turns)
        beside = angles.topk(_BESIDE, dim=1, largest=False).indices  # itself first
        near = beside[top]  # (B, M, _BESIDE)
        around = best[:, None, None] @ turns[near]
        fine = measure_texture(around.flatten(1, 2), encoding, object_model, shift=0)
        finest = fine.unflatten(1, (_MOST, -1)).argmax(2, keepdim=True)
        chosen[rows, top] = near.gather(2, finest)[..., 0]
        poses = best[:, None] @ turns[chosen[rows, top]]
        evidence[rows, top] = measure_texture(poses, encoding, object_model)
        return evidence + learned, chosen

    def _rotate_finely(
        self,
        best: Tensor,
        chosen: Tensor,
        turns: Tensor,
        encoding: HasColor,
        object_model: ObjectModel,
    ) -> Tensor:
        """Return the estimates turned by the best of all turns near those chosen.

        Args:
            best: (B, 4, 4).
            chosen: (B, 4, 4), one of `turns` each.
            turns: (S, 4, 4).
            encoding: The images.
            object_model: The object.
        """
        angles = rotation_angles(chosen, turns)  # (B, S)
        most = int((angles < _APART).sum(1).max())
        if most == 1:
            return best @ chosen
        near = turns[angles.topk(most, dim=1, largest=False).indices]  # the chosen one first
        poses = best[:, None] @ near
        evidence = measure_texture(poses, encoding, object_model)
        return poses[torch.arange(len(best), device=best.device), evidence.argmax(1)]


def list_rotations(object_model: ObjectModel) -> tuple[Tensor, Tensor]:
    """Return the turns that an object's shape leaves open, and which of them are tried first.

    Args:
        object_model: The object.

    Returns:
        (S, 4, 4) object_from_object, the identity first; indices of some of them, no two of which
        are nearer than ten degrees.

    Raises:
        UserError: The object has no texture.
    """
    turns = object_model.shape_symmetries
    if object_model.texture is None or turns is None:
        raise UserError(_MISSING.format(name=object_model.name))
    apart, chosen = rotation_angles(turns, turns) > _APART - 0.1, []
    free = torch.ones_like(apart[0])  # of those that are chosen already
    while free.any():
        chosen.append(int(free.int().argmax()))  # the first
        free &= apart[:, chosen[-1]]
        free[chosen[-1]] = False
    return turns, torch.tensor(chosen, device=turns.device)


def rotation_angles(a: Tensor, b: Tensor) -> Tensor:
    """Return the angles between turns [degrees].  (A, 4, 4), (B, 4, 4) -> (A, B)."""
    trace = rotation_of(a).flatten(1) @ rotation_of(b).flatten(1).mT
    return torch.rad2deg(((trace - 1) / 2).clamp(-1, 1).acos())


def _rotate_particles(
    belief: BeliefBatch,
    turns: Tensor,
    to: Tensor,
    log_posterior: Tensor,
    object_model: ObjectModel,
    generator: Generator,
) -> Tensor:
    """Return the particles, each turned from the turn it is at to one that it draws.

    Args:
        belief: Its poses (B, N, 4, 4), and the estimates before they were turned.
        turns: (S, 4, 4).
        to: (B, S, 4, 4), the turn that stands for each: the one that was scored.
        log_posterior: (B, S) of those.
        object_model: The object.
        generator: Draws the turns, systematically: their shares are those of the posterior.
    """
    poses, best = belief.poses, belief.best
    space = PoseSpace(tuple(object_model.center.tolist()), object_model.radius)
    distance = space.distance(poses[:, :, None], (best[:, None] @ turns)[:, None])  # (B, N, S)
    nearest, at = distance.min(-1)
    back = torch.linalg.inv(turns)[at]
    B, N = at.shape
    shift = torch.rand(B, 1, generator=generator, device=at.device)
    order = torch.rand(B, N, generator=generator, device=at.device).argsort(1)
    drawn = inverse_cdf(log_posterior.log_softmax(1), (order + shift) / N)
    moved = poses @ back @ to[torch.arange(B, device=at.device)[:, None], drawn]
    return torch.where((nearest < _OWN * object_model.diameter)[..., None, None], moved, poses)
