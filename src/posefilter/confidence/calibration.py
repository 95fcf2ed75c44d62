"""The calibrated probability: two logistic regressions on features of a finished filter.

presence    = sigmoid(a . x + b)                that the object is in the image
probability = presence * sigmoid(c . x + d)     that it is, and the pose right: ADD < 0.1 diameters

x are the features, standardized by the calibration frames and limited to `LIMIT` standard
deviations on either side: what lies beyond what calibration saw counts as its edge. Each feature is
such that more of it speaks for the estimate, and a, c >= 0: so both probabilities rise with each.

The errors of the calibration frames' estimates are kept, so that c and d can be fitted to another
tolerance when it is asked for.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from posefilter.confidence.belief_scale import DEGREES, POSSIBLE_DEGREES, TRIANGLE, BeliefScale
from posefilter.confidence.conformal import GROUPED_BY, Conformal
from posefilter.confidence.logistic import Logistic, fit_logistic
from posefilter.confidence.tolerance import RIGHT, PoseErrors, PoseTolerance
from posefilter.errors import UserError

LIMIT = 3.0  # standard deviations
COUNTS = ("right", "wrong", "absent")
_MOST_FEATURES, _LARGEST, _MOST_FRAMES = 16, 1e6, 10_000_000
_MOST_GROUPS, _MOST_SCORES = 16, 100_000
_MOST_LOG = 10.0  # of a belief's scale
_FARTHEST = 60_000.0  # error that float16 holds
_FARTHEST_COMMON = 100.0  # [m], of the error that all estimates have in common
_RENAMED = {  # features, by their names in earlier versions
    "solid": "free_space",
    "explained": "mask_precision",
    "recognized": "mask_recall",
    "glimpsed": "top_objectness",
}
_LATER = {"conformal", "choice", "errors", "belief_scale"}  # keys that earlier versions do not have
_NAME = re.compile(r"[a-z][a-z0-9_]{0,39}")


class Assessment(NamedTuple):
    """Probabilities of B estimates, float64."""

    presence: Tensor  # (B,) that the object is there
    probability: Tensor  # (B,) that it is there and the pose right; at most `presence`
    features: Mapping[str, Tensor] | None = None  # (B,) each, that they are of


@dataclass(frozen=True)
class CalibrationErrors:
    """Features and pose errors of the n calibration frames that show the object, as they are
    stored: of float16.

    Attributes:
        features: (n, F), standardized, in the order of the calibration's.
        errors: (n, 4), in the order of `PoseErrors`.
    """

    features: tuple[tuple[float, ...], ...]
    errors: tuple[tuple[float, ...], ...]

    def accepted_by(self, tolerance: PoseTolerance) -> np.ndarray:
        """Return which of the estimates keep a tolerance, (n,) bool."""
        accepted: np.ndarray = tolerance.accepts(PoseErrors(*np.array(self.errors).T))
        return accepted


@dataclass(frozen=True)
class Calibration:
    """What turns features into probabilities; plain data, carried in a checkpoint.

    Attributes:
        features: Their names.
        center: Its mean over the calibration frames.
        scale: Its standard deviation there, above 0.
        presence: Whether the object is there.
        success: Whether the pose is right, given that the object is there.
        counts: Calibration frames: right, wrong, absent.
        source: The kind of data that they are of, such as `fat`.
        quality: Of held-out predictions on those frames, by cross-validation.
        conformal: What sets of poses with a guaranteed coverage go by; None: of an earlier version.
        choice: Whether the first answer of a filter is right, object there or not, counted as if
            half of them were; several answers to one image are compared by it. None: of an earlier
            version, whose filter gives one answer.
        errors: What the success at other tolerances is learned from. None: of an earlier version,
            which knows of an ADD below 0.1 diameters alone.
        belief_scale: What makes a belief as wide as the errors of right estimates. None: too few of
            the frames had a right estimate, or of an earlier version; beliefs are then the
            particles as the filter leaves them.
    """

    features: tuple[str, ...]
    center: tuple[float, ...]
    scale: tuple[float, ...]
    presence: Logistic
    success: Logistic
    counts: Mapping[str, int]
    source: str
    quality: Mapping[str, float]
    conformal: Conformal | None = None
    choice: Logistic | None = None
    errors: CalibrationErrors | None = None
    belief_scale: BeliefScale | None = None

    def assess(self, values: Mapping[str, Tensor], tolerance: PoseTolerance = RIGHT) -> Assessment:
        """Return the probabilities of estimates.

        Args:
            values: Features (B,) by name; more than the calibration uses does no harm.
            tolerance: What a right pose is.

        Raises:
            UserError: The method has no feature of a name that the calibration uses, or the
                calibration knows of no other tolerance.
        """
        return self.assess_features(self._stack(values), tolerance)._replace(features=values)

    def assess_features(self, x: Tensor, tolerance: PoseTolerance = RIGHT) -> Assessment:
        """Return the probabilities of features (B, F), in the order of `features`.

        A feature that is not a number speaks against the estimate as far as any can.
        """
        x = self._standardize(x)
        presence = _evaluate(self.presence, x)
        return Assessment(presence, presence * _evaluate(self.fit_success(tolerance), x))

    def fit_success(self, tolerance: PoseTolerance = RIGHT) -> Logistic:
        """Return the regression of whether the pose of an object that is there keeps a tolerance.

        Each tolerance has a regression of its own, from the same frames.

        Raises:
            UserError: The calibration is of an earlier version.
        """
        if tolerance == RIGHT:
            return self.success
        if self.errors is None:
            raise UserError(
                "pose_tolerance: the checkpoint was calibrated by an earlier version, which knows "
                "of an ADD below 0.1 diameters alone; calibrate it again"
            )
        return _fit_success(self.errors, tolerance)

    def rank(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return what answers to one image are compared by, (B,) in [0, 1]; see `choice`.

        Args:
            values: Features (B,) by name.

        Raises:
            UserError: The calibration compares no answers, or is of another method.
        """
        if self.choice is None:
            raise UserError("calibration: compares no answers; calibrate the checkpoint again")
        return _evaluate(self.choice, self.standardize(values))

    def choice_ignores(self, feature: str) -> bool:
        """Return whether a feature has no part in what answers to one image are compared by."""
        if self.choice is None or feature not in self.features:
            return False
        return self.choice.weights[self.features.index(feature)] == 0

    def standardize(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return features (B,) by name as the regressions take them, (B, F) float64."""
        return self._standardize(self._stack(values))

    def _stack(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return features (B, F), in the order of `features`."""
        missing = [name for name in self.features if name not in values]
        if missing:
            raise UserError(
                f"calibration: is of another method or version, whose features have {missing[0]}; "
                "calibrate the checkpoint again"
            )
        return torch.stack([values[name].detach().double().cpu() for name in self.features], dim=-1)

    def _standardize(self, x: Tensor) -> Tensor:
        return torch.from_numpy(standardize(x.numpy(), self.center, self.scale))

    def to_plain(self) -> dict[str, Any]:
        """Return it as dictionaries, lists, numbers and strings; `read_calibration` reads them."""
        plain: dict[str, Any] = _with_lists(asdict(replace(self, errors=None)))
        if self.errors is not None:
            both = (torch.tensor(self.errors.features), torch.tensor(self.errors.errors))
            plain["errors"] = torch.cat(both, 1).half()  # a fifth of what lists take
        return plain


def _with_lists(plain: Any) -> Any:
    """Return nested dictionaries and tuples with lists in place of the tuples."""
    if isinstance(plain, dict):
        return {key: _with_lists(value) for key, value in plain.items()}
    return [_with_lists(one) for one in plain] if isinstance(plain, tuple) else plain


def _evaluate(one: Logistic, x: Tensor) -> Tensor:
    """Return the probability by a regression on standardized features.  (B, F) -> (B,)."""
    return torch.sigmoid(x @ x.new_tensor(one.weights) + one.bias)


def standardize(x: np.ndarray, center: Sequence[float], scale: Sequence[float]) -> np.ndarray:
    """Return features (n, F) as the regressions take them."""
    x = (x - np.array(center)) / np.array(scale)
    return np.nan_to_num(x, nan=-LIMIT, posinf=-LIMIT).clip(-LIMIT, LIMIT)


def tabulate_errors(features: np.ndarray, errors: np.ndarray) -> CalibrationErrors:
    """Return standardized features (n, F) and errors (n, 4), as they are stored."""
    tables = (features, errors.clip(max=_FARTHEST))
    return CalibrationErrors(
        *(tuple(tuple(row) for row in table.astype(np.float16).tolist()) for table in tables)
    )


@lru_cache(maxsize=256)
def _fit_success(errors: CalibrationErrors, tolerance: PoseTolerance) -> Logistic:
    return fit_logistic(np.array(errors.features), errors.accepted_by(tolerance))


def read_calibration(content: Any, said: str) -> Calibration:
    """Return the calibration that a checkpoint holds, as data that others may have written.

    Args:
        content: What the checkpoint holds under that name.
        said: How the user named the checkpoint, for messages.

    Raises:
        UserError: It is no calibration: other keys, numbers that are not finite or far too large,
            negative weights, names that are none.
    """
    try:
        return _read(content)
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{said}: its calibration {error.args[0]}") from error


def _read(content: Any) -> Calibration:
    names = {field.name for field in fields(Calibration)}
    if not isinstance(content, dict) or not names <= set(content) | _LATER:
        raise ValueError(f"should hold {', '.join(sorted(names))}")
    if set(content) - names:
        unknown = sorted(str(key)[:30] for key in set(content) - names)[0]
        raise ValueError(
            f"holds {unknown!r}, which this version does not know; it may be of a newer one"
        )
    features = content["features"]
    good = isinstance(features, list) and 0 < len(features) <= _MOST_FEATURES
    if not good or not all(isinstance(one, str) and _NAME.fullmatch(one) for one in features):
        raise ValueError(f"should name 1 to {_MOST_FEATURES} features")
    features = [_RENAMED.get(one, one) for one in features]
    if len(set(features)) < len(features):
        raise ValueError("names a feature twice")
    count = len(features)
    scale = _numbers(content["scale"], count, "scale", minimum=1e-9)
    counts, source = content["counts"], content["source"]
    if not isinstance(counts, dict) or set(counts) != set(COUNTS):
        raise ValueError(f"should count {', '.join(COUNTS)}")
    if not all(type(one) is int and 0 <= one <= _MOST_FRAMES for one in counts.values()):
        raise ValueError("counts no frames")
    if not (isinstance(source, str) and _NAME.fullmatch(source)):
        raise ValueError("names no source of data")
    quality = content["quality"]
    if not isinstance(quality, dict) or len(quality) > _MOST_FEATURES:
        raise ValueError("has no table of its quality")
    if not all(isinstance(key, str) and _NAME.fullmatch(key) for key in quality):
        raise ValueError("has a quality without a name")
    numbers = _numbers(list(quality.values()), len(quality), "quality")

    def read(name: str, reader: Callable[..., Any], *more: Any) -> Any:
        """Return a part that may be missing, which is then None."""
        return None if content.get(name) is None else reader(content[name], *more)

    return Calibration(
        tuple(features),
        _numbers(content["center"], count, "center"),
        scale,
        _logistic(content["presence"], count, "presence"),
        _logistic(content["success"], count, "success"),
        dict(counts),
        source,
        dict(zip(quality, numbers, strict=True)),
        read("conformal", _conformal),
        read("choice", _logistic, count, "choice"),
        read("errors", _errors, count),
        read("belief_scale", _belief_scale, count),
    )


def _logistic(content: Any, count: int, name: str) -> Logistic:
    if not isinstance(content, dict) or set(content) != {"weights", "bias"}:
        raise ValueError(f"should have weights and bias in {name}")
    weights = _numbers(content["weights"], count, f"{name}'s weights", minimum=0.0)
    return Logistic(weights, _numbers([content["bias"]], 1, f"{name}'s bias")[0])


def _belief_scale(content: Any, count: int) -> BeliefScale:
    # earlier versions have no weights, the usual degrees of freedom, and a shape of the particles
    later = {"weights", "degrees", "common"}
    if not isinstance(content, dict) or set(content) - later != {"bias", "slope"}:
        raise ValueError("should have bias, slope, weights, degrees and common in belief_scale")
    weights = content.get("weights", [])
    if not isinstance(weights, list) or len(weights) not in (0, count):
        raise ValueError(f"should have {count} weights in belief_scale")
    given = [content["bias"], content["slope"], *weights]
    numbers = _numbers(given, len(given), "belief_scale", -_MOST_LOG, _MOST_LOG)
    degrees = content.get("degrees", DEGREES)
    if type(degrees) is not int or degrees not in POSSIBLE_DEGREES:
        raise ValueError(f"should have degrees of {POSSIBLE_DEGREES} in belief_scale")
    common = content.get("common", [])
    if not isinstance(common, list) or len(common) not in (0, TRIANGLE):
        raise ValueError(f"should have {TRIANGLE} numbers in belief_scale's common")
    limits = (-_FARTHEST_COMMON, _FARTHEST_COMMON)
    lower = _numbers(common, len(common), "belief_scale's common", *limits)
    return BeliefScale(numbers[0], numbers[1], numbers[2:], degrees, lower)


def _errors(content: Any, count: int) -> CalibrationErrors:
    width = count + len(PoseErrors._fields)
    is_table = isinstance(content, Tensor) and content.dtype == torch.float16
    if not is_table or content.dim() != 2 or content.shape[1] != width:
        raise ValueError(f"should have {width} numbers a frame in errors, as float16")
    if not 0 < len(content) <= _MOST_SCORES:
        raise ValueError(f"should have 1 to {_MOST_SCORES} frames in errors")
    features, errors = content[:, :count], content[:, count:]
    # nan is in no range
    if not bool((features.abs() <= LIMIT).all() and ((errors >= 0) & (errors <= _FARTHEST)).all()):
        raise ValueError("has numbers out of range in errors")
    return tabulate_errors(features.numpy(), errors.numpy())


def _conformal(content: Any) -> Conformal:
    if isinstance(content, dict) and "surprises" in content:  # the name in earlier versions
        content = {"scores" if key == "surprises" else key: x for key, x in content.items()}
    if not isinstance(content, dict) or set(content) - {"by", "occluded"} != {"edges", "scores"}:
        raise ValueError("should have edges and scores in conformal")
    by = content.get("by", "surface")  # earlier versions name none
    if by not in GROUPED_BY:
        raise ValueError(f"should group conformal by {' or '.join(GROUPED_BY)}")
    groups = content["scores"]
    if not isinstance(groups, list) or not 1 <= len(groups) <= _MOST_GROUPS:
        raise ValueError(f"should have 1 to {_MOST_GROUPS} groups in conformal")
    edges = _numbers(content["edges"], len(groups) - 1, "conformal's edges")
    scores = _score_groups(groups)
    occluded = _score_groups(content.get("occluded", []))  # earlier versions have none
    if len(occluded) not in (0, len(scores)):
        raise ValueError(f"should have {len(scores)} groups of occluded frames in conformal")
    if list(edges) != sorted(edges):
        raise ValueError("has numbers of conformal that do not rise")
    return Conformal(edges, scores, by, occluded)


def _score_groups(groups: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(groups, list):
        raise ValueError("has groups of conformal that are none")
    read = []
    for one in groups:
        if not isinstance(one, list) or len(one) > _MOST_SCORES:
            raise ValueError("has a group of conformal that is none")
        read.append(_numbers(one, len(one), "conformal's scores"))
        if one != sorted(one):
            raise ValueError("has numbers of conformal that do not rise")
    return tuple(read)


def _numbers(
    values: Any, count: int, name: str, minimum: float = -_LARGEST, maximum: float = _LARGEST
) -> tuple[float, ...]:
    """Return finite numbers of moderate size."""
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"should have {count} numbers in {name}")
    for value in values:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        # nan is in no range; a whole number may be too large for a float
        if not (number and minimum <= value <= maximum):
            raise ValueError(f"has {str(value)[:30]!r} in {name}")
    return tuple(float(value) for value in values)
