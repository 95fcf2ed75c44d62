"""Fit a calibration to frames with and without the object."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from posefilter.confidence.calibration import Assessment, Calibration, standardize, tabulate_errors
from posefilter.confidence.logistic import fit_logistic
from posefilter.confidence.tolerance import RIGHT, PoseErrors
from posefilter.errors import UserError

_FOLDS = 5  # of cross-validation
FEWEST = 10  # frames with the object, and without
# features that answers to one image are not compared by: they say how sure an answer is, and
# whether they choose a better one was not tried
_NOT_COMPARED = ("texture_density", "rotation_margin")


class Frames(NamedTuple):
    """Calibration frames."""

    features: tuple[str, ...]
    values: np.ndarray  # (n, F)
    present: np.ndarray  # (n,) bool: the object is in the image
    correct: np.ndarray  # (n,) bool: and the estimate within 0.1 diameters
    # of (n,) each, NaN where the object is not in the image; None: not measured
    errors: PoseErrors | None = None
    # (n,) share of the object that is visible, NaN where it is not in the image or not known; None:
    # not measured
    visibility: np.ndarray | None = None

    def select(self, index: np.ndarray) -> "Frames":
        """Return some of the frames."""
        visibility = None if self.visibility is None else self.visibility[index]
        errors = None if self.errors is None else PoseErrors(*(x[index] for x in self.errors))
        own = (self.values[index], self.present[index], self.correct[index])
        return Frames(self.features, *own, errors, visibility)


def make_frames(
    values: Sequence[Mapping[str, torch.Tensor]],
    present: Sequence[np.ndarray],
    errors: Sequence[PoseErrors],
    visibility: Sequence[np.ndarray],
) -> Frames:
    """Return the frames of batches of features, each (B,) by name; errors and visibility are NaN
    where the object is not in the image.
    """
    names = tuple(values[0])
    rows = [np.stack([one[name].double().cpu().numpy() for name in names], 1) for one in values]
    all_rows, seen = (np.concatenate(one) for one in (rows, present))
    all_rows[~np.isfinite(all_rows)] = np.nan  # no number
    off = PoseErrors(*(np.concatenate(parts) for parts in zip(*errors, strict=True)))
    return Frames(names, all_rows, seen, RIGHT.accepts(off), off, np.concatenate(visibility))


def fit_choice(frames: Frames, source: str) -> Calibration:
    """Fit what answers to one image are compared by, to first answers.

    Args:
        frames: n frames, with the object and without, as `fit_calibration` takes them.
        source: The kind of data that they are of.

    Returns:
        A calibration of first answers; `fit_calibration` makes that of the answers chosen by it.

    Raises:
        UserError: There are too few frames with the object, or without.
    """
    _check_counts(frames)
    fitted = _fit(frames, source, {})
    balance = _balance(frames.correct, float(np.clip(frames.correct.mean(), 0.05, 0.95)))
    compared = [name not in _NOT_COMPARED for name in frames.features]
    x = standardize_frames(frames) * compared  # of a feature that is always 0 the weight is 0
    return replace(fitted, choice=fit_logistic(x, frames.correct, balance))


def _balance(label: np.ndarray, share: float) -> np.ndarray:
    """Return how much each frame counts, so that a share of them counts as half of them."""
    return np.where(label, 0.5 / share, 0.5 / (1 - share))


def fit_calibration(
    frames: Frames,
    source: str,
    quality: Mapping[str, float] | None = None,
    first: Calibration | None = None,
) -> Calibration:
    """Fit both regressions.

    The presence counts frames with and without the object as if there were as many of each: it is
    calibrated for a prior of one half.

    Args:
        frames: n frames.
        source: The kind of data that they are of.
        quality: Of held-out predictions.
        first: What the answers were chosen by, see `fit_choice`; features are standardized as it
            does. None: they are first answers, and no others are searched for.

    Raises:
        UserError: There are too few frames with the object, or without.
    """
    _check_counts(frames)
    return _fit(frames, source, quality or {}, first)


def _check_counts(frames: Frames) -> None:
    for own, which in ((frames.present, "with"), (~frames.present, "without")):
        count = int(own.sum())
        if count < FEWEST:
            raise UserError(
                f"calibrate: {count} frames {which} the object; {FEWEST} are needed at least"
            )


def _fit(
    frames: Frames, source: str, quality: Mapping[str, float], first: Calibration | None = None
) -> Calibration:
    there, right = frames.present, frames.correct
    counts = {
        "right": int(right.sum()),
        "wrong": int((there & ~right).sum()),
        "absent": int((~there).sum()),
    }
    center, scale = _find_standard(frames, first)
    x = standardize(frames.values, center, scale)
    errors = None
    if frames.errors is not None:
        errors = tabulate_errors(x[there], np.stack(frames.errors, axis=1)[there])
    return Calibration(
        frames.features,
        center,
        scale,
        presence=fit_logistic(x, there, _balance(there, there.mean())),
        success=fit_logistic(x[there], right[there]),
        counts=counts,
        source=source,
        quality=dict(quality),
        choice=None if first is None else first.choice,
        errors=errors,
    )


def standardize_frames(frames: Frames, first: Calibration | None = None) -> np.ndarray:
    """Return the features as the calibration of these frames standardizes them, (n, F); `first` as
    of `fit_calibration`.
    """
    return standardize(frames.values, *_find_standard(frames, first))


def _find_standard(
    frames: Frames, first: Calibration | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return center and scale of the features."""
    if first is not None:
        return first.center, first.scale
    scale = np.nanstd(frames.values, 0).clip(1e-6)
    return tuple(np.nanmean(frames.values, 0).tolist()), tuple(scale.tolist())


def cross_validate(frames: Frames, first: Calibration | None = None) -> Assessment:
    """Return the probabilities of frames, each by a calibration that has not seen it.

    Each fold has its share of right, wrong and absent frames; `first` is as of `fit_calibration`.
    """
    rng = np.random.default_rng(0)
    kind = frames.present.astype(int) + frames.correct
    fold = np.empty(len(kind), int)
    for one in np.unique(kind):
        own = np.flatnonzero(kind == one)
        fold[rng.permutation(own)] = np.arange(len(own)) % _FOLDS
    presence, probability = torch.zeros(2, len(kind), dtype=torch.float64)
    for k in range(_FOLDS):
        held = np.flatnonzero(fold == k)
        if not len(held):
            continue
        part = _fit(frames.select(np.flatnonzero(fold != k)), "held_out", {}, first)
        found = part.assess_features(torch.from_numpy(frames.values[held]))
        presence[held], probability[held] = found.presence, found.probability
    return Assessment(presence, probability)
