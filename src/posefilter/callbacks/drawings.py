"""The figures of a validation, one function each: an occasion in, a picture out; None where it does
not apply.

Pictures are (H, W, 3) uint8; bytes are an animation, a GIF.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from posefilter.callbacks.fields import (
    ScoresPoints,
    choose_levels,
    choose_pixels,
    evaluate_point_field,
    evaluate_pose_field,
    predict_proposals,
)
from posefilter.callbacks.gallery import KeptImage, draw_gallery
from posefilter.capabilities import Capability
from posefilter.figures.animation import Animation, encode_gif
from posefilter.figures.belief import draw_belief
from posefilter.figures.field import draw_point_field, draw_pose_field
from posefilter.figures.maps import draw_objectness, draw_proposals
from posefilter.figures.overlay import Shape, trace_outline
from posefilter.figures.particles import draw_iterations, normalize_weights
from posefilter.figures.silhouettes import draw_silhouettes, outline_hulls, project_hulls
from posefilter.figures.trajectories import (
    draw_glimpses,
    draw_trajectories,
    extract_glimpses,
    follow_particles,
    trace_lineage,
)
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator
from posefilter.protocols import HasImagePatches, ProposesPoses, ScoresPoses
from posefilter.types import Batch, Trace


class Occasion(NamedTuple):
    """What there is to draw."""

    method: PoseEstimator
    shape: Shape  # of the object
    kept: dict[str, list[KeptImage]]  # images by kind: first, best, worst
    one: KeptImage  # the example that most figures are about
    trace: Trace  # its run, on the CPU
    batch: Batch  # the same image as the method reads it
    encoding: Any  # what the method keeps of it
    when: str

    def title(self, what: str) -> str:
        """Return a figure's title, and below it what it is of."""
        return f"{what}\n{self.one.name}, {self.when}"

    def mask(self) -> np.ndarray:
        """Return the object's visible part, (H, W) bool."""
        return self.batch.mask[0, 0].cpu().numpy()


Drawn = np.ndarray | bytes | None
Drawing = Callable[[Occasion], Drawn]


def needs(*names: Capability) -> Callable[[Drawing], Drawing]:
    """Have a figure left out for methods that do not provide what it shows."""

    def guard(draw: Drawing) -> Drawing:
        @wraps(draw)
        def drawing(o: Occasion) -> Drawn:
            return draw(o) if o.method.capabilities.issuperset(names) else None

        return drawing

    return guard


def overlays(o: Occasion) -> Drawn:
    """Draw estimate and truth on the first images."""
    return _gallery(o, "first", "The first images")


def best(o: Occasion) -> Drawn:
    """Draw the best images."""
    return _gallery(o, "best", f"The {len(o.kept['best'])} best images")


def worst(o: Occasion) -> Drawn:
    """Draw the worst images."""
    return _gallery(o, "worst", f"The {len(o.kept['worst'])} worst images")


def particles(o: Occasion) -> Drawn:
    """Draw the particles on the image, colored by weight."""
    title = o.title("Particles by iteration")
    return draw_iterations(o.one.rgb, o.one.intrinsics, o.trace, o.method.space, title)


@needs("pose")
def belief(o: Occasion) -> Drawn:
    """Draw the belief on SO(3) and over translation."""
    model, truth, title = o.method.object_model, o.one.truth, o.title("Belief")
    return draw_belief(o.one.rgb, o.one.intrinsics, o.trace.belief, model, truth, title)


@needs("pose_space")
def silhouettes(o: Occasion) -> Drawn:
    """Draw the silhouettes of particles that are poses."""
    title = o.title("Silhouettes")
    return draw_silhouettes(
        o.one.rgb, o.one.intrinsics, o.trace, o.method.object_model.hull.cpu(), o.one.truth, title
    )


@needs("score_poses")
def field(o: Occasion) -> Drawn:
    """Draw slices of the score about the truth."""
    assert isinstance(o.method, ScoresPoses)
    object_model, truth = o.method.object_model, o.batch.camera_from_object[0]
    levels = choose_levels(o.trace.steps)
    found = evaluate_pose_field(o.method, o.encoding, truth, object_model, levels)
    center = object_model.center.cpu().double().numpy()
    R, t = o.one.truth[:3, :3], o.one.truth[:3, 3]
    shift = (o.one.estimate[:3, :3] - R) @ center + o.one.estimate[:3, 3] - t
    return draw_pose_field(found, o.title("Likelihood field"), R.T @ shift)


@needs("score_points")
def points(o: Occasion) -> Drawn:
    """Draw slices of the likelihood of single points through the object's frame (the paper, figure
    5).
    """
    likelihood = cast(ScoresPoints, o.method.likelihood)
    object_model, truth = o.method.object_model, o.batch.camera_from_object[0]
    image, levels = o.encoding.image, choose_levels(o.trace.steps)
    slices = [
        evaluate_point_field(likelihood, image, truth, object_model, pixel, on, levels, depthwise)
        for pixel, on in choose_pixels(o.batch, object_model)
        for depthwise in ((False, True) if on else (False,))
    ]
    if not slices:
        return None
    surface = (object_model.points - object_model.center).cpu().double().numpy()
    return draw_point_field(slices, o.one.rgb, surface, o.title("Likelihood of points"))


@needs("object_coordinates")
def proposals(o: Occasion) -> Drawn:
    """Draw what the proposal network says."""
    assert isinstance(o.method, ProposesPoses)
    predicted = predict_proposals(o.method, o.encoding, o.batch, o.method.object_model)
    if predicted is None:
        return None
    rgb, K, truth = o.one.rgb, o.one.intrinsics, o.one.truth
    radius, title = o.method.object_model.radius, o.title("Proposals")
    return draw_proposals(predicted, rgb, K, truth, o.shape, radius, title)


@needs("pixel_space")
def objectness(o: Occasion) -> Drawn:
    """Draw the map of objectness beside where particles started and ended."""
    if getattr(o.encoding, "objectness", None) is None:
        return None
    history = [
        (c.state[0].double().numpy(), normalize_weights(c).numpy())
        for c in (o.trace.particles[0], o.trace.particles[-1])
    ]
    seen = o.encoding.objectness[0, 0].detach().float().cpu().numpy()
    return draw_objectness(seen, o.one.rgb, o.mask(), history[0], history[1], o.title("Objectness"))


@needs("pixel_space")
def trajectories(o: Occasion) -> Drawn:
    """Draw the way of particles that are pixels (the paper, figure 4)."""
    return draw_trajectories(
        o.one.rgb, o.mask(), trace_lineage(o.trace.particles)[0].numpy(), o.title("Trajectories")
    )


@needs("image_patches")
def glimpses(o: Occasion) -> Drawn:
    """Draw what a few particles saw at each step (the paper, figure 2)."""
    assert isinstance(o.method, HasImagePatches)
    states = follow_particles(o.trace)
    patches = extract_glimpses(o.method, o.encoding, states.to(o.method.device))
    return draw_glimpses(o.one.rgb, o.mask(), states.numpy(), patches, o.title("Glimpses"))


def animation(o: Occasion) -> Drawn:
    """Animate the filter at work."""
    where = (o.one.rgb, o.one.intrinsics, o.one.truth, o.mask())
    return animate(o.method, o.trace, *where, o.title("The filter at work"))


def animate(
    method: PoseEstimator,
    trace: Trace,
    rgb: np.ndarray,
    K: np.ndarray,
    truth: np.ndarray,
    mask: np.ndarray,
    title: str,
) -> bytes:
    """Animate the filter on one image, whose trace this is.

    rgb (H, W, 3) uint8; K (3, 3) [px]; truth (4, 4); mask (H, W) bool. -> a GIF.
    """
    hull, target = method.object_model.hull.cpu(), trace_outline(mask)
    if isinstance(method.space, PoseSpace):
        target = outline_hulls(project_hulls(torch.as_tensor(truth)[None], hull, K))
    shown = Animation(rgb, K, trace, method.space, hull, target, title)
    return encode_gif(list(shown.frames()))


def _gallery(o: Occasion, kind: str, title: str) -> Drawn:
    images, posed = o.kept[kind], "pose" in o.method.capabilities
    return draw_gallery(images, o.shape, posed, f"{title}\n{o.when}") if images else None


DRAWINGS: dict[str, Drawing] = {
    drawing.__name__: drawing
    for drawing in (
        overlays, worst, best, particles, silhouettes, trajectories, glimpses,
        belief, field, points, proposals, objectness, animation,
    )
}  # fmt: skip
