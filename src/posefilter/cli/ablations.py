"""The ablations between the paper's methods and the working ones, as one ordered table.

Each row is a name, what it changes, and overrides; its series says what it builds on. Names begin
with `s` for one modification of the paper's method alone, `c` for one more modification each, `m`
for the working method without one of them; `pose_` and `box_` before it are for image-space methods
with a pose and for detectors, `pose_pf_` for the pose-space method.
"""

from functools import cache
from typing import Any, NamedTuple

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from posefilter.cli.plain import to_plain

SIZE = "preset/size"  # the group of a working preset's numbers


class Ablation(NamedTuple):
    """One step between two variants of a method."""

    name: str
    description: str
    parent: str  # another ablation, or the variant that it changes
    overrides: tuple[str, ...] = ()  # `group/choice=name` or `key.of.setting=value`


def _build_on(parent: str, *rows: tuple[str, ...]) -> tuple[Ablation, ...]:
    """Return a series of which each row builds on `parent`; rows are (name, text, *overrides)."""
    return tuple(Ablation(name, text, parent, tuple(more)) for name, text, *more in rows)


def _chain_from(parent: str, *rows: tuple[str, ...]) -> tuple[Ablation, ...]:
    """Return a series of which each row builds on the row before it, the first on `parent`."""
    parents = (parent, *(name for name, *_ in rows[:-1]))
    return tuple(Ablation(row[0], row[1], p, row[2:]) for p, row in zip(parents, rows, strict=True))


_BALANCED = "loss/aux/likelihood=balanced_bce"
_TOWARDS = "loss/aux/displacement=towards_object"
_DETACHED = "model.detach_position=true"
_LAYER = "model.net.normalization=layer"
_SMALL_NOISE = ("filter/propagate=learned_and_gaussian", "filter/schedule=pixels")

IMAGE_SPACE_ABLATIONS = (
    Ablation("paper", "The paper's.", "variant=paper"),
    Ablation("working", "All modifications.", "variant=working"),
    *_build_on(
        "paper",
        ("s1_glimpse", "Paper, with bilinear glimpses.", "model/glimpse=bilinear"),
        ("s2_bounded", "Paper, with bounded displacement.", "model/displacement=bounded"),
        ("s3_balanced", "Paper, with a class-balanced loss on the likelihood.", _BALANCED),
        ("s4_displacement_loss", "Paper, with a loss on the displacement itself.", _TOWARDS),
        ("s5_position", "Paper, without gradient through the position.", _DETACHED),
        ("s6_informed",
         "Paper, with half of the particles started on or around the object in training.",
         "filter/initialize=informed"),
        ("s7_context", "Paper, with features of the whole image.", "model/encoder=unet"),
        ("s8_resample", "Paper, with resampling by likelihood.", "filter/resample=systematic"),
        ("s9_displacement_loss_and_position",
         "Paper, with a loss on the displacement itself, without gradient through the position.",
         _TOWARDS, _DETACHED),
        ("box_s10_steps", "Paper, with ten steps instead of 30 (detectors).", "filter.steps=10"),
    ),
    *_chain_from(
        "paper",
        ("c1_normalization", "Paper, with normalization that does not mix particles.", _LAYER),
        ("c2_glimpse", "Also bilinear glimpses.", "model/glimpse=bilinear"),
        ("c3_bounded", "Also bounded displacement.", "model/displacement=bounded"),
        ("c4_balanced", "Also a class-balanced loss on the likelihood.", _BALANCED),
        ("c5_displacement_loss", "Also a loss on the displacement itself.", _TOWARDS),
        ("c6_position", "Also no gradient through the position.", _DETACHED),
        ("c7_informed", "Also half of the particles started on or around the object in training.",
         "filter/initialize=informed"),
        ("c8_short", "Also training roll-outs of two steps.", "model/train_rollout=short"),
        ("c9_context", "Also features of the whole image.", "model/encoder=unet"),
        ("c10_resample",
         "Also resampling by likelihood (in tests; the short roll-out of training has none).",
         "filter/resample=systematic"),
    ),
    *_chain_from(
        "c10_resample",
        ("pose_c11_surface_point",
         "Also a pose head on the particle's own object point, with a loss of its own.",
         "model/pose_head=surface_point", "loss/aux/pose=surface_point"),
        ("pose_c12_loss", "Also a loss on the pose that is weighted by its confidence.",
         "loss=confidence"),
        ("pose_c13_agreement", "Also the pose on which most particles agree as the estimate.",
         "filter/estimate=agreement"),
        ("pose_c14_fragments", "Also the own object point as a fragment and an offset in it.",
         "model/pose_head=fragments"),
        ("pose_c15_noise", "Also a little noise beside the learned displacement.", *_SMALL_NOISE),
        ("pose_c16_gated", "Also displacement gated by the likelihood.",
         "model/displacement=gated"),
        ("pose_c17_muon", "Also Muon.", "optimizer=muon"),
    ),
    *_chain_from(
        "c10_resample",
        ("box_c11_votes", "Also votes for the box (detectors).", "model/box_head=votes"),
        ("box_c12_gated", "Also displacement gated by the likelihood.", "model/displacement=gated"),
        ("box_c13_muon", "Also Muon.", "optimizer=muon"),
        ("box_c14_size",
         "Also the working method's size: ten steps in tests, a narrower network with two layers "
         "more.", f"{SIZE}=${{model}}"),
    ),
    *_build_on(
        "working",
        ("m1_normalization", "Working, with the paper's normalization.",
         "model.net.normalization=batch"),
        ("m2_glimpse", "Working, with whole-pixel glimpses.", "model/glimpse=integer"),
        ("m3_bounded", "Working, with displacement that is neither bounded nor gated.",
         "model/displacement=unbounded"),
        ("m4_balanced", "Working, without the loss on the likelihood.", "loss/aux/likelihood=none"),
        ("m5_displacement_loss", "Working, without the loss on the displacement itself.",
         "loss/aux/displacement=none"),
        ("m6_position", "Working, with gradient through the position.",
         "model.detach_position=false"),
        ("m7_informed", "Working, with training particles that start anywhere.",
         "model.train_rollout.initialize.object_fraction=0.0"),
        ("m8_short",
         "Working, with full training roll-outs of particles half of which start on or around the "
         "object.", "model/train_rollout=full", "filter/initialize=informed"),
        ("m9_context", "Working, without features of the whole image.", "model/encoder=none"),
        ("m10_resample",
         "Working, without resampling (in tests; the short roll-out of training has none).",
         "filter/resample=none"),
        ("m11_muon", "Working, with AdamW instead of Muon.", "optimizer=adamw"),
        ("m12_gated", "Working, with bounded displacement that is not gated.",
         "model/displacement=bounded"),
        ("m13_scheduler", "Working, with a constant learning rate.", "scheduler=none"),
        ("pose_m14_surface_point",
         "Working, with a pose head without a surface point (so that no agreement is possible).",
         "model/pose_head=absolute", "loss/aux/pose=none", "filter/estimate=argmax"),
        ("pose_m15_loss", "Working, with the paper's ADD loss.", "loss=add"),
        ("pose_m16_agreement", "Working, with the likeliest particle's pose as the estimate.",
         "filter/estimate=argmax"),
        ("pose_m17_fragments", "Working, with the own point predicted directly.",
         "model/pose_head=surface_point"),
        ("pose_m18_noise", "Working, without noise beside the learned displacement.",
         "filter/propagate=learned", "filter/schedule=constant"),
        ("box_m14_votes", "Working, without votes for the box (detectors).",
         "model/box_head=quantiles"),
    ),
)  # fmt: skip

_CANDIDATES = ("model/candidate_sampler=poses", "loss=contrastive")
_NO_NEGATIVES = "model.candidate_sampler.particles=0"
_DENSE = ("model/proposals=dense", "filter/initialize=from_proposals")
_TURNS = "filter/propagate=gaussian_and_axis_rotations"

# Of the pose-space method. A viewing ray needs candidates (labels of single points train the
# paper's network only), context needs the dense network, and the filter's own particles need
# candidates: these have no row alone, and c1 is the row of candidates alone.
POSE_SPACE_ABLATIONS = (
    *_build_on(
        "paper",
        ("pose_pf_s4_schedule", "Paper, with a noise level that falls.",
         "filter/schedule=geometric"),
        ("pose_pf_s5_muon", "Paper, with Muon.", "optimizer=muon"),
        ("pose_pf_s6_scheduler", "Paper, with a learning rate that falls.",
         "scheduler=warmup_cosine"),
        ("pose_pf_s7_proposals", "Paper, with poses voted by a dense network first.", *_DENSE),
        ("pose_pf_s10_turns",
         "Paper, with particles that also turn about the object's axes (and noise of 0.4 noise "
         "levels in place of 0.5).", _TURNS),
        ("pose_pf_s12_refine", "Paper, with a refined estimate.", "filter/refine=mean_shift_icp"),
    ),
    *_chain_from(
        "paper",
        ("pose_pf_c1_contrast",
         "Paper, trained on candidate poses of one image, among which the truth must score "
         "highest, in place of labels.", *_CANDIDATES, _NO_NEGATIVES),
        ("pose_pf_c2_network",
         "Also a likelihood that is given the viewing ray and the noise level.",
         "model/likelihood=pointwise"),
        ("pose_pf_c3_negatives", "Also wrong poses of the filter's own.",
         "model.candidate_sampler.particles=16"),
        ("pose_pf_c4_schedule", "Also a noise level that falls.", "filter/schedule=geometric"),
        ("pose_pf_c5_muon", "Also Muon.", "optimizer=muon"),
        ("pose_pf_c6_scheduler", "Also a learning rate that falls.", "scheduler=warmup_cosine"),
        ("pose_pf_c7_proposals",
         "Also poses voted by a dense network, first and among the candidates.", *_DENSE),
        ("pose_pf_c8_context", "Also the dense network's features at each image point.",
         "model/likelihood=contextual"),
        ("pose_pf_c9_surface", "Also the term of the pose's own surface.",
         "model/likelihood=surface"),
        ("pose_pf_c10_turns",
         "Also particles that turn about the object's axes (and noise of 0.4 noise levels in "
         "place of 0.5).", _TURNS),
        ("pose_pf_c11_quasi_monte_carlo",
         "Also image points of a low-discrepancy sequence. With the refinement it is `working`.",
         "model.quasi_monte_carlo=true"),
    ),
    *_build_on(
        "working",
        ("pose_pf_m1_contrast",
         "Working, with the paper's likelihood trained on labeled points (so that there is no "
         "ray, context or surface).",
         "model/likelihood=paper", "model/candidate_sampler=labeled_rays", "loss=regression"),
        ("pose_pf_m2_network", "Working, with the paper's likelihood trained on candidates.",
         "model/likelihood=paper"),
        ("pose_pf_m2_ray", "Working, without the viewing ray.", "model.likelihood.ray=false"),
        ("pose_pf_m3_negatives", "Working, without wrong poses of the filter's own in training.",
         _NO_NEGATIVES),
        ("pose_pf_m4_schedule", "Working, with one noise level.", "filter/schedule=constant"),
        ("pose_pf_m5_muon", "Working, with Adam.", "optimizer=adam"),
        ("pose_pf_m6_scheduler", "Working, with a constant learning rate.", "scheduler=none"),
        ("pose_pf_m7_start",
         "Working, with first poses anywhere on the measured surfaces; the dense network remains.",
         "filter/initialize=from_depth"),
        ("pose_pf_m7_proposals",
         "Working, without the dense network (so that there is no context).",
         "model/proposals=none", "filter/initialize=from_depth", "model.likelihood.context=null"),
        ("pose_pf_m8_context",
         "Working, without the dense network's output at the image points, which the surface term "
         "reads too.", "model.likelihood.context=null", "model.proposals.features=0"),
        ("pose_pf_m9_surface", "Working, without the term of the pose's own surface.",
         "model/likelihood=contextual"),
        ("pose_pf_m10_turns", "Working, with particles that do not turn about the object's axes.",
         "filter/propagate=gaussian"),
        ("pose_pf_m11_quasi_monte_carlo", "Working, with independent image points.",
         "model.quasi_monte_carlo=false"),
        ("pose_pf_m12_refine", "Working, without refinement.", "filter/refine=none"),
        ("pose_pf_m13_icp",
         "Working, without the alignment with the measured depth (and the turns by the texture).",
         "filter/refine=mean_shift"),
    ),
)  # fmt: skip
ABLATIONS = (*IMAGE_SPACE_ABLATIONS, *POSE_SPACE_ABLATIONS)

# Left out of the detectors' sweep: s5_position equals paper (a whole-pixel glimpse has no gradient
# through its position), so s9 equals s4; s8 resamples by a likelihood that no loss trains; s3 and
# s6 were not run; from c3_bounded to c5_displacement_loss the gradient of 30 steps overflows.
_NOT_OF_DETECTORS = (
    "s3_balanced", "s5_position", "s6_informed", "s8_resample", "s9_displacement_loss_and_position",
    "c3_bounded", "c4_balanced", "c5_displacement_loss",
)  # fmt: skip
BY_NAME = {ablation.name: ablation for ablation in ABLATIONS}
WITH_POSE, DETECTORS = ("patch_pf", "pixel_pf"), ("cnn_patch", "downsized")  # image-space methods
_POSE_SPACE = "pose_pf"


def list_models(name: str = "paper") -> list[str]:
    """Return the methods that a row is of, as one types them."""
    if name.startswith(f"{_POSE_SPACE}_"):
        return [_POSE_SPACE]
    pose_space = [] if name not in ("paper", "working") else [_POSE_SPACE]
    with_pose = [] if name.startswith("box_") else [*WITH_POSE]
    detectors = [] if name.startswith("pose_") else [*DETECTORS]
    return [*with_pose, *detectors, *pose_space]


def list_steps(ablation: Ablation) -> list[Ablation]:
    """Return the rows that lead from a variant to a row, which is the last."""
    steps = [ablation]
    while not steps[0].parent.startswith("variant="):
        steps.insert(0, BY_NAME[steps[0].parent])
    return steps


def find_variant(ablation: Ablation) -> str:
    """Return the variant that the first of a row's steps changes."""
    return list_steps(ablation)[0].parent.partition("=")[2]


def list_pose_ablations() -> list[str]:
    """Return the rows for image-space methods with a pose, in order of the table's sweep."""
    return _in_order([a.name for a in IMAGE_SPACE_ABLATIONS if not a.name.startswith("box_")])


def list_detector_ablations() -> list[str]:
    """Return the names of the rows for detectors, in order of the table's sweep."""
    own = [a.name for a in IMAGE_SPACE_ABLATIONS if not a.name.startswith("pose_")]
    return _in_order([name for name in own if name not in _NOT_OF_DETECTORS])


def list_pose_space_ablations() -> list[str]:
    """Return the names of the rows for the pose-space method, what tells most first."""
    own = [a.name for a in POSE_SPACE_ABLATIONS]
    series = [[name for name in own if name.startswith(f"pose_pf_{kind}")] for kind in "mcs"]
    return ["working", "paper", *(name for names in series for name in names)]


def _in_order(names: list[str]) -> list[str]:
    """Move `working` between what is added to the paper and what is taken from working."""
    first = next(i for i, name in enumerate(names) if name.startswith("m"))
    return [*(n for n in names[:first] if n != "working"), "working", *names[first:]]


def _make_node(groups: dict[str, str], **settings: Any) -> dict[str, Any]:
    """Return choices and settings as Hydra composes them."""
    defaults = [{f"override /{group}": choice} for group, choice in groups.items()]
    return {"defaults": defaults, **settings}


def _make_row(ablation: Ablation) -> dict[str, Any]:
    """Return a row with the overrides of all its parents: a later one of the same group or key
    replaces an earlier one.
    """
    lists = (step.overrides for step in list_steps(ablation))
    overrides = dict(override.split("=", 1) for own in lists for override in own)
    groups = {"variant": find_variant(ablation)}
    groups |= {k: v for k, v in overrides.items() if "." not in k}
    settings = OmegaConf.from_dotlist([f"{k}={v}" for k, v in overrides.items() if "." in k])
    return _make_node(groups, **to_plain(settings))


def _sweep(names: list[str], groups: dict[str, str], **settings: Any) -> dict[str, Any]:
    hydra = {"mode": "MULTIRUN", "sweeper": {"params": {"ablation": ",".join(names)}}}
    return _make_node(groups, **settings, hydra=hydra)


@cache
def register_ablations() -> None:
    """Register the table with Hydra: rows are chosen like files of `conf/ablation/`,
    `ablation=NAME`, or all for a kind of method in one sweep, by `sweep=ablation`,
    `sweep=ablation_detect` and `sweep=ablation_pose_pf`.

    All runs of `sweep=ablation` have the size of the working preset, so that a row differs from the
    next in its modification alone. All runs of `sweep=ablation_detect` have 32 particles, for time;
    those that start from the paper keep its 30 steps, since shorter roll-outs are a modification.
    All runs of `sweep=ablation_pose_pf`, for pose_pf, are of `experiment=small_scenes`.
    """
    store = ConfigStore.instance()
    for ablation in ABLATIONS:
        node = _make_row(ablation)
        store.store(group="ablation", name=ablation.name, node=node, package="_global_")
    sweeps = {
        "ablation": _sweep(list_pose_ablations(), {SIZE: "${model}"}),
        "ablation_detect": _sweep(list_detector_ablations(), {}, filter={"particles": 32}),
        "ablation_pose_pf": _sweep(list_pose_space_ablations(), {"experiment": "small_scenes"}),
    }
    for name, node in sweeps.items():
        store.store(group="sweep", name=name, node=node, package="_global_")
