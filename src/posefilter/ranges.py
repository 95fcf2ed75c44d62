"""Ranges of numeric settings, in one table: a value that makes no sense is refused in one line, by
its key, before anything is built.
"""

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
    "min_visibility": SHARE,
    "min_visibility_test": SHARE,
    "batch_size": _whole(1, 100_000),
    "batch_size_test": _whole(1, 100_000),
    "data.workers": _whole(0, 256),
    "limit_train": COUNT,
    "limit_val": COUNT,
    "limit_test": COUNT,
    "data.num_model_points": _whole(4, 1_000_000),
    "data.texture_points": _whole(4, 20_000),
    "image_width": _whole(16, MOST_SIDE),
    "image_height": _whole(16, MOST_SIDE),
    # data.augment: the rest is checked by its classes
    "uniform_roll_probability": SHARE,
    "probability": SHARE,
    "augment.steps.strength": Range(0, 10),
    "zoom": Range(0, 1e6, above=True, many=True),
    "object_size": Range(0, 10, above=True, many=True),  # [widths of the image]
    "object_size_probability": SHARE,
    "augment.steps.size": Range(
        0, MOST_SIDE, above=True, many=True
    ),  # pixels of a crop, or a share
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
    "generate.occluded_fraction": SHARE,
    "generate.distractors": _whole(0, 1000, many=True),
    "generate.tabletop_fraction": SHARE,
    "generate.absent_fraction": SHARE,
    "generate.instances": _whole(1, 100),
    "generate.frames_per_scene": COUNT,
    "generate.moving_mm": Range(0, 1000),
    "generate.moving_deg": Range(0, 180),
    "generate.fully_occluded_frames": COUNT_OR_NONE,
    # other commands
    "check_data.max_frames": COUNT,
    "predict.instances": _whole(1, 100),
    "depth_scale": UNITS,
    "cost_false_alarm": POSITIVE,
    "cost_miss": POSITIVE,
    "cost_unsure": POSITIVE,
    "pose_tolerance.translation_mm": POSITIVE,
    "pose_tolerance.rotation_deg": POSITIVE,
    "pose_tolerance.add": POSITIVE,
    "pose_tolerance.add_s": POSITIVE,
    "convert_bag.max_time_difference": Range(0, 10),
    "evaluate.absent_frames": COUNT_OR_NONE,
    "calibrate.frames": _whole(10, 1_000_000),
    "calibrate.absent_frames": _whole(10, 1_000_000),
    "track.stride": COUNT,
    "track.fps": Range(0.1, 1000),
    "export.points": COUNT,
    "export.width": _whole(16, MOST_SIDE),
    "export.height": _whole(16, MOST_SIDE),
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
    "tracker.noise_scale": Range(0, 100),
    "tracker.quadratic_fits": _whole(0, 10_000),
    "tracker.fit_pixels": COUNT,
    "tracker.icp_prior": Range(0, 1000),
    "tracker.texture_every": COUNT_OR_NONE,
    "tracker.jump_penalty": Range(0, 1000),
    "tracker.kld_epsilon": POSITIVE,
    "tracker.kld_quantile": Range(0, 0.999_999_999, above=True),
    "tracker.kld_bin_size": METERS,
    "tracker.whole_image_every": COUNT_OR_NONE,
    "tracker.window_side": _whole(64, MOST_SIDE),
    "tracker.window_scale": Range(1, 100),
    "tracker.smoothing_noise": Range(0, 100),
    "tracker.lost_below": SHARE,
    "tracker.found_above": SHARE,
    "tracker.patience": COUNT,
    "tracker.search_above": SHARE,
    "tracker.probe_every": COUNT,
    "tracker.search_every": COUNT_OR_NONE,
    # trainer, callbacks
    "trainer.max_steps": _whole(1, 10**12, words=(-1,)),
    "trainer.min_steps": _whole(0, 10**12),
    "trainer.max_epochs": _whole(1, 10**12, words=(-1,)),
    "trainer.min_epochs": _whole(0, 10**12),
    "trainer.val_check_interval": _whole(1, 10**12, above=False, share=True),
    "trainer.check_val_every_n_epoch": COUNT,
    "trainer.log_every_n_steps": _whole(0, 10**12),
    "trainer.num_sanity_val_steps": _whole(-1, 10**12),
    "trainer.gradient_clip_val": WEIGHT,
    "trainer.accumulate_grad_batches": COUNT,
    **{f"trainer.limit_{part}_batches": BATCHES for part in ("train", "val", "test", "predict")},
    "trainer.overfit_batches": BATCHES,
    "trainer.num_nodes": COUNT,
    "trainer.devices": _whole(1, 1024, words=("auto", -1), many=True),
    "trainer.devices[]": _whole(0, 1023),  # a list names them, from 0
    "every_n_validations": COUNT,
    "save_top_k": _whole(-1, 1000),
    "budget.seconds": Range(0, 1e9, above=True),
    "last.minutes": Range(0, 1e6),
    # optimizer, scheduler
    "lr": Range(0, 10),
    "adam_lr": Range(0, 10),
    "weight_decay": Range(0, 10),
    "momentum": SHARE,
    "optimizer.eps": Range(0, 1, above=True),
    "betas": Range(0, 0.999_999_999, many=True),
    "scheduler.warmup_steps": _whole(0, 10**12),
    "scheduler.min_lr_fraction": SHARE,
    # filter
    "particles": _whole(1, 100_000),
    "initial_particles": _whole(1, 100_000),
    "filter.steps": _whole(1, 10_000),
    "filter.zoom_diameter": Range(0, 1, above=True),
    "depth_offset": Range(-10, 10, many=True),
    "uniform_fraction": SHARE,
    "object_fraction": SHARE,
    "sigma_px": PIXELS,
    "schedule.sigma": POSITIVE,
    "schedule.initial_sigma": POSITIVE,
    "schedule.final_sigma": POSITIVE,
    "propagate.noise_scale": Range(0, 100),
    "uniform_angle_probability": SHARE,
    "resample.alpha": SHARE,
    "resample.epsilon": POSITIVE,
    "resample.iterations": COUNT,
    "resample.threshold": SHARE,
    "resample.floor": Range(0, 1, above=True),
    "resample.size": COUNT,
    "estimate.bandwidth": POSITIVE,
    "estimate.radius": POSITIVE,
    "estimate.scale_m": METERS,
    "estimate.hypotheses": COUNT,
    "estimate.iterations": COUNT_OR_NONE,
    "estimate.top_fragments": COUNT,
    "estimate.effective_particles": Range(0, 1e6, above=True),
    "refine.top_k": _whole(0, 100_000),
    "refine.pixels": COUNT,
    "refine.sigma": METERS,
    "refine.steps": COUNT_OR_NONE,
    "refine.antithetic_pairs": COUNT,
    "refine.samples": COUNT,
    "refine.rounds": COUNT,
    "refine.sweeps": _whole(0, 10_000),
    "refine.rotation_probability": SHARE,
    "refine.widening": Range(1, 1e6),
    "refine.temperature": POSITIVE,
    "refine.initial_scale": METERS,
    "refine.final_scale": METERS,
    "refine.learned_weight": WEIGHT,
    "refine.iterations": COUNT,
    "refine.initial_gate": METERS,
    "refine.final_gate": METERS,
    "refine.prior": METERS,
    "refine.noise": METERS,
    "refine.effective": POSITIVE,
    "refine.points": COUNT,
    "refine.initial_blur": Range(1, 100),
    "refine.independent": POSITIVE,
    "refine.min_correlation": SHARE,
    "refine.texture_error": METERS,
    "refine.min_gain": WEIGHT,
    "refine.gate": METERS,
    # model
    "model.pixels": COUNT,
    "train_pixels": COUNT,
    "likelihood_batch_size": _whole(1, 100_000),
    "proposal_weight": WEIGHT,
    "truncate": COUNT,
    "objectness_weight": WEIGHT,
    "width": WIDTH,
    "widths": _whole(1, 65_536, many=True),
    "hidden": _whole(0, 65_536),
    "latent_width": _whole(0, 65_536),
    "layers": _whole(1, 1000),
    "blocks": _whole(1, 1000),
    "levels": _whole(1, 64),
    "kernel": _whole(1, 1001),
    "context": _whole(0, 65_536),
    "max_width_px": _whole(16, MOST_SIDE),
    "fragments": WIDTH,
    "glimpse.size": _whole(1, 1024),
    "glimpse.spacing": Range(0, 1024, above=True),
    "likelihood.spread": POSITIVE,
    "likelihood.surface.points": _whole(1, 4096),
    "displacement.max_displacement": Range(0, 10, above=True),
    "candidate_sampler.rays": COUNT,
    "candidate_sampler.samples": COUNT,
    "candidate_sampler.initial_sigma": METERS,
    "candidate_sampler.min_depth": METERS,
    "candidate_sampler.margin_behind": Range(0, 100),
    "candidate_sampler.tolerance": METERS,
    "candidate_sampler.candidates_per_kind": COUNT,
    "candidate_sampler.proposals": COUNT_OR_NONE,
    "candidate_sampler.particles": _whole(0, 100_000),
    "candidate_sampler.sigma_levels": _whole(2, 1000),
    "candidate_sampler.persistent_sigma_probability": SHARE,
    "candidate_sampler.sigma_range": Range(0, 100, above=True, many=True),
    "box_head.quantile": SHARE,
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
    "train_filter.steps": _whole(1, 10_000),
    # loss
    "loss.points": COUNT,
    "loss.max_pixels": COUNT,
    "loss.scale": POSITIVE,
    "loss.sigma": POSITIVE,
    "terms.mask.sigma": POSITIVE,
    "terms.mask.max_pixels": COUNT,
    "terms.pose.translation_mm": POSITIVE,
    "terms.pose.rotation_deg": Range(0, 180, above=True),
    "loss.gamma": Range(0, 100),
    "loss.alpha": SHARE,
    "loss.weight": WEIGHT,
    **{f"aux_losses.{name}.weight": WEIGHT for name in ("displacement", "likelihood", "pose")},
    "fragment_weight": WEIGHT,
    "offset_weight": WEIGHT,
    "label.size": _whole(1, 1024),
    "label.scale": POSITIVE,
    "label.tolerance": METERS,
    "label.surface_label": Range(-1e6, 1e6),
    "label.behind_label": Range(-1e6, 1e6),
    "label.max_displacement": Range(0, 10, above=True),
    "margin_px": PIXELS,
    "loss_schedule.until": SHARE,
    **{
        f"loss_schedule.loss_weights.{name}": WEIGHT
        for name in ("loss", "likelihood", "displacement", "pose", "objectness", "sides")
    },
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
