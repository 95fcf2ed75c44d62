"""Names of settings that have changed: what was typed before, and what is typed now."""

import re
from collections.abc import Mapping
from typing import Any

# groups whose choices, and settings, are found elsewhere
GROUPS = {
    "initialise": "filter/initialize",
    "initialize": "filter/initialize",
    "schedule": "filter/schedule",
    "reweigh": "filter/reweight",
    "reweight": "filter/reweight",
    "resample": "filter/resample",
    "propose": "filter/propagate",
    "propagate": "filter/propagate",
    "estimate": "filter/estimate",
    "refine": "filter/refine",
    "context": "model/encoder",
    "encoder": "model/encoder",
    "glimpse": "model/glimpse",
    "net": "model/net",
    "pose_code": "model/pose_head",
    "pose_head": "model/pose_head",
    "bounds": "model/box_head",
    "box_head": "model/box_head",
    "motion": "model/displacement",
    "displacement": "model/displacement",
    "likelihood": "model/likelihood",
    "proposals": "model/proposals",
    "lesson": "model/candidate_sampler",
    "candidate_sampler": "model/candidate_sampler",
    "train_filter": "model/train_rollout",
    "motion_lesson": "loss/aux/displacement",
    "aux_displacement": "loss/aux/displacement",
    "likelihood_lesson": "loss/aux/likelihood",
    "aux_likelihood": "loss/aux/likelihood",
    "pose_lesson": "loss/aux/pose",
    "aux_pose": "loss/aux/pose",
    "stages": "loss/schedule",
    "loss_schedule": "loss/schedule",
    "augment": "data/augment",
    "rung": "ablation",
    "deviation": "preset",
}
# groups and settings that are one setting now
KEYS = {
    "normalisation": "model.net.normalization",
    "normalization": "model.net.normalization",
    "place_gradient": "model.detach_position",
    "model.place_gradient": "model.detach_position",
    "patch": "model.glimpse.size",
    "lessons": "model.aux_losses",
    "aux_losses": "model.aux_losses",
    "callbacks.figures.every": "callbacks.figures.every_n_validations",
    "callbacks.figures.without": "callbacks.figures.exclude",
    "most_mb": "max_mb",
    "compact": "quantize",
    "model.relevance": "model.relevance_weight",
    "tracker.walk": "tracker.move_scale",
    "tracker.jump": "tracker.jump_penalty",
    "tracker.epsilon": "tracker.kld_epsilon",
    "tracker.quantile": "tracker.kld_quantile",
    "tracker.cell": "tracker.kld_cell",
    "tracker.look_around": "tracker.whole_image_every",
    "tracker.side": "tracker.window_side",
    "tracker.reach": "tracker.window_scale",
    "tracker.noise": "tracker.smoothing_noise",
    "tracker.full_every": "tracker.search_every",
    "tracker.full_search_every": "tracker.search_every",
    "tracker.motion.shift_mm": "tracker.motion.translation_mm",
    "tracker.motion.turn_deg": "tracker.motion.rotation_deg",
    "tracker.follow.least": "tracker.follow.min_particles",
    "tracker.follow.most": "tracker.follow.max_particles",
    "tracker.search.least": "tracker.search.min_particles",
    "tracker.search.most": "tracker.search.max_particles",
}
_NODES = {"model/train_rollout": "model.train_filter", "loss/schedule": "model.loss_schedule"}
_CHOICES = {
    "filter": {"pose_paper": "pose filter.particles=1000 filter.steps=100"},
    "filter/estimate": {"best": "argmax"},
    "filter/resample": {
        "never": "none",
        "transport": "optimal_transport_sampled",
        "ensemble": "optimal_transport",
        "guided": "auxiliary",
    },
    "filter/reweight": {
        "annealed": "current_likelihood",
        "tempered": "likelihood_ratio",
        "sequential": "sequential_bayes",
    },
    "filter/propagate": {"still": "identity"},
    "model/displacement": {"held": "gated"},
    "model/encoder": {
        "resnet18": "resnet model.encoder.trunk.kind=resnet18",
        "resnet34": "resnet model.encoder.trunk.kind=resnet34",
    },
    "model/train_rollout": {"same": "full", "truncated": "short"},
    "loss/aux/displacement": {
        "center": "towards model.aux_losses.displacement.loss.label.target=center"
    },
    "loss/aux/pose": {"own_point": "surface_point"},
    "model/pose_head": {"own_point": "surface_point"},
    "data/augment": {"whole": "strong_full_image", "camera_whole": "camera_full_image"},
    "loss/schedule": {
        "three": "three_stages",
        "three_motion": "three_stages_displacement",
        "only_motion": "displacement_only",
        "only_likelihood": "likelihood_only",
    },
    "model.detach_position": {
        "flows": "false",
        "stopped": "true",
        "true": "false",
        "false": "true",
    },
    "experiment": {"memorise": "memorize"},
    "console": {"plain": "json"},
    "callbacks": {"none": "checkpoints"},
    "debug": {"trace": "traceback"},
    "sweep": {"ladder": "ablation", "ladder_detect": "ablation_detect"},
    "ablation": {
        "s4_lesson": "s4_displacement_loss",
        "s5_place": "s5_position",
        "s9_lesson_and_place": "s9_displacement_loss_and_position",
        "c1_normalisation": "c1_normalization",
        "c5_lesson": "c5_displacement_loss",
        "c6_place": "c6_position",
        "c8_truncated": "c8_short",
        "pose_c11_own_point": "pose_c11_surface_point",
        "pose_m14_own_point": "pose_m14_surface_point",
        "pose_c16_held": "pose_c16_gated",
        "box_c12_held": "box_c12_gated",
        "m1_normalisation": "m1_normalization",
        "m5_lesson": "m5_displacement_loss",
        "m6_place": "m6_position",
        "m8_truncated": "m8_short",
        "m12_held": "m12_gated",
        "m13_rate": "m13_scheduler",
    },
}
# classes, by their place below posefilter
CLASSES = {
    "filters.guided.Guided": "filters.auxiliary.AuxiliaryResampling",
    "filters.transport.Ensemble": "filters.transport.EnsembleTransform",
    "filters.transport.OptimalTransport": "filters.transport.SampledTransport",
}
_RELEVANCE = {"relevance": "relevance_weight"}
# arguments of classes, by the class's place below posefilter
ARGUMENTS = {
    "filters.propagate.Chain": {"pieces": "components"},
    "filters.propagate.Gaussian": {"factor": "noise_scale"},
    "filters.propagate.HalfTurns": {"share": "probability"},
    "filters.propagate.AxisTurns": {
        "share": "probability",
        "any_angle": "uniform_angle_probability",
    },
    "filters.refine.Chain": {"pieces": "components"},
    "filters.refine.Rescore": {"top": "top_k"},
    "filters.refine.MeanShift": {"rounds": "iterations", "pairs": "antithetic_pairs"},
    "filters.agreement.Agreement": {"rounds": "iterations"},
    "filters.initialize.FromDepth": {"behind": "depth_offset"},
    "filters.initialize.FromRelevance": {"anywhere": "uniform_fraction"},
    "filters.initialize.Informed": {
        "otherwise": "initializer",
        "share": "object_fraction",
        "around_px": "sigma_px",
    },
    "models.candidate_samplers.CandidatePoses": {
        "each": "candidates_per_kind",
        "proposed": "proposals",
        "own_level": "persistent_sigma_probability",
    },
    "models.candidate_samplers.LabeledRays": {"past": "margin_behind"},
    "models.box_heads.SpreadBox": {"beyond": "quantile"},
    "models.cnn_patch.CnnPatch": _RELEVANCE,
    "models.downsized.Downsized": _RELEVANCE,
    "models.patch_pf.PatchPF": _RELEVANCE,
    "models.pixel_pf.PixelPF": _RELEVANCE,
    "models.muon.Muon": {"spared": "adam_layers"},
    "nets.paper_likelihood.PaperLikelihood": {"about": "anchor"},
    "losses.displacement.Chamfer": {"most": "max_pixels"},
    "losses.rgbd_chamfer.RgbdChamfer": {"most": "max_pixels"},
    "losses.pose_loss.SurfacePointLoss": {"within": "offset_weight"},
    "labels.paper_points.PaperPoints": {"on": "surface_label", "behind": "behind_label"},
    "data.augmentation.RollAndZoom": {"about": "pivot", "any_roll": "uniform_roll_probability"},
    "data.augmentation.Window": {"anywhere": "uniform_probability"},
    "data.augmentation.Blank": {"most": "max_rectangles"},
    "callbacks.health.FilterHealth": {"most": "max_iterations", "share": "max_time_fraction"},
    "callbacks.diagnostics.Diagnostics": {"share": "max_time_fraction"},
    "callbacks.figures.Figures": {"share": "max_time_fraction"},
}
_BUDGET = "the preset, with its size apart: preset/size="


def rename(override: str) -> str | None:
    """Return what is typed today for an override with names of before; None where nothing changed.

    Args:
        override: As typed, such as `initialise=uniform` or `resample.alpha=0.2`.
    """
    sign, key, equals, value = _split(override)
    if key == "budget":
        return _BUDGET + value.partition("/")[0]
    new = _rename_key(key)
    # its values are turned round, so that they are renamed together with their key alone
    choices = {} if key == new == "model.detach_position" else _CHOICES.get(new, {})
    values = ",".join(choices.get(one, one) for one in value.split(","))
    if (new, values) == (key, value):
        return None
    return f"{sign}{new}{equals}{values}"


def _split(override: str) -> tuple[str, str, str, str]:
    found = re.fullmatch(r"([+~]*)([^=]*)(=?)(.*)", override, re.DOTALL)
    assert found is not None
    return found[1], found[2], found[3], found[4]


def _rename_key(key: str) -> str:
    if key in KEYS:
        return KEYS[key]
    if key in GROUPS:
        return GROUPS[key]
    head, dot, rest = key.partition(".")
    if not dot:
        return key
    if head in GROUPS:
        group = GROUPS[head]
        return f"{_NODES.get(group, group.replace('/', '.'))}.{rest}"
    return f"{KEYS[head]}.{rest}" if head in KEYS else key


def find_renamed(recipe: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the first name of before in a checkpoint's recipe, and today's; None where there is
    none.

    Args:
        recipe: Its `choices` and `settings`.
    """
    old = [*recipe.get("choices", ()), *recipe.get("settings", ())]
    for name in map(str, old):
        if name in GROUPS or name in KEYS:
            return name, _rename_key(name)
    return _find_argument(recipe.get("settings"), "")


def rename_argument(target: object, name: str) -> str | None:
    """Return what an argument of a class is called today; None where its name has not changed.

    Args:
        target: The class, as `_target_` names it.
        name: The argument, as it was called before.
    """
    return ARGUMENTS.get(str(target).removeprefix("posefilter."), {}).get(name)


def rename_class(target: object) -> str | None:
    """Return what a class is called today; None where its name has not changed.

    Args:
        target: The class, as `_target_` named it.
    """
    new = CLASSES.get(str(target).removeprefix("posefilter."))
    return new and f"posefilter.{new}"


def _find_argument(node: Any, place: str) -> tuple[str, str] | None:
    """Return the first class or argument with a name of before in settings, and today's."""
    if isinstance(node, list):
        pairs = [(f"{place}[{i}]", value) for i, value in enumerate(node)]
    elif isinstance(node, Mapping):
        known = rename_class(node.get("_target_"))
        if known is not None:
            return str(node["_target_"]), known
        for name in map(str, node):
            new = rename_argument(node.get("_target_"), name)
            if new is not None:
                return f"{place}.{name}", new
        pairs = [(f"{place}.{key}" if place else str(key), value) for key, value in node.items()]
    else:
        return None
    found = (_find_argument(value, at) for at, value in pairs)
    return next((one for one in found if one is not None), None)
