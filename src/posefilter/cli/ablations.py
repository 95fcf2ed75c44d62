"""The ablations between the paper's methods and the working ones, as one ordered table.

Each row is a name, what it changes, the row that it builds on, and overrides. Names begin with `s`
for one modification of the paper's method alone, `c` for one more modification each, `m` for the
working method without one of them; `pose_` and `box_` before it are for image-space methods with a
pose and for detectors, `pose_pf_` for the pose-space method.
"""

from typing import NamedTuple

SIZE = "preset/size"  # the group of a working preset's numbers


class Ablation(NamedTuple):
    """One step between two variants of a method."""

    name: str
    description: str
    parent: str  # another ablation, or the variant that it changes
    overrides: tuple[str, ...] = ()  # `group/choice=name` or `key.of.setting=value`


_BALANCED = "loss/aux/likelihood=balanced"
_TOWARDS = "loss/aux/displacement=towards"
_DETACHED = "model.detach_position=true"
_LAYER = "model.net.normalization=layer"
_SMALL_NOISE = ("filter/propagate=learned_and_gaussian", "filter/schedule=pixels")

IMAGE_SPACE_ABLATIONS = (
    Ablation("paper", "The paper's.", "variant=paper"),
    Ablation("working", "All modifications.", "variant=working"),
    Ablation("s1_glimpse", "Paper, with bilinear glimpses.", "paper", ("model/glimpse=smooth",)),
    Ablation(
        "s2_bounded", "Paper, with bounded displacement.", "paper", ("model/displacement=bounded",)
    ),
    Ablation(
        "s3_balanced", "Paper, with a class-balanced loss on the likelihood.", "paper", (_BALANCED,)
    ),
    Ablation(
        "s4_displacement_loss",
        "Paper, with a loss on the displacement itself.",
        "paper",
        (_TOWARDS,),
    ),
    Ablation("s5_position", "Paper, without gradient through the position.", "paper", (_DETACHED,)),
    Ablation(
        "s6_informed",
        "Paper, with half of the particles started on or around the object in training.",
        "paper",
        ("filter/initialize=informed",),
    ),
    Ablation(
        "s7_context", "Paper, with features of the whole image.", "paper", ("model/encoder=unet",)
    ),
    Ablation(
        "s8_resample",
        "Paper, with resampling by likelihood.",
        "paper",
        ("filter/resample=systematic",),
    ),
    Ablation(
        "s9_displacement_loss_and_position",
        "Paper, with a loss on the displacement itself, without gradient through the position.",
        "paper",
        (_TOWARDS, _DETACHED),
    ),
    Ablation(
        "box_s10_steps",
        "Paper, with ten steps instead of 30 (detectors).",
        "paper",
        ("filter.steps=10",),
    ),
    Ablation(
        "c1_normalization",
        "Paper, with normalization that does not mix particles.",
        "paper",
        (_LAYER,),
    ),
    Ablation(
        "c2_glimpse", "Also bilinear glimpses.", "c1_normalization", ("model/glimpse=smooth",)
    ),
    Ablation(
        "c3_bounded", "Also bounded displacement.", "c2_glimpse", ("model/displacement=bounded",)
    ),
    Ablation(
        "c4_balanced", "Also a class-balanced loss on the likelihood.", "c3_bounded", (_BALANCED,)
    ),
    Ablation(
        "c5_displacement_loss",
        "Also a loss on the displacement itself.",
        "c4_balanced",
        (_TOWARDS,),
    ),
    Ablation(
        "c6_position",
        "Also no gradient through the position.",
        "c5_displacement_loss",
        (_DETACHED,),
    ),
    Ablation(
        "c7_informed",
        "Also half of the particles started on or around the object in training.",
        "c6_position",
        ("filter/initialize=informed",),
    ),
    Ablation(
        "c8_short",
        "Also training roll-outs of two steps.",
        "c7_informed",
        ("model/train_rollout=short",),
    ),
    Ablation(
        "c9_context", "Also features of the whole image.", "c8_short", ("model/encoder=unet",)
    ),
    Ablation(
        "c10_resample",
        "Also resampling by likelihood (in tests; the short roll-out of training has none).",
        "c9_context",
        ("filter/resample=systematic",),
    ),
    Ablation(
        "pose_c11_surface_point",
        "Also a pose head on the particle's own object point, with a loss of its own.",
        "c10_resample",
        ("model/pose_head=surface_point", "loss/aux/pose=surface_point"),
    ),
    Ablation(
        "pose_c12_loss",
        "Also a loss on the pose that is weighted by its confidence.",
        "pose_c11_surface_point",
        ("loss=confidence",),
    ),
    Ablation(
        "pose_c13_agreement",
        "Also the pose on which most particles agree as the estimate.",
        "pose_c12_loss",
        ("filter/estimate=agreement",),
    ),
    Ablation(
        "pose_c14_fragments",
        "Also the own object point as a fragment and an offset in it.",
        "pose_c13_agreement",
        ("model/pose_head=fragments",),
    ),
    Ablation(
        "pose_c15_noise",
        "Also a little noise beside the learned displacement.",
        "pose_c14_fragments",
        _SMALL_NOISE,
    ),
    Ablation(
        "pose_c16_gated",
        "Also displacement gated by the likelihood.",
        "pose_c15_noise",
        ("model/displacement=gated",),
    ),
    Ablation("pose_c17_muon", "Also Muon.", "pose_c16_gated", ("optimizer=muon",)),
    Ablation(
        "box_c11_votes",
        "Also votes for the box (detectors).",
        "c10_resample",
        ("model/box_head=votes",),
    ),
    Ablation(
        "box_c12_gated",
        "Also displacement gated by the likelihood.",
        "box_c11_votes",
        ("model/displacement=gated",),
    ),
    Ablation("box_c13_muon", "Also Muon.", "box_c12_gated", ("optimizer=muon",)),
    Ablation(
        "box_c14_size",
        "Also the working method's size: ten steps in tests, a narrower network with two layers "
        "more.",
        "box_c13_muon",
        (f"{SIZE}=${{model}}",),
    ),
    Ablation(
        "m1_normalization",
        "Working, with the paper's normalization.",
        "working",
        ("model.net.normalization=batch",),
    ),
    Ablation(
        "m2_glimpse", "Working, with whole-pixel glimpses.", "working", ("model/glimpse=integer",)
    ),
    Ablation(
        "m3_bounded",
        "Working, with displacement that is neither bounded nor gated.",
        "working",
        ("model/displacement=unbounded",),
    ),
    Ablation(
        "m4_balanced",
        "Working, without the loss on the likelihood.",
        "working",
        ("loss/aux/likelihood=none",),
    ),
    Ablation(
        "m5_displacement_loss",
        "Working, without the loss on the displacement itself.",
        "working",
        ("loss/aux/displacement=none",),
    ),
    Ablation(
        "m6_position",
        "Working, with gradient through the position.",
        "working",
        ("model.detach_position=false",),
    ),
    Ablation(
        "m7_informed",
        "Working, with training particles that start anywhere.",
        "working",
        ("model.train_filter.initialize.object_fraction=0.0",),
    ),
    Ablation(
        "m8_short",
        "Working, with full training roll-outs of particles half of which start on or around the "
        "object.",
        "working",
        ("model/train_rollout=full", "filter/initialize=informed"),
    ),
    Ablation(
        "m9_context",
        "Working, without features of the whole image.",
        "working",
        ("model/encoder=none",),
    ),
    Ablation(
        "m10_resample",
        "Working, without resampling (in tests; the short roll-out of training has none).",
        "working",
        ("filter/resample=none",),
    ),
    Ablation("m11_muon", "Working, with AdamW instead of Muon.", "working", ("optimizer=adamw",)),
    Ablation(
        "m12_gated",
        "Working, with bounded displacement that is not gated.",
        "working",
        ("model/displacement=bounded",),
    ),
    Ablation(
        "m13_scheduler", "Working, with a constant learning rate.", "working", ("scheduler=none",)
    ),
    Ablation(
        "pose_m14_surface_point",
        "Working, with a pose head without a surface point (so that no agreement is possible).",
        "working",
        ("model/pose_head=absolute", "loss/aux/pose=none", "filter/estimate=argmax"),
    ),
    Ablation("pose_m15_loss", "Working, with the paper's ADD loss.", "working", ("loss=add",)),
    Ablation(
        "pose_m16_agreement",
        "Working, with the likeliest particle's pose as the estimate.",
        "working",
        ("filter/estimate=argmax",),
    ),
    Ablation(
        "pose_m17_fragments",
        "Working, with the own point predicted directly.",
        "working",
        ("model/pose_head=surface_point",),
    ),
    Ablation(
        "pose_m18_noise",
        "Working, without noise beside the learned displacement.",
        "working",
        ("filter/propagate=learned", "filter/schedule=constant"),
    ),
    Ablation(
        "box_m14_votes",
        "Working, without votes for the box (detectors).",
        "working",
        ("model/box_head=quantiles",),
    ),
)

_CANDIDATES = ("model/candidate_sampler=candidates", "loss=contrastive")
_NO_NEGATIVES = "model.candidate_sampler.particles=0"
_DENSE = ("model/proposals=dense", "filter/initialize=from_proposals")
_TURNS = "filter/propagate=gaussian_and_turns"

# Of the pose-space method. A viewing ray needs candidates (labels of single points train the
# paper's network only), context needs the dense network, and the filter's own particles need
# candidates: these have no row alone, and c1 is the row of candidates alone.
POSE_SPACE_ABLATIONS = (
    Ablation(
        "pose_pf_s4_schedule",
        "Paper, with a noise level that falls.",
        "paper",
        ("filter/schedule=geometric",),
    ),
    Ablation("pose_pf_s5_muon", "Paper, with Muon.", "paper", ("optimizer=muon",)),
    Ablation(
        "pose_pf_s6_scheduler",
        "Paper, with a learning rate that falls.",
        "paper",
        ("scheduler=warmup_cosine",),
    ),
    Ablation(
        "pose_pf_s7_proposals", "Paper, with poses voted by a dense network first.", "paper", _DENSE
    ),
    Ablation(
        "pose_pf_s10_turns",
        "Paper, with particles that also turn about the object's axes (and noise of 0.4 noise "
        "levels in place of 0.5).",
        "paper",
        (_TURNS,),
    ),
    Ablation(
        "pose_pf_s12_refine",
        "Paper, with a refined estimate.",
        "paper",
        ("filter/refine=mean_shift_icp",),
    ),
    Ablation(
        "pose_pf_c1_contrast",
        "Paper, trained on candidate poses of one image, among which the truth must score highest, "
        "in place of labels.",
        "paper",
        (*_CANDIDATES, _NO_NEGATIVES),
    ),
    Ablation(
        "pose_pf_c2_network",
        "Also a likelihood that is given the viewing ray and the noise level.",
        "pose_pf_c1_contrast",
        ("model/likelihood=contrastive",),
    ),
    Ablation(
        "pose_pf_c3_negatives",
        "Also wrong poses of the filter's own.",
        "pose_pf_c2_network",
        ("model.candidate_sampler.particles=16",),
    ),
    Ablation(
        "pose_pf_c4_schedule",
        "Also a noise level that falls.",
        "pose_pf_c3_negatives",
        ("filter/schedule=geometric",),
    ),
    Ablation("pose_pf_c5_muon", "Also Muon.", "pose_pf_c4_schedule", ("optimizer=muon",)),
    Ablation(
        "pose_pf_c6_scheduler",
        "Also a learning rate that falls.",
        "pose_pf_c5_muon",
        ("scheduler=warmup_cosine",),
    ),
    Ablation(
        "pose_pf_c7_proposals",
        "Also poses voted by a dense network, first and among the candidates.",
        "pose_pf_c6_scheduler",
        _DENSE,
    ),
    Ablation(
        "pose_pf_c8_context",
        "Also the dense network's features at each image point.",
        "pose_pf_c7_proposals",
        ("model/likelihood=contextual",),
    ),
    Ablation(
        "pose_pf_c9_surface",
        "Also the term of the pose's own surface.",
        "pose_pf_c8_context",
        ("model/likelihood=surface",),
    ),
    Ablation(
        "pose_pf_c10_turns",
        "Also particles that turn about the object's axes (and noise of 0.4 noise levels in place "
        "of 0.5).",
        "pose_pf_c9_surface",
        (_TURNS,),
    ),
    Ablation(
        "pose_pf_c11_quasi_monte_carlo",
        "Also image points of a low-discrepancy sequence. With the refinement it is `working`.",
        "pose_pf_c10_turns",
        ("model.quasi_monte_carlo=true",),
    ),
    Ablation(
        "pose_pf_m1_contrast",
        "Working, with the paper's likelihood trained on labeled points (so that there is no ray, "
        "context or surface).",
        "working",
        ("model/likelihood=paper", "model/candidate_sampler=labeled_rays", "loss=regression"),
    ),
    Ablation(
        "pose_pf_m2_network",
        "Working, with the paper's likelihood trained on candidates.",
        "working",
        ("model/likelihood=paper",),
    ),
    Ablation(
        "pose_pf_m2_ray",
        "Working, without the viewing ray.",
        "working",
        ("model.likelihood.ray=false",),
    ),
    Ablation(
        "pose_pf_m3_negatives",
        "Working, without wrong poses of the filter's own in training.",
        "working",
        (_NO_NEGATIVES,),
    ),
    Ablation(
        "pose_pf_m4_schedule",
        "Working, with one noise level.",
        "working",
        ("filter/schedule=constant",),
    ),
    Ablation("pose_pf_m5_muon", "Working, with Adam.", "working", ("optimizer=adam",)),
    Ablation(
        "pose_pf_m6_scheduler",
        "Working, with a constant learning rate.",
        "working",
        ("scheduler=none",),
    ),
    Ablation(
        "pose_pf_m7_start",
        "Working, with first poses anywhere on the measured surfaces; the dense network remains.",
        "working",
        ("filter/initialize=from_depth",),
    ),
    Ablation(
        "pose_pf_m7_proposals",
        "Working, without the dense network (so that there is no context).",
        "working",
        (
            "model/proposals=none",
            "filter/initialize=from_depth",
            "model.likelihood.context=null",
        ),
    ),
    Ablation(
        "pose_pf_m8_context",
        "Working, without the dense network's features at the image points.",
        "working",
        ("model.likelihood.context=null", "model.proposals.features=0"),
    ),
    Ablation(
        "pose_pf_m9_surface",
        "Working, without the term of the pose's own surface.",
        "working",
        ("model/likelihood=contextual",),
    ),
    Ablation(
        "pose_pf_m10_turns",
        "Working, with particles that do not turn about the object's axes.",
        "working",
        ("filter/propagate=gaussian",),
    ),
    Ablation(
        "pose_pf_m11_quasi_monte_carlo",
        "Working, with independent image points.",
        "working",
        ("model.quasi_monte_carlo=false",),
    ),
    Ablation(
        "pose_pf_m12_refine", "Working, without refinement.", "working", ("filter/refine=none",)
    ),
    Ablation(
        "pose_pf_m13_icp",
        "Working, without the alignment with the measured depth.",
        "working",
        ("filter/refine=mean_shift",),
    ),
)
ABLATIONS = (*IMAGE_SPACE_ABLATIONS, *POSE_SPACE_ABLATIONS)

# Left out of the detectors' sweep: s5_position equals paper (a whole-pixel glimpse has no gradient
# through its position), so s9 equals s4; s3, s6 and s8 say nothing about a detector; from
# c3_bounded to c5_displacement_loss the gradient of 30 steps overflows.
_NOT_OF_DETECTORS = (
    "s3_balanced", "s5_position", "s6_informed", "s8_resample", "s9_displacement_loss_and_position",
    "c3_bounded", "c4_balanced", "c5_displacement_loss",
)  # fmt: skip
_BY_NAME = {ablation.name: ablation for ablation in ABLATIONS}


def find_parent(ablation: Ablation) -> Ablation:
    """Return the row that a row builds on.

    Raises:
        KeyError: It changes a variant, not a row.
    """
    return _BY_NAME[ablation.parent]


def list_pose_ablations() -> list[str]:
    """Return the names of the rows for image-space methods with a pose, in order of the table's
    sweep.
    """
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
    return [
        *(n for n in names[:first] if n != "working"),
        "working",
        *names[first:],
    ]
