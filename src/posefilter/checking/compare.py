"""Compare what a dataset says of an object with what its mesh says, and look for the cause where
they disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from posefilter.data.frames import Sample
from posefilter.data.silhouette import Geometry
from posefilter.geometry.camera import resize_intrinsics
from posefilter.geometry.rigid import rigid
from posefilter.meshes import ycb
from posefilter.meshes.store import Mesh

IN_FRONT = 0.015  # [m] nearer than the rendered surface by this: something else is seen there
_RATIO_TOLERANCE = 0.05
_GOOD_IOU = 0.7  # of silhouettes, above which they agree
_WHOLE = 0.75  # share of an image: a larger silhouette, of what is too near, fits many masks
# of pictures whose intrinsics may have been mixed up
_WIDTHS = (160, 320, 480, 640, 720, 960, 1280, 1920)
_POWERS = (0.001, 0.01, 0.1, 10.0, 100.0, 1000.0)
_UNITS = {0.001: "are in millimeters", 0.01: "are in centimeters"}


@dataclass(frozen=True)
class View:
    """One record as it was read, with the mesh that should be in it."""

    sample: Sample
    others: np.ndarray  # (H, W) bool, labeled as something else
    mesh: Mesh
    native_from_mesh: np.ndarray  # (4, 4) [m]


@dataclass(frozen=True)
class Fit:
    """How well mesh and frame agree."""

    rendered: np.ndarray  # (H, W) [m], 0 where the mesh is not
    iou: float  # of the silhouettes, where the label can tell
    depth_error_mm: float  # median of the absolute difference, NaN without a common pixel
    depth_ratio: float  # median of measured over rendered depth, NaN without a common pixel
    ratio_spread: float  # half the width of its middle half
    visible_share: float


def compare(
    view: View, geometry: Geometry, pose: np.ndarray | None = None, K: np.ndarray | None = None
) -> Fit:
    """Render the mesh at a pose (the record's) by a camera (the record's) and compare with mask and
    depth.

    Silhouettes are compared where the label can tell: not where another object is labeled, nor
    where the measured depth lies clearly in front of the mesh or is unknown (provided that depth is
    to scale at all).
    """
    sample = view.sample
    pose = sample.camera_from_object if pose is None else pose
    height, width = sample.mask.shape
    depth, _ = geometry.render(
        [view.mesh], [pose], sample.intrinsics if K is None else K, (height, width)
    )
    silhouette = depth > 0
    both = silhouette & sample.mask & (sample.depth > 0)
    error = ratio = spread = float("nan")
    if both.any():
        ratios = sample.depth[both] / depth[both]
        low, ratio, high = (float(x) for x in np.percentile(ratios, [25, 50, 75]))
        spread = (high - low) / 2
        error = float(np.median(np.abs(sample.depth[both] - depth[both]))) * 1000
    hidden = view.others & ~sample.mask
    if abs(ratio - 1) < _RATIO_TOLERANCE:
        # unknown depth (0) may be of what stands in front
        hidden |= ~sample.mask & (sample.depth < depth - IN_FRONT)
    union = (silhouette | sample.mask) & ~hidden
    common = silhouette & sample.mask
    iou = float(common.sum() / union.sum()) if union.any() else 0.0
    share = min(float(sample.mask.sum() / silhouette.sum()), 1.0) if silhouette.any() else 0.0
    return Fit(depth, iou, error, ratio, spread, share)


def likely_causes(views: Sequence[View], geometry: Geometry, before: float) -> list[str]:
    """Return in words what is probably wrong with poses, frames, intrinsics and depth; `before`:
    the median IoU as it is.
    """
    fits = [compare(_invert(view), geometry) for view in views]
    after = float(np.median([fit.iou for fit in fits]))
    if after > max(before, _GOOD_IOU):
        said = f"masks are inverted: 255 is the object, 0 all else {_list_ious(before, after)}"
        return [said, *_depth_scale(fits)]
    undone = [list_causes(view) for view in views]
    words = [one[0] for one in undone[0]]
    tried = [
        [compare(view, geometry, pose, K) for view, (_, pose, K) in zip(views, causes, strict=True)]
        for causes in zip(*undone, strict=True)
    ]
    scores = [float(np.median([fit.iou for fit in each])) for each in tried]
    for number in range(len(_POWERS)):  # of the translations
        if np.median([(fit.rendered > 0).mean() for fit in tried[number]]) > _WHOLE:
            scores[number] = 0.0
    best = int(np.argmax(scores))
    as_read = [compare(view, geometry) for view in views]
    found, judged = [], as_read
    if scores[best] > before + max(0.05, 0.5 * (1 - before)) and scores[best] > _GOOD_IOU:
        ious = _list_ious(before, scores[best])
        found.append(f"{words[best]} {ious}")
        judged = tried[best]
        factor = _POWERS[best] if best < len(_POWERS) else 1.0  # of the translations
        # an object as many times larger and farther looks the same
        if factor != 1 and abs(_measure_depth(judged) * factor - 1) < 0.1:
            larger = _tell_factor(1 / factor)
            return [f"the mesh is too {larger}: multiply mesh_scale by {1 / factor:g} {ious}"]
    return found + _depth_scale(judged)


def _invert(view: View) -> View:
    """Return a view with its mask inverted; of those of others, which then are, too, nothing is
    known.
    """
    sample = replace(view.sample, mask=~view.sample.mask)
    return replace(view, sample=sample, others=np.zeros_like(view.others))


def _list_ious(before: float, after: float) -> str:
    return f"(silhouette IoU {before:.2f}, with that undone {after:.2f})"


def half_pixel(views: Sequence[View], geometry: Geometry, before: float) -> str | None:
    """Tell whether the principal point is off by half a pixel: the misfit of the outline must then
    nearly vanish.
    """
    for shift in (0.5, -0.5):
        fits = [compare(v, geometry, None, _shifted(v.sample.intrinsics, shift)) for v in views]
        after = float(np.median([fit.iou for fit in fits]))
        if 1 - after < 0.4 * (1 - before) and after - before > 0.004:
            corner = "half a pixel was taken off twice"
            if shift < 0:
                corner = "pixel corners, not centers, have whole numbers"
            ious = f"silhouette IoU {before:.3f}, corrected {after:.3f}"
            return f"the principal point is off by {-shift:+.1f} px: {corner} ({ious})"
    return None


def list_causes(view: View) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Return every cause that is tried: in words, with the pose (4, 4) and the camera (3, 3) that
    undo it.
    """
    pose, K, mesh = view.sample.camera_from_object, view.sample.intrinsics, view.native_from_mesh
    native = pose @ np.linalg.inv(mesh)
    width = view.sample.mask.shape[1]
    out = []
    for factor in _POWERS:
        scaled = native.copy()
        scaled[:3, 3] *= factor
        words = _UNITS.get(factor, f"are too {_tell_factor(factor)}")
        out.append((f"translations {words}", scaled @ mesh, K))
    transposed = native.copy()
    transposed[:3, :3] = native[:3, :3].T
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    inverse = np.linalg.inv(native) @ mesh
    out.append(("poses are the wrong way round (object from camera)", inverse, K))
    out.append(("rotations are transposed", transposed @ mesh, K))
    out.append(("poses are in OpenGL's camera axes (y up, z backward)", flip @ pose, K))
    out += [(words, pose @ step, K) for words, step in _frames(view)]
    for other in _WIDTHS:
        scale = width / other
        resized = resize_intrinsics(torch.from_numpy(K.astype(np.float64)), scale, scale).numpy()
        # of several widths, the first view's may be the right one
        wrong = f", not {width}" if other != width else ""
        words = f"intrinsics belong to pictures {other} px wide{wrong}"
        out.append((words, pose, resized))
    return out


def _tell_factor(factor: float) -> str:
    """Return by how much lengths are off that are right times a factor."""
    size = "small" if factor > 1 else "large"
    return f"{size} by a factor of {max(factor, 1 / factor):g}"


def _measure_depth(fits: Sequence[Fit]) -> float:
    """Return measured over rendered depth, where silhouettes agree; NaN where that varies, in
    a frame or between them.
    """
    good = [fit for fit in fits if fit.iou > _GOOD_IOU and np.isfinite(fit.depth_ratio)]
    if not good:
        return float("nan")
    ratios = [fit.depth_ratio for fit in good]
    ratio = float(np.median(ratios))
    spread = max(float(np.median([fit.ratio_spread for fit in good])), float(np.ptp(ratios)))
    return ratio if spread <= 0.1 * ratio else float("nan")


def _depth_scale(fits: Sequence[Fit]) -> list[str]:
    """Return what is wrong with the scale of depth, where silhouettes agree."""
    ratio = _measure_depth(fits)
    if not abs(ratio - 1) >= 0.02:
        return []
    power = next((p for p in _POWERS if abs(ratio / p - 1) < 0.1), None)
    number = f"{power:g}" if power else f"{ratio:.3g}"
    return [
        f"depth is {number} times what the mesh says: correct the depth scale by "
        f"{1 / (power or ratio):.3g}"
    ]


def _frames(view: View) -> list[tuple[str, np.ndarray]]:
    """Return frames that may have been mixed up: words, and mesh_from_supposed."""
    out = []
    if not np.allclose(view.native_from_mesh, np.eye(4)):
        back = np.linalg.inv(view.native_from_mesh)
        out += [
            ("poses are in the mesh file's frame already, not in the dataset's own", back),
            ("the dataset's object frame was applied the wrong way round", back @ back),
        ]
    if view.mesh.name in ycb.CLASSES and view.mesh.name not in ycb.WITHOUT_GEOMETRY:
        on = ycb.ycbvideo_from_original(view.mesh.name)
        back = np.linalg.inv(on)
        out += [
            ("poses are in YCB-Video's object frame, meshes in the original (google_16k) one", on),
            ("poses are in the original (google_16k) frame, meshes in YCB-Video's", back),
        ]
    center = rigid(np.eye(3), -view.mesh.bounds.mean(0))
    words = "poses are in a frame at the center of the bounding box (as BOP's)"
    return [*out, (f"{words}, the mesh has another origin", center)]


def _shifted(K: np.ndarray, shift: float) -> np.ndarray:
    out = K.copy()
    out[:2, 2] += shift
    return out
