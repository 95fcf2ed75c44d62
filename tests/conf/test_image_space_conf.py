"""Every image-space model x variant x legal loss composes from conf/, builds, and takes a step."""

import sys
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
from tests.conf.conftest import compose_once
from toy import scenes, square

from posefilter.cli.ablations import (
    ABLATIONS,
    Ablation,
    list_detector_ablations,
    list_pose_ablations,
    list_pose_space_ablations,
)
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.errors import UserError
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.downsized import Downsized
from posefilter.models.image_space import ImageSpace
from posefilter.models.patch_pf import PatchPF
from posefilter.models.pixel_pf import PixelPF

CONF = Path(__file__).parents[2] / "conf"
KINDS: dict[str, type[ImageSpace]] = {
    "pixel_pf": PixelPF,
    "patch_pf": PatchPF,
    "cnn_patch": CnnPatch,
    "downsized": Downsized,
}
DETECTING = ("chamfer", "chamfer_rgbd", "offset", "bce", "balanced_bce", "focal", "belief_nll")
# losses by what a method requires of its heads
FITTING = {
    (): DETECTING,
    ("pose",): ("add", "add_s", "confidence", "belief_nll_pose", *DETECTING),
}
SMALL = ["filter.particles=12", "filter.steps=2"]


def build(tmp_path: Path, *overrides: str) -> ImageSpace:
    job = compose_job("train", CONF, [*overrides, *SMALL], tmp_path)
    method = build_method(recipe(job), square())
    assert isinstance(method, ImageSpace)
    return method


def step(method: ImageSpace) -> dict[str, torch.Tensor]:
    losses = method.train().training_losses(scenes(2), method.generator("train", 0))
    total = torch.stack([value.mean() for value in losses.values()]).sum()
    assert total.isfinite()
    total.backward()
    assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in method.parameters())
    return losses


@pytest.mark.parametrize("variant", ["paper", "working"])
@pytest.mark.parametrize(
    ("model", "loss"), [(m, loss) for m, kind in KINDS.items() for loss in FITTING[kind.requires]]
)
def test_every_legal_loss_takes_a_step(model: str, loss: str, variant: str, tmp_path: Path) -> None:
    losses = step(build(tmp_path, f"model={model}", f"variant={variant}", f"loss={loss}"))
    assert ("displacement" in losses) == (variant == "working")
    assert ("objectness" in losses) == (variant == "working")


@pytest.mark.parametrize("model", KINDS)
def test_the_papers_figures(model: str) -> None:
    job = compose_once(f"model={model}", "variant=paper")
    want = {
        "pixel_pf": (1000, 10, 1),
        "patch_pf": (50, 100, 3),
        "cnn_patch": (50, 30, 9),
        "downsized": (50, 30, 9),
    }[model]
    assert (job.cfg.filter.particles, job.cfg.filter.steps, job.cfg.model.glimpse.size) == want
    assert job.choices["loss"] == {"pixel_pf": "add", "patch_pf": "bce"}.get(model, "chamfer")
    assert (job.cfg.data.image_width == 160) == (model == "downsized")
    method = build_method(recipe(job), square())
    assert not method.aux_losses
    assert not method.loss_schedule
    assert method.train_rollout is method.filter
    batch_norms = sum(
        isinstance(m, torch.nn.modules.batchnorm._BatchNorm) for m in method.modules()
    )
    assert batch_norms == (12 if "pose" in method.requires else 3)


REMEDIES = [
    "model/encoder=none",
    "model/encoder=pyramid",
    "model/encoder=resnet model.encoder.trunk.kind=resnet18",
    "model/encoder=resnet model.encoder.trunk.stages=3 model.encoder.trunk.frozen=true",
    "model/glimpse=integer",
    "model.net.normalization=batch",
    "model/displacement=unbounded",
    "model/displacement=unbounded model.displacement.unit=10",
    "model/displacement=unbounded model.displacement.unit=learned",
    "loss/aux/displacement=none",
    "loss/aux/displacement=towards_object model.aux_losses.displacement.loss.label.target=center",
    "loss/aux/likelihood=none",
    "loss/aux/likelihood=focal",
    "loss/schedule=three_stages",
    "model/train_rollout=full",
    "model/train_rollout=resampled loss=belief_nll",
    "model/train_rollout=resampled filter/resample@model.train_rollout.resample=optimal_transport",
    "filter/resample=none",
    "filter/resample=auxiliary",
    "filter/initialize=from_objectness",
    "filter/initialize=informed",
    "filter/propagate=learned_and_gaussian",
    "model.glimpse.size=6",
    "loss=chamfer loss.max_pixels=null",
    "model/displacement=gated",
    "model.detach_position=false",
    "loss/schedule=three_stages_displacement",
    "loss/schedule=displacement_only",
    "loss/schedule=likelihood_only",
]


@pytest.mark.parametrize("model", ["patch_pf", "downsized"])
@pytest.mark.parametrize("change", REMEDIES)
def test_each_modification_is_one_choice(model: str, change: str, tmp_path: Path) -> None:
    method = build(tmp_path, f"model={model}", *change.split())
    step(method)
    with torch.no_grad():
        trace = method.eval().predict_step(scenes(2), 0)
    assert trace.belief.best.isfinite().all()


def test_a_detector_may_have_a_latent(tmp_path: Path) -> None:
    losses = step(build(tmp_path, "model=cnn_patch", "variant=paper", "model/net=latent"))
    assert {*losses} == {"loss"}


@pytest.mark.parametrize("model", ["patch_pf", "downsized"])
def test_the_displacement_alone_is_learned_where_the_schedule_says_so(
    model: str, tmp_path: Path
) -> None:
    alone = "loss/schedule=displacement_only"
    losses = step(build(tmp_path, f"model={model}", "loss=bce", alone))
    taught = {name for name, value in losses.items() if bool(value.any())}
    assert taught == {"displacement"} < {*losses}
    stages = build(tmp_path, f"model={model}", "loss=bce", "loss/schedule=three_stages")
    off = stages.loss_schedule[1].loss_weights
    assert {*losses} - {"displacement"} <= {*off}
    assert not any(off.values())


def test_the_margin_of_the_displacement_scales_with_the_image(tmp_path: Path) -> None:
    margins = {
        model: build(tmp_path, f"model={model}").aux_losses["displacement"].loss.label.margin_px
        for model in KINDS
    }  # type: ignore[attr-defined]
    assert margins == {"pixel_pf": 3, "patch_pf": 3, "cnn_patch": 6, "downsized": 3}
    assert (
        "displacement"
        not in build(tmp_path, "model=cnn_patch", "loss/aux/displacement=none").aux_losses
    )


@pytest.mark.parametrize(
    "change",
    [
        "model/pose_head=absolute",
        "model/pose_head=surface_point loss/aux/pose=none",
        "filter/estimate=densest_pose",
        "filter/estimate=mean",
    ],
)
@pytest.mark.parametrize("model", ["pixel_pf", "patch_pf"])
def test_each_pose_modification_is_one_choice(model: str, change: str, tmp_path: Path) -> None:
    step(build(tmp_path, f"model={model}", *change.split()))


def test_fragments_are_not_left_untaught(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="loss/aux/pose=surface_point"):
        build(tmp_path, "model=patch_pf", "loss/aux/pose=none")
    method = build(tmp_path, "model=patch_pf")
    step(method)
    last = [m for m in method.net.pose if isinstance(m, torch.nn.Linear)][-1]
    fragments = method.pose_head.fragments
    assert (last.weight.grad[6 : 6 + fragments].abs().amax(1) > 0).all(), "every share learns"


def test_the_memorization_test_shows_the_images_that_it_learned(tmp_path: Path) -> None:
    job = compose_job("train", CONF, ["model=patch_pf", "experiment=memorize"], tmp_path)
    assert job.choices["data/augment"] == "none"
    data = job.cfg.data
    assert data.split.test == data.split.val == "train"
    assert data.limit_train == data.limit_test == data.limit_val
    assert data.min_visibility == data.min_visibility_test


SEVERAL = {  # ablations that are more than one change
    "s9_displacement_loss_and_position": 2,
    "m8_short": 2,
    "pose_c11_surface_point": 2,
    "pose_c15_noise": 2,
    "pose_m14_surface_point": 3,
    "pose_m18_noise": 2,
    "pose_pf_s7_proposals": 2,
    "pose_pf_c1_contrast": 3,
    "pose_pf_c7_proposals": 2,
    "pose_pf_m1_contrast": 3,
    "pose_pf_m7_proposals": 3,
    "pose_pf_m8_context": 2,
}


@pytest.mark.parametrize("ablation", ABLATIONS, ids=[a.name for a in ABLATIONS])
def test_each_ablation_changes_what_it_says(ablation: Ablation) -> None:
    """Its choices and settings are its parent's, but for its own overrides."""
    kinds = {"box_": "cnn_patch", "pose_pf_": "pose_pf"}
    model = next((m for k, m in kinds.items() if ablation.name.startswith(k)), "patch_pf")
    parent = ablation.parent if "=" in ablation.parent else f"ablation={ablation.parent}"
    before, after = (
        compose_once(f"model={model}", typed) for typed in (parent, f"ablation={ablation.name}")
    )
    assert len(ablation.overrides) == SEVERAL.get(ablation.name, "variant" not in ablation.parent)
    ignored = ("ablation", "hydra/launcher")
    changed = {
        group
        for group in after.choices
        if after.choices[group] != before.choices.get(group) and group not in ignored
    }
    assert changed == {
        o.partition("=")[0] for o in ablation.overrides if "." not in o.split("=")[0]
    }
    for override in ablation.overrides:
        key, _, value = override.partition("=")
        now = OmegaConf.select(after.cfg, key) if "." in key else after.choices[key]
        expected = value.replace("${model}", model)
        assert ("null" if now is None else str(now).lower()) == expected, override
        if "." in key:
            assert OmegaConf.select(before.cfg, key) != now, override


@pytest.mark.parametrize("name", list_pose_space_ablations())
def test_each_ablation_of_the_pose_filter_fits_together(name: str) -> None:
    job = compose_once("model=pose_pf", "sweep=ablation_pose_pf", f"ablation={name}")
    method = build_method(recipe(job))
    assert (method.filter.particles, method.filter.steps, method.pixels) == (100, 10, 32)


@pytest.mark.parametrize(
    ("sweep", "model", "names"),
    [
        ("ablation", "patch_pf", list_pose_ablations()),
        ("ablation_detect", "cnn_patch", list_detector_ablations()),
    ],
)
def test_a_sweep_of_the_table_is_of_one_size(sweep: str, model: str, names: list[str]) -> None:
    """All runs of a method with a pose are as large as the working preset; a detector's start from
    the paper's size, whose long roll-outs are among what fails.
    """
    working = compose_once(f"model={model}", "variant=working").cfg
    for name in (names[0], names[-1]):
        typed = [f"model={model}", f"sweep={sweep}", f"ablation={name}"]
        cfg = compose_once(*typed).cfg
        whole = sweep == "ablation" or name.startswith("box_m")
        assert (cfg.filter.steps == working.filter.steps) == whole
        assert (cfg.model.net.width == working.model.net.width) == whole
        assert cfg.filter.particles == (128 if sweep == "ablation" else 32)
