"""Names of settings that have changed: what was typed before, and what is typed now."""

import re
from collections.abc import Mapping
from typing import Any

# groups whose choices, and settings, are found elsewhere: by today's name, those of before
_GROUPS = {
    "filter/initialize": ("initialise", "initialize"),
    "filter/schedule": ("schedule",),
    "filter/reweight": ("reweigh", "reweight"),
    "filter/resample": ("resample",),
    "filter/propagate": ("propose", "propagate"),
    "filter/estimate": ("estimate",),
    "filter/refine": ("refine",),
    "model/encoder": ("context", "encoder"),
    "model/glimpse": ("glimpse",),
    "model/net": ("net",),
    "model/pose_head": ("pose_code", "pose_head"),
    "model/box_head": ("bounds", "box_head"),
    "model/displacement": ("motion", "displacement"),
    "model/likelihood": ("likelihood",),
    "model/proposals": ("proposals",),
    "model/candidate_sampler": ("lesson", "candidate_sampler"),
    "model/train_rollout": ("train_filter",),
    "loss/aux/displacement": ("motion_lesson", "aux_displacement"),
    "loss/aux/likelihood": ("likelihood_lesson", "aux_likelihood"),
    "loss/aux/pose": ("pose_lesson", "aux_pose"),
    "loss/schedule": ("stages", "loss_schedule"),
    "data/augment": ("augment",),
    "ablation": ("rung",),
    "preset": ("deviation",),
}
GROUPS = {old: new for new, before in _GROUPS.items() for old in before}
_GENERATE = {
    "occlusion": "max_occlusion",
    "occluded_share": "occluded_fraction",
    "tabletop_share": "tabletop_fraction",
    "absent_share": "absent_fraction",
    "covered_frames": "fully_occluded_frames",
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
    "model.relevance": "model.objectness_weight",
    "model.candidate_sampler.turns": "model.candidate_sampler.rotations",
    "data.points": "data.num_model_points",
    "data.model_points": "data.model_points_dir",
    **{f"data.generate.{old}": f"data.generate.{new}" for old, new in _GENERATE.items()},
    "filter.looks": "filter.max_searches",
    "filter.first_particles": "filter.initial_particles",
    "model.train_filter.first_particles": "model.train_filter.initial_particles",
    "model.candidate_sampler.levels": "model.candidate_sampler.sigma_levels",
    "tracker.walk": "tracker.noise_scale",
    "tracker.move_scale": "tracker.noise_scale",
    "tracker.kld_cell": "tracker.kld_bin_size",
    "tracker.jump": "tracker.jump_penalty",
    "tracker.epsilon": "tracker.kld_epsilon",
    "tracker.quantile": "tracker.kld_quantile",
    "tracker.cell": "tracker.kld_bin_size",
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
    "tracker.fit_points": "tracker.fit_pixels",
    "tracker.rounds": "tracker.quadratic_fits",
    "tracker.motion.momentum": "tracker.motion.velocity_gain",
    "tracker.motion.widest": "tracker.motion.max_noise_scale",
    "tracker.look_every": "tracker.probe_every",
    "tracker.look": "tracker.probe",
    **{
        f"tracker.{part}.{old}": f"tracker.{now}.{new}"
        for part, now in (("follow", "follow"), ("look", "probe"), ("search", "search"))
        for old, new in (("start", "initial_sigma"), ("stop", "final_sigma"), ("points", "pixels"))
    },
}
_NAMES = GROUPS | KEYS
# settings of single commands
COMMANDS = {
    "calibrate": {"replace": "overwrite"},
    "check_data": {"limit": "max_frames"},
    "convert_bag": {"keep": "copy_messages", "tolerance": "max_time_difference"},
    "generate": _GENERATE,
    "onboard": {
        "settings": "train_overrides",
        "clutter": "distractor_meshes",
        "clutter_scale": "distractor_scale",
    },
    "predict": {"view": "save_rerun"},
    "track": {"video": "save_video", "view": "save_rerun"},
}
_NODES = {"model/train_rollout": "model.train_filter", "loss/schedule": "model.loss_schedule"}
_LOOKALIKE_TEXTURE = {"other": "different", "own": "same"}
_CHOICES = {
    "filter": {"pose_paper": "pose filter.particles=1000 filter.steps=100"},
    "filter/estimate": {"best": "argmax"},
    "filter/initialize": {"from_relevance": "from_objectness"},
    "symmetries": {"found": "auto"},
    "scheduler": {"warm_cosine": "warmup_cosine"},
    "loss": {"contrast": "contrastive", "belief_maps": "heatmaps"},
    "model/box_head": {"spread": "quantiles"},
    "filter/resample": {
        "never": "none",
        "below_ess": "adaptive",
        "transport": "optimal_transport_sampled",
        "ensemble": "optimal_transport",
        "guided": "auxiliary",
    },
    "filter/reweight": {
        "annealed": "current_likelihood",
        "tempered": "likelihood_ratio",
        "sequential": "sequential_bayes",
    },
    "filter/propagate": {"still": "identity", "gaussian_and_turns": "gaussian_and_axis_rotations"},
    "filter/refine": {"mean_shift_and_moves": "mean_shift_and_resample_move"},
    "model/displacement": {"held": "gated"},
    "model/encoder": {
        "resnet18": "resnet model.encoder.trunk.kind=resnet18",
        "resnet34": "resnet model.encoder.trunk.kind=resnet34",
    },
    "model/train_rollout": {"same": "full", "truncated": "short"},
    "model/glimpse": {"smooth": "bilinear"},
    "model/likelihood": {"contrastive": "pointwise"},
    "model/candidate_sampler": {"candidates": "poses"},
    "loss/aux/likelihood": {"balanced": "balanced_bce"},
    "loss/aux/displacement": {
        "towards": "towards_object",
        "center": "towards_object model.aux_losses.displacement.loss.label.target=center",
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
    "lookalike_texture": _LOOKALIKE_TEXTURE,
    "data.generate.lookalike_texture": _LOOKALIKE_TEXTURE,
    "experiment": {"memorise": "memorize"},
    "console": {"plain": "json"},
    "callbacks": {"none": "checkpoints"},
    "debug": {"trace": "traceback"},
    "sweep": {
        "ablation_pose": "ablation_pose_pf",
        "ladder": "ablation",
        "ladder_detect": "ablation_detect",
        "iterations": "steps",
    },
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
    "filters.initialize.FromRelevance": "filters.initialize.FromObjectness",
    "filters.propagate.AxisTurns": "filters.propagate.AxisRotations",
    "filters.propagate.HalfTurns": "filters.propagate.HalfTurnRotations",
    "filters.texture.TextureTurns": "filters.texture.TextureRotations",
    "losses.belief_maps.BeliefMaps": "losses.heatmaps.Heatmaps",
    "nets.belief_maps.BeliefMapNet": "nets.heatmaps.HeatmapNet",
    "filters.propagate.Chain": "filters.propagate.Compose",
    "filters.resample.BelowESS": "filters.resample.AdaptiveResampling",
    "filters.refine.Chain": "filters.refine.Compose",
    "filters.reweight.Annealed": "filters.reweight.CurrentLikelihood",
    "filters.reweight.Sequential": "filters.reweight.SequentialBayes",
    "filters.reweight.TemperedSMC": "filters.reweight.LikelihoodRatio",
    "losses.contrast.Contrast": "losses.contrastive.Contrastive",
    "nets.glimpse.SmoothGlimpse": "nets.glimpse.BilinearGlimpse",
    "models.box_heads.SpreadBox": "models.box_heads.QuantileBox",
    "models.schedules.warm_cosine": "models.lr_schedulers.warmup_cosine",
    "models.schedules.warmup_cosine": "models.lr_schedulers.warmup_cosine",
    "nets.context.NoContext": "nets.encoders.NoEncoder",
    "nets.context.Pyramid": "nets.encoders.PyramidEncoder",
    "nets.context.ConvEncoder": "nets.encoders.UNetEncoder",
    "nets.context.ResNetContext": "nets.encoders.ResNetEncoder",
    "data.augmentation.Window": "data.augmentation.RandomCrop",
    "data.augmentation.Blank": "data.augmentation.RandomErasing",
    "data.augmentation.Color": "data.augmentation.ColorJitter",
}
_LOSSES = {"relevance": "objectness"}
_OBJECTNESS = {"relevance": "objectness_weight", "relevance_weight": "objectness_weight"}
# arguments of classes, by today's place of the class below posefilter
ARGUMENTS = {
    "filters.loop.ParticleFilter": {
        "looks": "max_searches",
        "first_particles": "initial_particles",
    },
    "filters.propagate.Compose": {"pieces": "components"},
    "filters.propagate.Gaussian": {"factor": "noise_scale"},
    "filters.propagate.HalfTurnRotations": {"share": "probability"},
    "filters.propagate.AxisRotations": {
        "share": "probability",
        "any_angle": "uniform_angle_probability",
    },
    "filters.refine.Compose": {"pieces": "components"},
    "filters.refine.Rescore": {"top": "top_k"},
    "filters.refine.MeanShift": {
        "rounds": "iterations",
        "pairs": "antithetic_pairs",
        "start": "initial_scale",
        "end": "final_scale",
    },
    "filters.resample_move.ResampleMove": {"turn_probability": "rotation_probability"},
    "filters.schedule.Geometric": {"start": "initial_sigma", "stop": "final_sigma"},
    "filters.agreement.Agreement": {
        "rounds": "iterations",
        "options": "top_fragments",
        "counts": "effective_particles",
    },
    "filters.initialize.FromDepth": {"behind": "depth_offset"},
    "filters.initialize.FromObjectness": {"anywhere": "uniform_fraction"},
    "filters.initialize.Informed": {
        "otherwise": "initializer",
        "share": "object_fraction",
        "around_px": "sigma_px",
    },
    "models.candidate_samplers.CandidatePoses": {
        "each": "candidates_per_kind",
        "turns": "rotations",
        "levels": "sigma_levels",
        "proposed": "proposals",
        "own_level": "persistent_sigma_probability",
        "sigma": "sigma_range",
        "start": "initial_sigma",
    },
    "models.candidate_samplers.LabeledRays": {"past": "margin_behind", "start": "min_depth"},
    "models.box_heads.QuantileBox": {"beyond": "quantile"},
    "models.cnn_patch.CnnPatch": _OBJECTNESS,
    "models.downsized.Downsized": _OBJECTNESS,
    "models.patch_pf.PatchPF": _OBJECTNESS,
    "models.pixel_pf.PixelPF": _OBJECTNESS,
    "models.pose_pf.PosePF": {"even_points": "quasi_monte_carlo"},
    "models.rotation_grid.RotationGrid": {"reach": "crop_radius"},
    "models.loss_schedule.Stage": {"factors": "loss_weights"},
    "models.muon.Muon": {"spared": "adam_layers"},
    "models.lr_schedulers.warmup_cosine": {"warm_up": "warmup_steps", "floor": "min_lr_fraction"},
    "nets.encoders.UNetEncoder": {"most_px": "max_width_px"},
    "nets.heads.Bounded": {"reach": "max_displacement"},
    "nets.mlp.LatentNet": {"displacement_reads": "displacement_input"},
    "labels.displacement.TowardsObject": {"reach": "max_displacement"},
    "nets.paper_likelihood.PaperLikelihood": {"about": "anchor"},
    "losses.displacement.Chamfer": {"most": "max_pixels"},
    "losses.rgbd_chamfer.RgbdChamfer": {"most": "max_pixels"},
    "losses.pose_loss.SurfacePointLoss": {"within": "offset_weight"},
    "labels.paper_points.PaperPoints": {"on": "surface_label", "behind": "behind_label"},
    "data.module.PoseDataModule": {
        "points": "num_model_points",
        "model_points": "model_points_dir",
    },
    "synthetic.generate.generate": _GENERATE,
    "data.augmentation.RollAndZoom": {"about": "pivot", "any_roll": "uniform_roll_probability"},
    "data.augmentation.RandomCrop": {"anywhere": "uniform_probability"},
    "data.augmentation.RandomErasing": {"most": "max_rectangles"},
    "callbacks.health.FilterHealth": {"most": "max_iterations", "share": "max_time_fraction"},
    "callbacks.diagnostics.Diagnostics": {"share": "max_time_fraction"},
    "callbacks.figures.Figures": {"share": "max_time_fraction"},
}
# values of arguments of classes, likewise
_VALUES = {("synthetic.generate.generate", "lookalike_texture"): _LOOKALIKE_TEXTURE}
# options of the data module, which its readers take
_DATA = "data.module.PoseDataModule"
_OPTIONS = {
    "bop": {"part": "split"},
    **{source: {"parts": "subsets"} for source in ("fat", "scenes", "ycb_video")},
}
_MISSING = {
    f"data.options.{o}": f"data.options.{n}" for own in _OPTIONS.values() for o, n in own.items()
}
_BUDGET = "the preset, with its size apart: preset/size="


def rename(override: str, command: str | None = None) -> str | None:
    """Return what is typed today for an override with names of before; None where nothing changed.

    Args:
        override: As typed, such as `initialise=uniform` or `resample.alpha=0.2`.
        command: Whose setting it is, for names that single commands have; None: any.
    """
    sign, key, equals, value = _split(override)
    if key == "budget":
        return _BUDGET + value.partition("/")[0]
    commands = (own for name, own in COMMANDS.items() if command in (None, name))
    new = next((own[key] for own in commands if key in own), key)
    # a name of before that, too
    while (newer := _rename_key(new)) != new:
        new = newer
    # its values are turned round, so that they are renamed together with their key alone
    choices = {} if key == new == "model.detach_position" else _choices_of(new)
    values = ",".join(choices.get(one, one) for one in value.split(","))
    if (new, values) == (key, value):
        return None
    return f"{sign}{new}{equals}{values}"


def update(override: str, command: str | None = None) -> str:
    """Return a recorded override as it is typed today."""
    # for a budget there is no one override of today
    return override if override.startswith("budget=") else rename(override, command) or override


def rename_missing(key: str, command: str | None = None) -> str | None:
    """Return what a setting that there is not is called today: also of those whose name a reader of
    one's own may have.
    """
    return rename(key, command) or _MISSING.get(key)


def _split(override: str) -> tuple[str, str, str, str]:
    found = re.fullmatch(r"([+~]*)([^=]*)(=?)(.*)", override, re.DOTALL)
    assert found is not None
    return found[1], found[2], found[3], found[4]


def _rename_key(key: str) -> str:
    if key in _NAMES:
        return _NAMES[key]
    head, dot, rest = key.partition(".")
    if not dot:
        return key
    if head in GROUPS:
        group = GROUPS[head]
        return f"{_NODES.get(group, group.replace('/', '.'))}.{rest}"
    parts = key.split(".")
    places = (".".join(parts[:n]) for n in range(len(parts), 0, -1))
    place = next((one for one in places if one in KEYS), None)
    return key if place is None else KEYS[place] + key.removeprefix(place)


def _choices_of(group: str) -> Mapping[str, str]:
    """Return the renamed choices of a group, wherever its settings go: `filter/resample@...`."""
    return _CHOICES.get(group.partition("@")[0], {})


def find_renamed(recipe: Mapping[str, Any]) -> tuple[str, str] | None:
    """Return the first group or setting of before in a checkpoint's recipe whose values have
    changed too, and today's name; None where there is none.

    Args:
        recipe: Its `choices` and `settings`.
    """
    old = [*recipe.get("choices", ()), *recipe.get("settings", ())]
    return next(((n, _rename_key(n)) for n in map(str, old) if n in _NAMES), None)


def upgrade(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return a checkpoint's recipe with today's names of choices, classes and arguments.

    Args:
        recipe: Its `choices` and `settings`, checked for depth and size.
    """
    choices = {
        group: _choices_of(group).get(choice, choice) for group, choice in recipe["choices"].items()
    }
    return {"choices": choices, "settings": _upgrade(recipe["settings"])}


def _upgrade(node: Any) -> Any:
    if isinstance(node, list):
        return [_upgrade(value) for value in node]
    if not isinstance(node, Mapping):
        return node
    target = rename_class(node.get("_target_")) or node.get("_target_")
    out = {}
    for key, value in node.items():
        name = rename_argument(target, str(key)) or key
        if name == "loss_weights" and isinstance(value, Mapping):  # in a stage of a training
            value = {_LOSSES.get(loss, loss): factor for loss, factor in value.items()}
        if key == "options" and isinstance(value, Mapping) and _below(target) == _DATA:
            renamed = _OPTIONS.get(str(node.get("source")), {})  # a reader of one's own has its own
            both = {old for old, new in renamed.items() if new in value}  # refused by the reader
            value = {n if n in both else renamed.get(n, n): v for n, v in value.items()}
        values = _VALUES.get((_below(target), name), {})
        if isinstance(value, str):
            value = values.get(value, value)
        # both names: the old one is refused when the class is built
        out[key if name in node else name] = target if key == "_target_" else _upgrade(value)
    return out


def _below(target: object) -> str:
    """Return a class's place below posefilter."""
    return str(target).removeprefix("posefilter.")


def rename_argument(target: object, name: str) -> str | None:
    """Return what an argument of a class, a `_target_`, is called today; None: as before."""
    return ARGUMENTS.get(_below(target), {}).get(name)


def rename_class(target: object) -> str | None:
    """Return what a class is called today; None where its name has not changed.

    Args:
        target: The class, as `_target_` named it.
    """
    new = CLASSES.get(_below(target))
    return new and f"posefilter.{new}"
