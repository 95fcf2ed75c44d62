"""Judge single frames: medians over a dataset hide one that is wrong."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from posefilter.checking.compare import Fit, View, compare, likely_causes
from posefilter.data.silhouette import Geometry

LEAST_FRAME_IOU = 0.75  # of one frame's silhouettes
_DEPTH_MM, _DEPTH_SHARE = 20.0, 0.03  # of one frame's median depth error, and of the distance
_FEWEST = 200  # pixels below which an outline tells little
_MOST_TRIED = 10  # frames on which causes are tried


@dataclass(frozen=True)
class Suspect:
    """A frame that does not fit its mesh."""

    name: str
    view: View
    fit: Fit
    flaw: str  # what the reader has against it, "" for nothing


def is_suspect(view: View, fit: Fit) -> bool:
    """Tell whether one frame's silhouette or depth disagrees with its mesh beyond doubt."""
    silhouette = fit.rendered > 0
    pixels = max(int(silhouette.sum()), int(view.sample.mask.sum()))
    overlap = bool((silhouette & view.sample.mask).any())
    if pixels < _FEWEST or (overlap and math.isnan(fit.depth_error_mm)):
        return False  # too little is seen, or without depth that would tell what stands in front
    distance = float(np.median(fit.rendered[silhouette])) if silhouette.any() else 1.0
    off = fit.depth_error_mm > max(_DEPTH_MM, 1000 * _DEPTH_SHARE * distance)
    return fit.iou < LEAST_FRAME_IOU or off


def describe_suspects(
    suspects: Sequence[Suspect], geometry: Geometry, only_explained: bool = False
) -> list[str]:
    """Return a sentence for each frame, with the likely cause.

    Args:
        suspects: The frames; for the first ten causes are tried.
        geometry: Renders their meshes.
        only_explained: Leave out frames whose cause is not found.
    """
    out = []
    for k, one in enumerate(suspects):
        words = f"one frame, {one.name}: "
        if one.flaw:
            out.append(f"{words}{one.flaw}")
            continue
        causes = _find_causes(one, geometry) if k < _MOST_TRIED else []
        if only_explained and not causes:
            continue
        numbers = f"silhouette IoU {one.fit.iou:.2f}"
        if not math.isnan(one.fit.depth_error_mm):  # mask and mesh overlap
            numbers += f", depth {one.fit.depth_error_mm:.0f} mm off"
        out.append(words + ("; ".join(causes) or f"{numbers}: pose, label or depth of another?"))
    return out


def _find_causes(one: Suspect, geometry: Geometry) -> list[str]:
    """Return in words what is probably wrong with a single frame."""
    if causes := likely_causes([one.view], geometry, one.fit.iou):
        return causes
    sample = one.view.sample
    for axis, way in ((1, "left to right"), (0, "upside down")):
        for what in ("mask", "depth"):
            turned = replace(sample, **{what: np.flip(getattr(sample, what), axis)})
            fit = compare(replace(one.view, sample=turned), geometry)
            if not is_suspect(replace(one.view, sample=turned), fit):
                return [f"the {'label' if what == 'mask' else what} is mirrored, {way}"]
    return []
