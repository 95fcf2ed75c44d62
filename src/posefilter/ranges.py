"""Ranges of numeric settings: a senseless value is refused by its key before anything is built."""

import math
import re
from collections.abc import Iterator, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple

from posefilter.errors import UserError
from posefilter.limits import MOST_SIDE

_OURS = ("posefilter.", "torch.", "lightning.")


class Range(NamedTuple):
    """What a setting may be, beside null."""

    minimum: float
    maximum: float = math.inf
    whole: bool = False
    above: bool = False  # the least value itself is too small
    share: bool = False  # also a share of all: a number with a point, in [0, 1]
    words: tuple[Any, ...] = ()  # other values that have a meaning
    many: bool = False  # a list of such numbers, too
    note: str = ""  # what else a refusal says

    def holds(self, value: Any) -> bool:
        """Tell whether a value lies within; NaN does not."""
        if any(value == word and type(value) is type(word) for word in self.words):
            return True
        if isinstance(value, bool) or not isinstance(value, Real):
            return False
        if self.share and isinstance(value, float) and 0 <= value <= 1:
            return not (self.above and value == 0)
        if self.whole and not isinstance(value, Integral):
            return False
        try:
            number = float(value)
        except OverflowError:
            return False
        enough = self.minimum < number if self.above else self.minimum <= number
        return enough and number <= self.maximum

    def __str__(self) -> str:
        """Return the range in words."""
        parts = [f"{'above' if self.above else 'at least'} {self.minimum:g}"]
        parts += [f"at most {self.maximum:.12g}"] if self.maximum < math.inf else []
        shares = [f"a share in {'(' if self.above else '['}0, 1]"] if self.share else []
        options = [f"a {'whole ' if self.whole else ''}number, {', '.join(parts)}", *shares]
        return ", or ".join([*options, *map(str, self.words)]) + (self.note and f": {self.note}")


def _whole(minimum: float, maximum: float = math.inf, **more: Any) -> Range:
    return Range(minimum, maximum, whole=True, **more)


def _each(place: str, allowed: Range, *names: str) -> dict[str, Range]:
    """Return the one range of several settings below a place."""
    return {f"{place}.{name}": allowed for name in names}


SHARE, WEIGHT, POSITIVE = Range(0, 1), Range(0, 1e6), Range(0, 1e6, above=True)
COUNT, COUNT_OR_NONE, WIDTH = _whole(1, 1_000_000), _whole(0, 1_000_000), _whole(1, 65_536)
SEED, LONG_SEED = _whole(0, 2**32 - 1), _whole(0, 2**63 - 1)
METERS, PIXELS = Range(0, 100, above=True), Range(0, MOST_SIDE)
BATCHES = _whole(0, share=True)
UNITS = Range(
    1,
    1e7,
    note="units of the depth images in a meter, 10000 for YCB-Video, 1000 for millimeters; what "
    "BOP's scene_camera.json calls 0.1 is 10000 here",
)

# By the end of a setting's place, the command's name before it, `components` left out: of several
# that fit, the longest counts.  tests/conf/test_ranges.py holds it to have every number of conf/.
RANGES: dict[str, Range] = {
    # every command
    "seed": SEED,
    "threads": _whole(1, 256),
    "mesh_scale": Range(0, 1e6, above=True),
    "distractor_scale": Range(0, 1e6, above=True),
    # data
    "split_seed": LONG_SEED,
    **dict.fromkeys(("min_visibility", "min_visibility_test"), SHARE),
    **dict.fromkeys(("batch_size", "batch_size_test"), _whole(1, 100_000)),
    "data.workers": _whole(0, 256),
    **dict.fromkeys(("limit_train", "limit_val", "limit_test"), COUNT),
    "data.num_model_points": _whole(4, 1_000_000),
    "data.texture_points": _whole(4, 20_000),
    **dict.fromkeys(("image_width", "image_height"), _whole(16, MOST_SIDE)),
    # data.augment: the rest is checked by its classes
    "uniform_roll_probability": SHARE,
    "probability": SHARE,
    "augment.steps.strength": Range(0, 10),
    "zoom": Range(0, 1e6, above=True, many=True),
    "object_size": Range(0, 10, above=True, many=True),  # [widths of the image]
    "object_size_probability": SHARE,
    # pixels of a crop, or a share
    "augment.steps.size": Range(0, MOST_SIDE, above=True, many=True),
    "hue_deg": Range(0, 180),
    "mixing": SHARE,
    "tint": SHARE,
    "steps.gamma": Range(0, 10),
    "gain": Range(0, 10, many=True),
    "length": SHARE,
    "quality": _whole(1, 100, many=True),
    # generate, and data.generate
    "generate.frames": _whole(1, 10_000_000),
    "generate.seed": LONG_SEED,
    "generate.workers": _whole(1, 256),
    "generate.size": _whole(32, MOST_SIDE, many=True),
    "generate.camera": Range(-1e6, 1e6, words=("ycb_video", "fat"), many=True),
    "generate.max_occlusion": Range(0, 0.999_999),
    **_each("generate", SHARE, "occluded_fraction", "tabletop_fraction", "absent_fraction"),
    "generate.distractors": _whole(0, 1000, many=True),
    "generate.instances": _whole(1, 100),
    "generate.frames_per_scene": COUNT,
    "generate.moving_mm": Range(0, 1000),
    "generate.moving_deg": Range(0, 180),
    "generate.fully_occluded_frames": COUNT_OR_NONE,
    # other commands
    "check_data.max_frames": COUNT,
    "predict.instances": _whole(1, 100),
    "depth_scale": UNITS,
    **dict.fromkeys(("cost_false_alarm", "cost_miss", "cost_unsure"), POSITIVE),
    **_each("pose_tolerance", POSITIVE, "translation_mm", "rotation_deg", "add", "add_s"),
    "convert_bag.max_time_difference": Range(0, 10),
    "evaluate.absent_frames": COUNT_OR_NONE,
    **_each("calibrate", _whole(10, 1_000_000), "frames", "absent_frames"),
    "track.stride": COUNT,
    "track.fps": Range(0.1, 1000),
    "export.points": COUNT,
    **_each("export", _whole(16, MOST_SIDE), "width", "height"),
    "export.max_mb": Range(0, above=True),
    "onboard.budget_minutes": Range(0, 1e6, above=True),
    "onboard.steps": _whole(1, 10**9),
    "onboard.frames": _whole(1, 10_000_000),
    "onboard.test_frames": COUNT,
    "onboard.workers": _whole(1, 256),
    # tracker
    "motion.translation_mm": Range(0, 10_000, many=True),  # or by axis
    "motion.rotation_deg": Range(0, 180, many=True),
    "motion.velocity_gain": SHARE,
    "motion.max_noise_scale": Range(1, 1000),
    **{
        f"tracker.{part}.{name}": allowed
        for part in ("follow", "probe", "search")
        for name, allowed in {
            "min_particles": _whole(1, 100_000),
            "max_particles": _whole(1, 100_000),
            "proposals": _whole(0, 100_000),
            "steps": _whole(1, 10_000),
            "initial_sigma": METERS,
            "final_sigma": METERS,
            "pixels": COUNT,
        }.items()
    },
    **_each("tracker", Range(0, 100), "noise_scale", "smoothing_noise"),
    **_each("tracker", Range(0, 1000), "icp_prior", "jump_penalty", "elsewhere_penalty"),
    **_each("tracker", SHARE, "lost_below", "found_above", "search_above"),
    **_each("tracker", COUNT, "fit_pixels", "patience", "probe_every"),
    **_each("tracker", COUNT_OR_NONE, "texture_every", "whole_image_every", "search_every"),
    "tracker.quadratic_fits": _whole(0, 10_000),
    "tracker.kld_epsilon": POSITIVE,
    "tracker.kld_quantile": Range(0, 0.999_999_999, above=True),
    "tracker.kld_bin_size": METERS,
    "tracker.window_side": _whole(64, MOST_SIDE),
    "tracker.window_scale": Range(1, 100),
    # trainer, callbacks
    **_each("trainer", _whole(1, 10**12, words=(-1,)), "max_steps", "max_epochs"),
    **_each("trainer", _whole(0, 10**12), "min_steps", "min_epochs", "log_every_n_steps"),
    "trainer.val_check_interval": _whole(1, 10**12, above=False, share=True),
    **_each("trainer", COUNT, "check_val_every_n_epoch", "accumulate_grad_batches", "num_nodes"),
    "trainer.num_sanity_val_steps": _whole(-1, 10**12),
    "trainer.gradient_clip_val": WEIGHT,
    **_each("trainer", BATCHES, "limit_train_batches", "limit_val_batches", "limit_test_batches"),
    **_each("trainer", BATCHES, "limit_predict_batches", "overfit_batches"),
    "trainer.devices": _whole(1, 1024, words=("auto", -1), many=True),
    "trainer.devices[]": _whole(0, 1023),  # a list names them, from 0
    "every_n_validations": COUNT,
    "save_top_k": _whole(-1, 1000),
    "budget.seconds": Range(0, 1e9, above=True),
    "budget.fewest": _whole(0, 10**6),
    "last.minutes": Range(0, 1e6),
    # optimizer, scheduler
    **dict.fromkeys(("lr", "adam_lr", "weight_decay"), Range(0, 10)),
    "momentum": SHARE,
    "optimizer.eps": Range(0, 1, above=True, many=True),  # Adafactor has two
    "betas": Range(0, 0.999_999_999, many=True),
    "scheduler.warmup_steps": _whole(0, 10**12),
    "scheduler.min_lr_fraction": SHARE,
    # filter
    **dict.fromkeys(("particles", "initial_particles"), _whole(1, 100_000)),
    "filter.steps": _whole(1, 10_000),
    "filter.magnified_width": Range(0, 1, above=True),
    "depth_offset": Range(-10, 10, many=True),
    **dict.fromkeys(("uniform_fraction", "object_fraction"), SHARE),
    "sigma_px": PIXELS,
    **_each("schedule", POSITIVE, "sigma", "initial_sigma", "final_sigma"),
    "propagate.noise_scale": Range(0, 100),
    "uniform_angle_probability": SHARE,
    **_each("resample", SHARE, "alpha", "threshold"),
    **_each("resample", COUNT, "iterations", "size", "niches"),
    "resample.epsilon": POSITIVE,
    "resample.floor": Range(0, 1, above=True),
    **_each("estimate", POSITIVE, "bandwidth", "radius"),
    **_each("estimate", COUNT, "hypotheses", "top_fragments"),
    "estimate.iterations": COUNT_OR_NONE,
    "estimate.scale_m": METERS,
    "estimate.effective_particles": Range(0, 1e6, above=True),
    **_each("refine", COUNT, "pixels", "points", "samples", "antithetic_pairs"),
    **_each("refine", COUNT, "iterations", "rounds"),
    **_each("refine", METERS, "sigma", "initial_scale", "final_scale", "texture_error", "gate"),
    **_each("refine", METERS, "initial_gate", "final_gate", "prior", "noise"),
    **_each("refine", POSITIVE, "temperature", "effective", "independent"),
    **_each("refine", SHARE, "rotation_probability", "min_correlation", "min_effective"),
    **_each("refine", WEIGHT, "learned_weight", "min_gain"),
    "refine.top_k": _whole(0, 100_000),
    "refine.steps": COUNT_OR_NONE,
    "refine.sweeps": _whole(0, 10_000),
    "refine.widening": Range(1, 1e6),
    "refine.initial_blur": Range(1, 100),
    # model
    "model.pixels": COUNT,
    "train_pixels": COUNT,
    "likelihood_batch_size": _whole(1, 100_000),
    **dict.fromkeys(("proposal_weight", "objectness_weight"), WEIGHT),
    "truncate": COUNT,
    **dict.fromkeys(("width", "fragments"), WIDTH),
    "widths": _whole(1, 65_536, many=True),
    **dict.fromkeys(("hidden", "latent_width", "context"), _whole(0, 65_536)),
    **dict.fromkeys(("layers", "blocks"), _whole(1, 1000)),
    "levels": _whole(1, 64),
    "kernel": _whole(1, 1001),
    "max_width_px": _whole(32, MOST_SIDE),
    "encoder.spacings_m": Range(0, 1, above=True, many=True),
    "encoder.size": _whole(5, 64),
    "encoder.trunk.stages": _whole(1, 4),
    "glimpse.size": _whole(1, 1024),
    "glimpse.spacing": Range(0, 1024, above=True),
    "likelihood.spread": POSITIVE,
    "likelihood.surface.points": _whole(1, 4096),
    "displacement.max_displacement": Range(0, 10, above=True),
    **_each("candidate_sampler", COUNT, "rays", "samples", "candidates_per_kind"),
    **_each("candidate_sampler", METERS, "initial_sigma", "min_depth", "tolerance"),
    "candidate_sampler.margin_behind": Range(0, 100),
    "candidate_sampler.proposals": COUNT_OR_NONE,
    "candidate_sampler.particles": _whole(0, 100_000),
    "candidate_sampler.sigma_levels": _whole(2, 1000),
    "candidate_sampler.persistent_sigma_probability": SHARE,
    "candidate_sampler.sigma_range": Range(0, 100, above=True, many=True),
    "box_head.quantile": Range(0, 0.5),
    "model.cells": _whole(3, 1_000_000),
    "model.inlier": POSITIVE,
    "model.refits": _whole(0, 1000),
    "model.peaks": _whole(1, 100),
    "model.subset": _whole(4, 9),
    "model.inlier_px": Range(0, MOST_SIDE, above=True),
    "net.code": _whole(1, 65_536),
    "net.side": _whole(16, 1024),
    "model.crop_radius": Range(0, 10, above=True),
    "model.distance": Range(1, 1e6, above=True),
    "model.crops": _whole(2, 100_000),
    "model.train_cells": COUNT,
    "model.near_cells": _whole(1, 1000),
    "train_rollout.steps": _whole(1, 10_000),
    # loss
    **_each("loss", COUNT, "points", "max_pixels"),
    **_each("loss", POSITIVE, "scale", "sigma"),
    "terms.mask.sigma": POSITIVE,
    "terms.mask.max_pixels": COUNT,
    **_each("model", POSITIVE, "translation_mm", "rotation_deg"),  # wide: no messages
    "terms.pose.translation_mm": POSITIVE,
    "terms.pose.rotation_deg": Range(0, 180, above=True),
    "loss.gamma": Range(0, 100),
    "loss.alpha": SHARE,
    "loss.weight": WEIGHT,
    **_each("aux_losses", WEIGHT, "displacement.weight", "likelihood.weight", "pose.weight"),
    **dict.fromkeys(("fragment_weight", "offset_weight"), WEIGHT),
    "label.size": _whole(1, 1024),
    "label.scale": POSITIVE,
    "label.tolerance": METERS,
    **_each("label", Range(-1e6, 1e6), "surface_label", "behind_label"),
    "label.max_displacement": Range(0, 10, above=True),
    "margin_px": PIXELS,
    "loss_schedule.until": SHARE,
    **_each("loss_schedule.loss_weights", WEIGHT, "loss", "likelihood", "displacement", "pose"),
    **_each("loss_schedule.loss_weights", WEIGHT, "objectness", "sides"),
}


def check_ranges(settings: Mapping[str, Any], command: str) -> None:
    """Check every number of a configuration.

    Args:
        settings: Plain settings; texts with interpolations are left to where they point.
        command: The command's name, or `data` for the settings of the data alone.

    Raises:
        UserError: A setting is outside of its range, or no number where one is expected; or any
            number is not finite.
    """
    for key, value, ours in list_nodes(settings):
        if value is None or (isinstance(value, str) and "${" in value) or value == "???":
            continue
        place = f"{command}.{key}"
        allowed = find_range(place) if ours else None
        shown = place if command == "data" else key
        if isinstance(value, Mapping):
            if allowed is not None and "_target_" not in value:  # a component of such a name
                raise UserError(f"{shown}: must be {allowed}, and is a mapping")
        elif isinstance(value, list | tuple):
            if allowed is not None and (not allowed.many or key.endswith("]")):
                raise UserError(f"{shown}={list(value)}: must be one number, and is a list")
        elif allowed is not None and not allowed.holds(value):
            shown = re.sub(r"\[\d+\]$", "", shown)  # of a list that is a setting's value
            raise UserError(f"{shown}={value}: must be {allowed}")
        elif isinstance(value, float) and not math.isfinite(value):
            raise UserError(f"{key}={value}: must be a finite number")


def find_range(place: str) -> Range | None:
    """Return the range of a setting, None where the table has none.

    Args:
        place: Dotted, the command's name first.
    """
    names = [part.partition("[")[0] for part in place.split(".")]
    parts = [name for name in names if name != "components"]  # the parts of a Compose
    ends = [".".join(parts[i:]) for i in range(len(parts))]
    entry = "[]" if place.endswith("]") else ""  # one of a list may have a range of its own
    keys = [key for end in ends for key in (f"{end}{entry}", end)]
    return next((RANGES[key] for key in keys if key in RANGES), None)


def list_nodes(node: Any, key: str = "", ours: bool = True) -> Iterator[tuple[str, Any, bool]]:
    """Yield (key, value, ours) of each setting, sections and lists included; `ours` is False below
    a class of a plug-in, whose settings may mean anything.
    """
    if key:
        yield key, node, ours
    if isinstance(node, Mapping):
        target = node.get("_target_")
        ours = ours if target is None else str(target).startswith(_OURS)
        for name, value in node.items():
            yield from list_nodes(value, f"{key}.{name}" if key else str(name), ours)
    elif isinstance(node, list | tuple):
        for i, value in enumerate(node):
            yield from list_nodes(value, f"{key}[{i}]", ours)
