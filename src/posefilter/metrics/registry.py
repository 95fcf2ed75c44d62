"""What each number of metrics.json is called, how it is written, and which way is better.

One table for all who show numbers.  Keys are those of metrics.json, nested ones joined by "/"
(`add/auc`).  A list, one number an iteration, is read at its ends: `diagnostics/off_frame/first`
and `diagnostics/off_frame/last`.  `filter/...` are the filter's quantities by iteration and
`train/...` those of a training, which are only logged.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from posefilter.errors import UserError

HIGHER, LOWER, NEITHER = 1, -1, 0  # which way is better
PERCENT = (-3.0, 103.0)  # limits of a chart of percentages: what lies at an end is seen
UNIT, SIGNED_UNIT = (-0.03, 1.03), (-1.05, 1.05)  # the same of numbers in [0, 1] and in [-1, 1]


class MetricInfo(NamedTuple):
    """A number's name, and how it is shown.

    Attributes:
        key: Its place in metrics.json.
        label: Its name in tables and charts.
        unit: Of what is shown; empty for plain numbers.
        form: Format specification of what is shown.
        direction: HIGHER, LOWER or NEITHER: which way is better.
        factor: What is shown, over what is stored.
        limits: Ends of a chart's axis, in the shown unit; None to follow the numbers.
        short: Name where room is scarce; the label if empty.
        meaning: What it says, in a few words.
    """

    key: str
    label: str
    unit: str = ""
    form: str = ".1f"
    direction: int = NEITHER
    factor: float = 1.0
    limits: tuple[float, float] | None = None
    short: str = ""
    meaning: str = ""

    @property
    def title(self) -> str:
        """Return the label with its unit, for a column's head: `median ADD [mm]`."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def column(self) -> str:
        """Return the short name with its unit: `on object %`."""
        return f"{self.short or self.label} {self.unit}".strip()

    def convert(self, value: float) -> float:
        """Return a stored number in the unit in which it is shown."""
        return self.factor * value

    def format(self, value: float) -> str:
        """Return a stored number as it is written, without its unit."""
        return format(self.convert(value), self.form)

    def split(self, value: float) -> tuple[str, str]:
        """Return a stored number as it is written, and its unit: meters where millimeters get
        long.
        """
        shown = self.convert(value)
        if self.unit == "mm" and 1000 <= abs(shown) < math.inf:
            return f"{shown / 1000:.2f}", "m"
        return self.format(value), self.unit

    def describe(self, value: float) -> str:
        """Return a stored number as it is written, with its unit: `94.7 %`."""
        return " ".join(self.split(value)).strip()


def _share(
    key: str, label: str, direction: int = NEITHER, short: str = "", meaning: str = ""
) -> MetricInfo:
    """Return a metric that is stored as a share in [0, 1] and shown in percent."""
    return MetricInfo(key, label, "%", ".1f", direction, 100.0, PERCENT, short, meaning)


def _unit(
    key: str, label: str, short: str = "", meaning: str = "", form: str = ".3f"
) -> MetricInfo:
    """Return a metric in [0, 1] that is best at 1 and shown as it is stored."""
    return MetricInfo(key, label, "", form, HIGHER, 1.0, UNIT, short, meaning)


def _signed_unit(key: str, label: str, direction: int, short: str) -> MetricInfo:
    """Return a metric in [-1, 1], shown as it is stored."""
    return MetricInfo(key, label, "", ".2f", direction, 1.0, SIGNED_UNIT, short)


def _count(
    key: str, label: str, direction: int = NEITHER, short: str = "", meaning: str = ""
) -> MetricInfo:
    """Return a metric that is a whole number."""
    return MetricInfo(key, label, form=".0f", direction=direction, short=short, meaning=meaning)


def _percent(
    key: str, label: str, form: str, direction: int, short: str = "", meaning: str = ""
) -> MetricInfo:
    """Return a metric that is stored in percent."""
    return MetricInfo(key, label, "%", form, direction, 1.0, PERCENT, short, meaning)


def _describe_errors(name: str, label: str) -> tuple[MetricInfo, ...]:
    return (
        MetricInfo(f"{name}/auc", f"{label} AUC", "", ".1f", HIGHER, limits=PERCENT),
        _percent(
            f"{name}/recall_01d", f"{label} < 0.1 diameter", ".1f", HIGHER, f"{label} < 0.1 d"
        ),
        _percent(f"{name}/recall_2cm", f"{label} < 2 cm", ".1f", HIGHER),
        MetricInfo(f"{name}/median_mm", f"median {label}", "mm", ".1f", LOWER),
    )


def _describe_bop(name: str, unit: str, thresholds: str) -> tuple[MetricInfo, ...]:
    label, meaning = name.upper(), f"over thresholds of {thresholds}"
    return (
        _percent(f"{name}/ar", f"{label} average recall", ".1f", HIGHER, meaning=meaning),
        MetricInfo(f"{name}/median_{unit}", f"median {label}", unit, ".1f", LOWER),
    )


def _describe_coverage(
    key: str, what: str, short: str, meaning: str, levels: Sequence[int]
) -> tuple[MetricInfo, ...]:
    """Return the share of the truths in a kind of set, of several levels; `meaning` takes one."""
    return tuple(
        _percent(
            f"{key}_{level}",
            f"coverage of the {level} % {what}",
            ".0f",
            HIGHER if level == 90 else NEITHER,  # most are too low; see diagnostics
            f"{level} % {short}",
            meaning.format(level),
        )
        for level in levels
    )


_METRICS = (
    _count("instances", "instances", meaning="objects in images, tested one by one"),
    _count("missed", "missed", LOWER, meaning="images without a finite pose"),
    *_describe_errors("add", "ADD"),
    *_describe_errors("add_s", "ADD-S"),
    *_describe_errors("add_up_to_symmetry", "ADD up to symmetry"),
    *_describe_bop("mssd", "mm", "0.05 to 0.5 diameters, as in the BOP challenge"),
    *_describe_bop("mspd", "px", "5 to 50 pixels in an image 640 wide"),
    _percent("bop/ar", "BOP average recall", ".1f", HIGHER, meaning="mean of VSD, MSSD and MSPD"),
    _percent("bop/ar_vsd", "BOP recall by VSD", ".1f", HIGHER),
    _percent("bop/ar_mssd", "BOP recall by MSSD", ".1f", HIGHER),
    _percent("bop/ar_mspd", "BOP recall by MSPD", ".1f", HIGHER),
    _unit("iou", "box IoU"),
    _unit("parts/box_iou", "part box IoU",
        meaning="mean over the object's parts, each at the estimated and at the true pose"),
    _unit("parts/mask_iou", "part mask IoU",
        meaning="the same of visible pixels, each of which belongs to the nearest part"),
    _share("particles_on_object", "particles on the object", HIGHER, "on object"),
    MetricInfo("seconds_per_image", "time per image", "s", ".3g", LOWER, short="s / image"),
    # the belief, means over the images
    MetricInfo("belief/effective_particles", "effective sample size", "particles", ".1f",
        meaning="1 / Σw²: how many particles carry the weight"),
    MetricInfo("belief/entropy", "entropy of the weights", "nat", ".2f",
        meaning="of the weights: 0 where one particle has all the weight"),
    MetricInfo("belief/spread_m", "spread of the centers", "mm", ".1f", factor=1000.0,
        meaning="weighted root mean square about the mean"),
    MetricInfo("belief/spread_rad", "spread of the rotations", "degrees", ".1f",
        factor=180 / math.pi, meaning="the same, of the angle"),
    _share("belief/mass_01d", "weight within 0.1 diameter of the truth", HIGHER,
        "within 0.1 diameter", "100 where the belief is narrow and right"),
    _share("belief/mass_2cm", "weight within 2 cm of the truth", HIGHER, "within 2 cm"),
    MetricInfo("belief/rank", "rank of the truth by mean distance", form=".2f",
        meaning="share of the belief that is nearer to the particles than the truth; 0.5 where "
        "calibrated; near 1: the truth lies outside"),
    *_describe_coverage("belief/distance_coverage", "mean-distance region", "distance region",
        "truths whose mean distance to the particles is within the belief's {0} % quantile: {0} "
        "where calibrated; fewer: wrong, or too narrow", (50, 90)),
    MetricInfo("credibility/log_density", "log density of the truth, mean", "nat", ".2f", HIGHER,
        short="log density",
        meaning="per cubic meter, and per unit of rotation where SO(3) has the volume pi²"),
    MetricInfo("credibility/log_density_p50", "log density of the truth, median", "nat", ".2f",
        HIGHER, meaning="over the images; the same unit"),
    *_describe_coverage("credibility/coverage", "credible set", "credible set",
        "truths in the highest-density set: {0} where calibrated; fewer: wrong or too narrow",
        (50, 80, 90, 95)),
    _share("belief/truth_outscored", "images in which a particle outscores the truth", LOWER,
        "by any pose"),
    _share("belief/truth_outscored_by_wrong", "images in which a wrong pose outscores the truth",
        LOWER, "by a wrong pose", "more particles cannot correct these"),
    _share("belief/truth_outscored_by_misplaced",
        "images in which a pose of wrong ADD-S outscores the truth", LOWER, "by a misplaced pose",
        "no look-alike of the truth"),
    # calibrated probabilities, on frames with the object and without
    _count("confidence/frames", "frames with the object"),
    _count("confidence/frames_without", "frames without the object"),
    _unit("confidence/auroc", "AUROC of the probability, right against wrong", short="AUROC right",
        meaning="among frames with the object; 0.5: no better than chance"),
    _unit("confidence/auroc_presence", "AUROC of the presence", short="AUROC presence",
        meaning="frames with the object against frames without"),
    MetricInfo("confidence/ece", "expected calibration error", form=".3f", direction=LOWER,
        short="ECE", meaning="mean gap between the probability and the share that is right"),
    MetricInfo("confidence/brier", "Brier score", form=".3f", direction=LOWER,
        meaning="mean square of probability less outcome"),
    _share("confidence/wrong", "wrong poses", LOWER,
        meaning="of the frames with the object: 0.1 diameters or more from the truth"),
    _share("confidence/wrong_at_80", "wrong poses at 80 % kept", LOWER,
        meaning="of the 80 % of highest probability"),
    _share("confidence/found", "declared found", HIGHER, meaning="of the frames with the object"),
    _share("confidence/absent", "declared absent, but there", LOWER,
        meaning="of the frames with the object"),
    _count("confidence/false_alarms", "false alarms", LOWER,
        meaning="frames without the object in which one is found"),
    _count("scale_ratio/images", "images with a measured scale ratio"),
    MetricInfo("scale_ratio/ratio", "scale ratio of depth to mesh", form=".2f",
        meaning="median over the images: 1 where depth and intrinsics are right"),
    _count("scale_ratio/contradicting", "images with a scale mismatch", LOWER,
        meaning="between depth and mesh: there depth or intrinsics cannot be right"),
    # where particles that are pixels are; lists over the iterations
    _share("diagnostics/on_object", "on the object", HIGHER),
    _share("diagnostics/on_object/first", "on the object at the start", HIGHER,
        "on object at start"),
    _share("diagnostics/on_object/last", "on the object at the end", HIGHER, "on the object"),
    _share("diagnostics/off_frame", "off the frame", LOWER, "off frame"),
    _share("diagnostics/near_edge", "at an edge", LOWER),
    _share("diagnostics/near_corner", "in a corner", LOWER),
    _share("diagnostics/distinct", "distinct particles", HIGHER, "distinct"),
    _share("diagnostics/first_axis_share", "variance along the first axis",
        short="first-axis share",
        meaning="share of the particles' variance along its first principal axis; 50: round"),
    _share("diagnostics/first_axis_share/first", "variance along the first axis at the start",
        short="first-axis share at start"),
    _signed_unit("diagnostics/pairwise_cosine", "pairwise cosine of the displacements", LOWER,
        "pairwise cosine"),
    # at most 1, and without a least
    MetricInfo("diagnostics/offset_r2", "true offsets explained (R²)", "", ".2f", HIGHER,
        short="offset R2"),
    _signed_unit("diagnostics/offset_cosine", "cosine of displacement and true offset", HIGHER,
        "offset cosine"),
    _unit("diagnostics/auroc", "AUROC of the likelihood", short="AUROC", form=".2f"),
    # of a training
    _count("training/steps", "training steps", short="steps"),
    _count("training/tested_step", "tested step"),
    MetricInfo("training/seconds_per_step", "time per training step", "s", ".3g", LOWER),
    MetricInfo("training/cpu_seconds_per_step", "processor time per training step", "s", ".3g",
        LOWER),
    MetricInfo("train/loss", "loss", form=".3g", direction=LOWER),
    MetricInfo("score", "score", form=".1f", direction=HIGHER, limits=PERCENT),
    MetricInfo("best_score", "best score", form=".1f", direction=HIGHER, limits=PERCENT),
    # the filter, iteration by iteration
    MetricInfo("filter/ess", "relative effective sample size", "%", ".0f", factor=100.0,
        limits=PERCENT, short="relative ESS", meaning="1 / Σw² over the number of particles"),
    MetricInfo("filter/spread_m", "spread of the centers", "mm", ".1f", factor=1000.0),
    MetricInfo("filter/spread_rad", "spread of the rotations", "degrees", ".1f",
        factor=180 / math.pi),
    MetricInfo("filter/spread_px", "spread", "px", ".1f"),
    MetricInfo("filter/sigma_m", "noise level", "mm", ".1f", factor=1000.0),
    MetricInfo("filter/sigma_px", "noise level", "px", ".1f"),
    MetricInfo("filter/best_log_likelihood", "best log-likelihood", "nat", ".1f", HIGHER),
    # of a run, derived from several of the above
    _share("missed_fraction", "images without an estimate", LOWER),
    MetricInfo("val_score_drop", "validation score lost since its best", form=".1f",
        direction=LOWER),
    _count("not_finite", "training scalars that are no numbers", LOWER),
)  # fmt: skip
METRICS = {info.key: info for info in _METRICS}
_RENAMED = {  # keys of files that earlier versions wrote, or their first levels, and tags
    "train/loss_chosen": "train/loss_main",
    "speed/waiting_share": "speed/waiting_fraction",
    "speed/drawing_share": "speed/drawing_fraction",
    "belief/coverage_50": "belief/distance_coverage_50",
    "belief/coverage_90": "belief/distance_coverage_90",
    "apparent_size": "scale_ratio",
    "diagnostics/heading": "diagnostics/offset_cosine",
    "diagnostics/line_share": "diagnostics/first_axis_share",
}


def rename_key(key: str) -> str:
    """Return a number's key, or the tag of a logged scalar, as it is called today."""
    split = re.match(r"(?:val|test)/", key)
    start = split.end() if split else 0
    bare = key[start:]
    old = next((one for one in _RENAMED if bare == one or bare.startswith(f"{one}/")), None)
    return key if old is None else key[:start] + _RENAMED[old] + bare.removeprefix(old)


def find_metric(key: str) -> MetricInfo:
    """Return what is known of a number.

    Args:
        key: Its key.  That of a logged scalar (`val/add/auc`), of a range of visibility
            (`by_visibility/0.3-0.5/add/auc`), of a part (`parts/by_part/head/box_iou`) and of one
            end of a list (`diagnostics/off_frame/last`) lead to the same number, earlier names to
            today's.

    Raises:
        UserError: Where there is no such number.
    """
    bare = re.sub(r"^(?:(?:val|test)/)?(?:by_visibility/[\d.]+-[\d.]+/)?", "", rename_key(key))
    bare = re.sub(r"^parts/by_part/[^/]+/", "parts/", bare)
    for name in (bare, re.sub(r"/(?:first|last)$", "", bare), re.sub(r"/step_\d+$", "", bare)):
        if name in METRICS:
            return METRICS[name]
    raise UserError(f"{key}: there is no such metric; there are {', '.join(METRICS)}")


def read_number(metrics: Mapping[str, Any], key: str) -> float | None:
    """Return one number of a metrics.json, as it is stored.

    Args:
        metrics: The file's content.
        key: Its key; `.../first` and `.../last` are the ends of a list.

    Returns:
        The number, None where the file has none or it is not finite.
    """
    before = (
        old + key.removeprefix(new)
        for old, new in _RENAMED.items()
        if key == new or key.startswith(f"{new}/")
    )
    return next((x for one in (key, *before) if (x := _read(metrics, one)) is not None), None)


def _read(metrics: Mapping[str, Any], key: str) -> float | None:
    value: Any = metrics
    for name in key.split("/"):
        if isinstance(value, list) and name in ("first", "last"):
            value = (value or [None])[0 if name == "first" else -1]
        else:
            value = value.get(name) if isinstance(value, Mapping) else None
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return float(value) if number and math.isfinite(value) else None
