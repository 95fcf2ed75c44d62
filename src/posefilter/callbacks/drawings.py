"""The figures of a validation, one function each: an occasion in, a picture out; None where it does not apply.

Pictures are (H, W, 3) uint8; bytes are a film, a GIF.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from posefilter.callbacks.fields import few_levels, point_field, pose_field, proposals_of, telling_pixels
from posefilter.callbacks.gallery import Shown, draw_gallery
from posefilter.callbacks.journeys import followed, glimpses_of, lineage
from posefilter.contracts import HasRelevance
from posefilter.geometry.spaces import PoseSpace
from posefilter.models.base import PoseEstimator
from posefilter.models.image_space import ImageSpace
from posefilter.models.pose_pf import PosePF
from posefilter.pictures.belief import draw_belief
from posefilter.pictures.cloud import draw_strip, weights_of
from posefilter.pictures.field import draw_point_field, draw_pose_field
from posefilter.pictures.film import Film, draw_silhouettes, hulls_on_image, outlines, to_gif
from posefilter.pictures.journeys import draw_glimpses, draw_journeys
from posefilter.pictures.maps import draw_proposals, draw_relevance
from posefilter.pictures.overlay import Shape, outline
from posefilter.types import Batch, Trace


class Occasion(NamedTuple):
    """What there is to draw."""

    method: PoseEstimator
    shape: Shape  # of the object
    kept: dict[str, list[Shown]]  # images by kind: first, best, worst
    one: Shown  # the example that most figures are about
    trace: Trace  # its run, on the CPU
    batch: Batch  # the same image as the method reads it
    scene: Any  # what the method keeps of it
    when: str

    @property
    def posed(self) -> bool:
        """Tell whether particles are poses."""
        return isinstance(self.method.space, PoseSpace)

    def title(self, what: str) -> str:
        """Return a figure's title, and below it what it is of."""
        return f"{what}\nimage {self.one.frame_id}, {self.when}"

    def mask(self) -> np.ndarray:
        """Return the object's visible part, (H, W) bool."""
        return self.batch.mask[0, 0].cpu().numpy()


Drawn = np.ndarray | bytes | None


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
    """Draw the clouds on the image, coloured by weight."""
    title = o.title("Particles by iteration")
    return draw_strip(o.one.rgb, o.one.intrinsics, o.trace, 0, o.method.space, title)


def belief(o: Occasion) -> Drawn:
    """Draw the belief on SO(3) and over translation."""
    if not o.method.tells_pose:
        return None
    return draw_belief(o.trace.belief, o.method.model, o.one.rgb, o.one.intrinsics, o.one.truth, o.title("Belief"))


def silhouettes(o: Occasion) -> Drawn:
    """Draw the silhouettes of particles that are poses."""
    if not o.posed:
        return None
    title = o.title("Silhouettes")
    return draw_silhouettes(o.one.rgb, o.one.intrinsics, o.trace, o.method.model.hull.cpu(), o.one.truth, title)


def field(o: Occasion) -> Drawn:
    """Draw slices of the score about the truth."""
    if not isinstance(o.method, PosePF):
        return None
    model = o.method.model
    found = pose_field(o.method, o.scene, o.batch.camera_from_object[0], model, few_levels(o.trace.steps))
    center = model.center.cpu().double().numpy()
    shift = (o.one.estimate[:3, :3] - o.one.truth[:3, :3]) @ center + o.one.estimate[:3, 3] - o.one.truth[:3, 3]
    return draw_pose_field(found, o.title("Likelihood field"), o.one.truth[:3, :3].T @ shift)


def points(o: Occasion) -> Drawn:
    """Draw slices of the likelihood of single points through the object's frame (the paper, figure 5)."""
    if not isinstance(o.method, PosePF):
        return None
    model, truth = o.method.model, o.batch.camera_from_object[0]
    slices = [
        point_field(o.method.likelihood, o.scene.image, truth, model, pixel, on, few_levels(o.trace.steps), depthwise)
        for pixel, on in telling_pixels(o.batch, model)
        for depthwise in ((False, True) if on else (False,))
    ]
    surface = (model.points - model.center).cpu().double().numpy()
    return draw_point_field(slices, o.one.rgb, surface, o.title("Likelihood of points")) if slices else None


def proposals(o: Occasion) -> Drawn:
    """Draw what the proposal network says."""
    said = proposals_of(o.method, o.scene, o.batch) if isinstance(o.method, PosePF) else None
    if said is None:
        return None
    title = o.title("Proposals")
    return draw_proposals(said, o.one.rgb, o.one.intrinsics, o.one.truth, o.shape, o.method.model.radius, title)


def relevance(o: Occasion) -> Drawn:
    """Draw the map of relevance beside where particles started and ended."""
    if o.posed or not isinstance(o.scene, HasRelevance):
        return None
    clouds = [(c.state[0].double().numpy(), weights_of(c, 0).numpy()) for c in (o.trace.clouds[0], o.trace.clouds[-1])]
    seen = o.scene.relevance[0, 0].detach().float().cpu().numpy()
    return draw_relevance(seen, o.one.rgb, o.mask(), clouds[0], clouds[1], o.title("Relevance"))


def journeys(o: Occasion) -> Drawn:
    """Draw the way of particles that are pixels (the paper, figure 4)."""
    if o.posed:
        return None
    return draw_journeys(o.one.rgb, o.mask(), lineage(o.trace.clouds)[0].numpy(), o.title("Journeys"))


def glimpses(o: Occasion) -> Drawn:
    """Draw what a few particles saw at each step (the paper, figure 2)."""
    if not isinstance(o.method, ImageSpace):
        return None
    states = followed(o.trace)
    patches = glimpses_of(o.method, o.scene, states)
    return draw_glimpses(o.one.rgb, o.mask(), states.numpy(), patches, o.title("Glimpses"))


def film(o: Occasion) -> Drawn:
    """Film the filter at work."""
    scene = Filmed(o.one.rgb, o.one.intrinsics, o.one.truth, o.mask())
    return filmed(o.method, o.trace, scene, o.title("The filter at work"))


class Filmed(NamedTuple):
    """The image that a film is of."""

    rgb: np.ndarray  # (H, W, 3) uint8
    intrinsics: np.ndarray  # (3, 3) [px]
    truth: np.ndarray  # (4, 4)
    mask: np.ndarray  # (H, W) bool


def filmed(method: PoseEstimator, trace: Trace, scene: Filmed, title: str) -> bytes:
    """Film the filter on one image, whose trace this is.  -> a GIF."""
    hull, K = method.model.hull.cpu(), scene.intrinsics
    posed = isinstance(method.space, PoseSpace)
    target = outlines(hulls_on_image(torch.as_tensor(scene.truth)[None], hull, K)) if posed else outline(scene.mask)
    return to_gif(list(Film(scene.rgb, K, trace, method.space, hull, target, title).frames()))


def _gallery(o: Occasion, kind: str, title: str) -> Drawn:
    images = o.kept[kind]
    return draw_gallery(images, o.shape, o.method.tells_pose, f"{title}\n{o.when}") if images else None


DRAWINGS: dict[str, Callable[[Occasion], Drawn]] = {
    drawing.__name__: drawing
    for drawing in (
        overlays, worst, best, particles, silhouettes, journeys, glimpses,
        belief, field, points, proposals, relevance, film,
    )
}  # fmt: skip
