"""Choices that do not fit together are refused in one line that names the key and the cure; their
neighbors are not.
"""

from functools import partial
from pathlib import Path

import pytest
import torch
from tests.models.toy import scenes, square

from posefilter.capabilities import check_parts
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.filters.auxiliary import AuxiliaryResampling
from posefilter.filters.estimate import Argmax
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.importance import ImportanceSampling
from posefilter.filters.initialize import (
    FromDepth,
    FromObjectness,
    FromProposals,
    Informed,
    UniformPixels,
)
from posefilter.filters.propagate import AxisRotations, HalfTurnRotations
from posefilter.filters.refine import Gradient, MeanShift, Rescore
from posefilter.filters.resample import Systematic
from posefilter.filters.resample_move import ResampleMove
from posefilter.filters.texture import TextureRotations
from posefilter.labels.paper_points import PaperPoints
from posefilter.losses.contrastive import Contrastive
from posefilter.losses.regression import Regression
from posefilter.models.base import PoseEstimator
from posefilter.models.image_space import ImageSpace, check_particle_counts
from posefilter.nets.mlp import PatchNet

CONF = Path(__file__).parents[2] / "conf"


def build(folder: Path, *overrides: str) -> PoseEstimator:
    return build_method(recipe(compose_job("train", CONF, list(overrides), folder)), square())


def images(folder: Path, *overrides: str) -> ImageSpace:
    method = build(folder, *overrides)
    assert isinstance(method, ImageSpace)
    return method


def one_line(refusal: pytest.ExceptionInfo[UserError], *words: str) -> None:
    said = str(refusal.value)
    assert "\n" not in said
    for word in words:
        assert word in said


@pytest.mark.parametrize(
    "choice", ["model=pose_pf", "model=pose_pf variant=paper", "model=cnn_patch", "model=downsized"]
)
def test_agreement_is_refused_where_no_particle_knows_its_surface_point_of_the_object(
    choice: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as refusal:
        build(tmp_path, *choice.split(), "filter/estimate=agreement")
    one_line(refusal, "filter/estimate=agreement", "filter/estimate=argmax")
    build(tmp_path, *choice.split())


class Pixels:
    """A method whose particles are pixels, and a part of it."""

    provides: tuple[str, ...] = ("pixel_space", "pose")

    def __init__(self, part: object) -> None:
        self.part = part


class Poses(Pixels):
    """The same, whose particles are poses."""

    provides: tuple[str, ...] = ("pose_space", "pose")


class CommonPoses(Poses):
    """The same, with a likelihood that reads the same points for all."""

    provides = ("common_points", "pose_space", "pose")


@pytest.mark.parametrize(
    ("method", "part", "need"),
    [
        (Poses, UniformPixels(), "pixel_space"),
        (Poses, Informed(FromDepth()), "pixel_space"),
        (Pixels, FromDepth(), "pose_space"),
        (Pixels, FromObjectness(), "objectness"),
        (Poses, FromProposals(), "propose_poses"),
        (Pixels, AuxiliaryResampling(Systematic()), "objectness"),
        (Pixels, HalfTurnRotations(), "pose_space"),
        (Pixels, AxisRotations(), "pose_space"),
        (Pixels, Agreement(), "surface_points"),
        (Poses, Rescore(), "score_poses"),
        (Poses, MeanShift(), "score_poses"),
        (Poses, Gradient(), "score_poses"),
        (Poses, ImportanceSampling(), "common_points"),
        (Poses, ResampleMove(), "common_points"),
        (CommonPoses, ImportanceSampling(), "score_poses"),
        (CommonPoses, ResampleMove(), "score_poses"),
        (Poses, PointToPlaneIcp(), "depth"),
        (Poses, TextureRotations(), "color"),
        (Poses, Contrastive(), "candidates"),
        (Poses, Regression(PaperPoints()), "ray_samples"),
    ],
)
def test_a_part_is_refused_by_a_method_that_has_not_what_it_needs(
    method: type[Pixels], part: object, need: str
) -> None:
    with pytest.raises(UserError, match=rf"needs .* \({need}\), which none of its parts provides"):
        check_parts(method(part))


@pytest.mark.parametrize("model", ["patch_pf", "pixel_pf"])
@pytest.mark.parametrize("train_rollout", ["full", "short"])
def test_agreement_serves_both_pose_methods_before_they_know_their_object(
    model: str, train_rollout: str, tmp_path: Path
) -> None:
    job = compose_job(
        "train",
        CONF,
        [f"model={model}", "filter/estimate=agreement", f"model/train_rollout={train_rollout}"],
        tmp_path,
    )
    method = build_method(recipe(job))
    assert isinstance(method.filter.estimate, Agreement)


def test_a_part_that_is_put_in_later_is_refused_when_the_object_is_set(tmp_path: Path) -> None:
    method = build(
        tmp_path,
        "filter/initialize=from_depth",
        "model/proposals=none",
        "model/likelihood=pointwise",
    )
    assert isinstance(method.filter.estimate, Argmax)
    method.filter.estimate = Agreement()
    with pytest.raises(UserError) as refusal:
        method.set_object(method.object_model)
    one_line(refusal, "PosePF", "Agreement", "surface_points")


@pytest.mark.parametrize("variant", ["paper", "working"])
@pytest.mark.parametrize("model", ["patch_pf", "pixel_pf"])
@pytest.mark.slow
def test_votes_are_refused_where_the_network_reads_the_latent(
    model: str, variant: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as refusal:
        images(tmp_path, f"model={model}", f"variant={variant}", "model/box_head=votes")
    one_line(refusal, "model/box_head=votes", "model/box_head=pose or quantiles")
    for box_head in ("pose", "quantiles"):
        images(tmp_path, f"model={model}", f"variant={variant}", f"model/box_head={box_head}")


def test_votes_need_four_numbers_to_remember(tmp_path: Path) -> None:
    for legal in ("model/box_head=votes", "model/box_head=quantiles"):
        images(tmp_path, "model=cnn_patch", legal)
    images(tmp_path, "model=cnn_patch", "model/box_head=quantiles", "model.net.latent_width=0")
    for width in (0, 3):
        with pytest.raises(UserError) as refusal:
            images(
                tmp_path,
                "model=cnn_patch",
                "model/box_head=votes",
                f"model.net.latent_width={width}",
            )
        one_line(refusal, f"model.net.latent_width={width}", "model/box_head=votes needs 4")


WIDE = ["filter.particles=8", "filter.initial_particles=20", "filter.steps=2"]
LEGAL = [
    "model/train_rollout=short filter.initial_particles=20 filter.steps=2",
    "model/train_rollout=full filter.initial_particles=null filter.steps=2",
    "model/train_rollout=full filter.initial_particles=8 filter.steps=2",
    # one cloud is of one size, whatever it is
    "model/train_rollout=full filter.initial_particles=20 filter.steps=1",
]


@pytest.mark.parametrize("model", ["patch_pf", "cnn_patch"])
@pytest.mark.slow
def test_all_steps_of_a_training_rollout_have_as_many_particles(model: str, tmp_path: Path) -> None:
    batch = scenes(2)
    method = images(tmp_path, f"model={model}", "model/train_rollout=full", *WIDE)
    with pytest.raises(UserError) as refusal:
        method.training_losses(batch, method.generator("train", 0))
    one_line(
        refusal,
        "filter.initial_particles=20",
        "filter.initial_particles=null",
        "model/train_rollout=short",
    )
    with torch.no_grad():  # a wide search is fine where nothing is taught
        trace = method.eval().predict_step(batch, 0)
    assert [particles.state.shape[1] for particles in trace.particles] == [20, 8]
    for legal in LEGAL:
        method = images(tmp_path, f"model={model}", "filter.particles=8", *legal.split()).train()
        losses = method.training_losses(batch, method.generator("train", 0))
        assert all(loss.isfinite().all() for loss in losses.values())


def test_initial_particles_of_a_training_filter_are_named_by_their_key(tmp_path: Path) -> None:
    wide = [
        "model.train_rollout.initial_particles=200",
        "model.train_rollout.resample._target_=posefilter.filters.resample.Systematic",
    ]
    method = images(tmp_path, "model=patch_pf", *wide)
    assert isinstance(method.train_rollout.resample, Systematic)
    with pytest.raises(UserError) as refusal:
        check_particle_counts(method.train_rollout, "model.train_rollout")
    one_line(
        refusal,
        "model.train_rollout.initial_particles=200",
        "model.train_rollout.initial_particles=null",
    )


NUMBERS = {
    "model=patch_pf model.glimpse.size=-1": ["model.glimpse.size=-1", "at least 1,"],
    "model=cnn_patch model.glimpse.size=0": ["model.glimpse.size=0", "at least 1,"],
    "model=pixel_pf model/glimpse=integer model.glimpse.size=0": [
        "model.glimpse.size=0",
        "at least 1,",
    ],
    "model=patch_pf model.glimpse.spacing=0": ["model.glimpse.spacing=0", "above 0"],
    "model=patch_pf filter.estimate.top_fragments=0": [
        "estimate",
        "top_fragments=0",
        "at least 1,",
    ],
    "model=patch_pf filter.estimate.hypotheses=0": ["estimate", "hypotheses=0", "at least 1,"],
    "model=patch_pf filter.estimate.scale_m=0": ["estimate", "scale_m=0", "above 0"],
    "model.candidate_sampler.sigma_levels=1": [
        "model.candidate_sampler",
        "sigma_levels=1",
        "at least 2,",
    ],
    "model.candidate_sampler.particles=-1": [
        "model.candidate_sampler",
        "particles=-1",
        "at least 0,",
    ],
    "model=patch_pf model.net.latent_width=0": ["net", "latent_width=0", "1 or more"],
    "model=patch_pf model.net.layers=0": ["net", "layers=0", "at least 1,"],
    "model=cnn_patch model.net.width=0": ["net", "width=0", "at least 1,"],
    "model=cnn_patch model.net.hidden=-1": ["net", "hidden=-1", "at least 0,"],
}


@pytest.mark.parametrize("typed", NUMBERS)
def test_numbers_that_mean_nothing_are_refused_by_the_key_that_was_typed(
    typed: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as refusal:
        build(tmp_path, *typed.split())
    one_line(refusal, *NUMBERS[typed])


@pytest.mark.parametrize(
    "typed",
    [
        "model=pixel_pf model.glimpse.size=1",
        "model=patch_pf model.glimpse.size=6",
        "model=cnn_patch model.glimpse.size=1",
        "model=patch_pf filter.estimate.top_fragments=1",
        "model=patch_pf filter.estimate.hypotheses=1",
        "model=patch_pf filter.estimate.top_fragments=100",
        "model=patch_pf filter.estimate.iterations=0",
        "model=patch_pf model.net.layers=1",
        "model=cnn_patch model.net.hidden=0",
        "model=patch_pf model.glimpse.spacing=2",
    ],
)
def test_the_least_that_is_legal_takes_a_step(typed: str, tmp_path: Path) -> None:
    batch = scenes(2)
    method = images(
        tmp_path,
        *typed.split(),
        "model/encoder=none",
        "model/train_rollout=full",
        "filter.particles=8",
        "filter.steps=2",
    )
    losses = method.train().training_losses(batch, method.generator("train", 0))
    assert all(loss.isfinite().all() for loss in losses.values())
    with torch.no_grad():
        assert method.eval().predict_step(batch, 0).belief.best.isfinite().all()


@pytest.mark.parametrize(
    "typed",
    [
        "model.candidate_sampler.sigma_levels=2",
        "model.candidate_sampler.particles=0",
        "model.candidate_sampler.particles=1",
    ],
)
def test_the_fewest_persistent_particles_and_levels_teach(typed: str, tmp_path: Path) -> None:
    batch = scenes(2)
    method = build(
        tmp_path,
        typed,
        "model/proposals=none",
        "filter/initialize=from_depth",
        "model/likelihood=pointwise",
    ).train()
    for visit in range(3):
        losses = method.training_losses(batch, method.generator("train", visit))
        assert all(loss.isfinite().all() for loss in losses.values())


def test_hidden_puts_two_layers_before_the_outputs() -> None:
    net = partial(PatchNet, extra=64, size=9)
    linear = [m for m in net(hidden=128, latent_width=4).tell if isinstance(m, torch.nn.Linear)]
    assert [(m.in_features, m.out_features) for m in linear] == [
        (32 * 81 + 64, 128),
        (128, 128),
        (128, 7),
    ]
    plain = net(hidden=0).tell
    assert (plain.in_features, plain.out_features) == (32 * 81 + 64, 3)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        (
            "model=cnn_patch model/box_head=pose",
            ("model/box_head=pose", "model=cnn_patch", "model/box_head=quantiles or votes"),
        ),
        (
            "model=patch_pf model/pose_head=none loss/aux/pose=none",
            ("model=patch_pf", "model/pose_head=absolute or surface_point"),
        ),
        (
            "model=cnn_patch loss/aux/likelihood=quality",
            (
                "loss/aux/likelihood=quality",
                "model=cnn_patch",
                "loss/aux/likelihood=balanced_bce, focal or none",
            ),
        ),
        (
            "model=downsized loss/aux/pose=surface_point",
            ("loss/aux/pose=surface_point", "model=downsized", "loss/aux/pose=none"),
        ),
    ],
)
def test_a_pose_that_nothing_provides_is_not_scored(
    choice: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    with pytest.raises(UserError) as refusal:
        build(tmp_path, *choice.split())
    one_line(refusal, *words)
    build(tmp_path, *choice.split()[:1])
