"""The four methods: what they see, and that each learns its task on a toy world in seconds."""

import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Trainer
from torch import nn

sys.path.insert(0, str(Path(__file__).parent))
from toy import H, W, scenes, square

from posefilter.errors import UserError
from posefilter.filters.agreement import Agreement
from posefilter.filters.auxiliary import AuxiliaryResampling
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromObjectness, Informed, UniformPixels
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import LearnedDisplacement
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import NoResampling, Systematic
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Constant
from posefilter.labels.displacement import TowardsObject
from posefilter.labels.membership import OnObject, Quality
from posefilter.losses.displacement import Chamfer, DirectDisplacement, Sides
from posefilter.losses.likelihood import BalancedBce, Bce
from posefilter.losses.pose_loss import Add, Confidence, SurfacePointLoss
from posefilter.models.base import with_lightning
from posefilter.models.box_heads import PoseBox, QuantileBox, VotedBox
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.downsized import Downsized
from posefilter.models.image_space import ImageSpace
from posefilter.models.loss_schedule import Auxiliary, Stage, loss_weights_at
from posefilter.models.patch_pf import PatchPF
from posefilter.models.pixel_pf import PixelPF
from posefilter.nets.encoders import NoEncoder, UNetEncoder
from posefilter.nets.glimpse import BilinearGlimpse, IntegerCut
from posefilter.nets.heads import (
    AbsoluteQuaternion,
    Bounded,
    NoPose,
    SurfacePointFragments,
    SurfacePointSixD,
    Unbounded,
)
from posefilter.nets.mlp import LatentNet, PatchNet
from posefilter.protocols import Estimate, Initialize, Loss, Resample


def run_filter(
    particles: int,
    steps: int,
    initialize: Initialize | None = None,
    resample: Resample | None = None,
    estimate: Estimate | None = None,
) -> ParticleFilter:
    pieces = (
        Constant(0.0),
        CurrentLikelihood(),
        resample or NoResampling(),
        LearnedDisplacement(),
        estimate or Argmax(),
        NoRefine(),
    )
    return ParticleFilter(particles, steps, initialize or UniformPixels(), *pieces)


def working(kind: type[ImageSpace], size: int, **changes: Any) -> ImageSpace:
    detects = "pose" not in kind.requires
    label = OnObject(size) if detects else Quality(size)
    aux_losses = {
        "likelihood": Auxiliary(BalancedBce(label)),
        "displacement": Auxiliary(DirectDisplacement(TowardsObject("nearest", 1)), 2.0),
    }
    aux_losses["sides" if detects else "own_point"] = Auxiliary(
        Sides(OnObject()) if detects else SurfacePointLoss(), 2.0
    )
    net: Any
    if detects:
        net = partial(PatchNet, width=8, hidden=64, latent_width=4, normalization="layer")
    else:
        net = partial(LatentNet, latent_width=16, width=64, layers=3, normalization="layer")

    parts: dict[str, Any] = {
        "net": net,
        "glimpse": BilinearGlimpse(size),
        "encoder": UNetEncoder((16, 24, 32, 32), 32),
        "pose_head": NoPose() if detects else SurfacePointSixD(),
        "displacement": Bounded(0.3),
        "box_head": VotedBox() if detects else PoseBox(),
        "aux_losses": aux_losses,
        "detach_position": True,
        "filter": run_filter(
            64, 4, resample=Systematic(), estimate=Argmax() if detects else Agreement()
        ),
        "train_rollout": run_filter(64, 2, Informed(UniformPixels(), 0.5, 5.0)),
        "loss": Chamfer(size) if detects else Confidence(OnObject(size)),
        "optimizer": partial(torch.optim.AdamW, lr=3e-3),
    }
    method = kind(**(parts | changes))
    method.set_object(square())
    return method


def paper(kind: type[ImageSpace], size: int, steps: int = 3, **changes: Any) -> ImageSpace:
    detects = "pose" not in kind.requires
    parts: dict[str, Any] = {
        "net": PatchNet if detects else LatentNet,
        "glimpse": IntegerCut(size),
        "encoder": NoEncoder(),
        "pose_head": NoPose() if detects else AbsoluteQuaternion(),
        "displacement": Unbounded(),
        "box_head": QuantileBox(size) if detects else PoseBox(),
        "filter": run_filter(50, steps),
        "loss": Chamfer(size) if detects else Add(),
        "optimizer": partial(torch.optim.Adam, lr=1e-3),
    }
    method = kind(**(parts | changes))
    method.set_object(square())
    return method


def teach(method: ImageSpace, steps: int, seed: int = 0) -> None:
    batch = scenes(4)
    optimizer = method.configure_optimizers()
    method.train()
    for step in range(steps):
        loss = method.training_step(batch, seed * 10_000 + step)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(method.parameters(), 1.0)
        optimizer.step()
    method.eval()


@pytest.mark.parametrize(("kind", "size"), [(PixelPF, 1), (PatchPF, 3), (Downsized, 9)])
@pytest.mark.slow
def test_a_little_teaching_brings_particles_onto_the_object_and_finds_it(
    kind: type[ImageSpace], size: int
) -> None:
    torch.manual_seed(0)
    method = working(kind, size)
    with torch.no_grad():
        method.eval().test_step(scenes(4), 0)
    before = method.compute_metrics()
    assert before["particles_on_object"] < 0.4
    method._reset()
    teach(method, 120)
    with torch.no_grad():
        method.test_step(scenes(4), 0)
    after = method.compute_metrics()
    assert after["particles_on_object"] > 0.85
    assert after["iou"] > 0.7
    assert after["diagnostics"]["auroc"] > 0.8
    assert after["diagnostics"]["on_object"][0] < 0.4 < after["diagnostics"]["on_object"][-1]
    if "pose" in kind.requires:
        assert before["add"]["median_mm"] > 60
        assert after["add"]["median_mm"] < 25


@pytest.mark.parametrize(
    ("kind", "size", "loss"),
    [(PixelPF, 1, Add()), (PatchPF, 3, Bce(OnObject(3))), (CnnPatch, 9, Chamfer(9))],
)
@pytest.mark.slow
def test_the_papers_recipe_runs_and_its_loss_falls(
    kind: type[ImageSpace], size: int, loss: Loss
) -> None:
    torch.manual_seed(0)
    method = paper(kind, size, loss=loss)
    batch = scenes(4)
    generator = method.generator("train", 0)
    first = method.training_losses(batch, generator)
    assert list(first) == ["loss"]  # nothing but the chosen loss: every remedy is off
    teach(method, 25)
    method.train()
    assert (
        method.training_losses(batch, method.generator("train", 0))["loss"].mean()
        < first["loss"].mean()
    )


def test_the_papers_sizes() -> None:
    method = paper(PatchPF, 6)
    assert method.latent_width == 256
    assert method.net.latent[0].in_features == 4 * 36 + 2 + 256  # patch, location, latent
    assert paper(PixelPF, 1).net.latent[0].in_features == 4 + 256
    assert method.net.displacement[0].in_features == 7 + 1 + 256


def test_no_gradient_of_a_patch_reaches_the_displacement_through_an_integer_cut() -> None:
    """The paper's likelihood cannot teach method 1 where to go: only a place that is told can, or a
    smooth glimpse.
    """
    batch = scenes(2)

    def reaches(method: ImageSpace) -> bool:
        losses = method.train().training_losses(batch, method.generator("train", 0))
        gradient = torch.autograd.grad(
            losses["loss"].sum(), method.net.displacement[0].weight, allow_unused=True
        )[0]
        return gradient is not None and bool(gradient.abs().sum() > 0)

    bce = Bce(OnObject())
    assert not reaches(paper(PixelPF, 1, loss=bce))
    assert reaches(paper(PixelPF, 1, loss=bce, glimpse=BilinearGlimpse(1)))
    # it is told its location, and can learn to flee to where the answer is no
    assert reaches(paper(PatchPF, 3, loss=bce))
    assert not reaches(paper(PatchPF, 3, loss=bce, truncate=1))


def test_neither_mask_nor_pose_is_used_in_evaluation() -> None:
    torch.manual_seed(0)
    method = working(PatchPF, 3).eval()
    batch = scenes(2)
    lie = batch._replace(mask=~batch.mask, camera_from_object=batch.camera_from_object.flip(0))
    with torch.no_grad():
        a, b = (method.predict_step(x, 0) for x in (batch, lie))
    assert torch.equal(a.belief.best, b.belief.best)
    assert torch.equal(a.particles[-1].state, b.particles[-1].state)


def test_particles_start_and_are_resampled_where_the_objectness_is() -> None:
    torch.manual_seed(0)
    method = working(PatchPF, 3)
    teach(method, 40)
    batch = scenes(4)

    def share(initialize: Initialize, resample: Resample) -> list[float]:
        method._reset()
        method.filter = run_filter(64, 3, initialize, resample)
        with torch.no_grad():
            method.test_step(batch, 0)
        return method.compute_metrics()["diagnostics"]["on_object"]

    uniform = share(UniformPixels(), NoResampling())
    assert share(FromObjectness(), NoResampling())[0] > uniform[0] + 0.3
    assert share(UniformPixels(), AuxiliaryResampling(Systematic()))[1] > uniform[1]
    with pytest.raises(UserError, match="objectness"):
        paper(PatchPF, 3, filter=run_filter(8, 2, FromObjectness()))


def test_a_method_knows_its_trainer_while_it_measures_in_training() -> None:
    seen = []

    class Annealed(PixelPF):
        def measure(self, *arguments: Any) -> Any:
            seen.append(self.trainer)
            return super().measure(*arguments)

    method = working(with_lightning(Annealed), 1)
    method._trainer = trainer = Trainer(logger=False, enable_checkpointing=False)
    method.training_losses(scenes(2), torch.Generator().manual_seed(0))
    assert seen
    assert all(one is trainer for one in seen)


def test_stages_change_the_weights_as_training_proceeds() -> None:
    loss_schedule = (
        Stage(0.4, {"displacement": 0.0}),
        Stage(0.7, {"own_point": 0.0, "likelihood": 0.0}),
        Stage(1.0, {}),
    )
    assert loss_weights_at(loss_schedule, 0.2) == {"displacement": 0.0}
    assert loss_weights_at(loss_schedule, 0.5) == {"own_point": 0.0, "likelihood": 0.0}
    assert loss_weights_at(loss_schedule, 1.0) == {}
    assert loss_weights_at((), 0.5) == {}
    method, batch = working(PatchPF, 3, loss_schedule=loss_schedule), scenes(2)
    losses = method.training_losses(batch, method.generator("train", 0))
    assert losses["displacement"].sum() == 0
    assert losses["own_point"].sum() > 0
    timed = working(with_lightning(PatchPF), 3, loss_schedule=loss_schedule)
    timed._trainer = SimpleNamespace(estimated_stepping_batches=100, global_step=10)
    assert timed.progress() == 0.1
    timed.time_spent = 0.5  # of a time budget, whichever is more
    assert timed.progress() == 0.5
    with pytest.raises(UserError, match="names the loss 'moton'"):
        working(PatchPF, 3, loss_schedule=(Stage(1.0, {"moton": 0.0}),))
    with pytest.raises(UserError, match="the ends must rise"):
        working(PatchPF, 3, loss_schedule=(Stage(0.5, {}),))


def test_own_points_are_where_the_truth_puts_them() -> None:
    method, batch = working(PixelPF, 1), scenes(3)
    pixel = torch.tensor([[[W / 2, H / 2]]]).expand(3, 1, 2)
    point, known = method.surface_points(method.encode(batch), pixel)
    assert known.all()
    depth = batch.depth[:, 0, H // 2, W // 2]
    torch.testing.assert_close(point[:, 0, 2], depth)
    torch.testing.assert_close(point[:, 0, 0], 0.5 / 60 * depth)


def test_what_fragments_have_learned_survives_a_checkpoint_and_other_points_to_judge_by() -> None:
    method = working(PatchPF, 3, pose_head=SurfacePointFragments(16))
    teach(method, 10)
    again = working(PatchPF, 3, pose_head=SurfacePointFragments(16))
    model = square()
    again.load_state_dict(method.state_dict())
    again.eval().set_object(model._replace(points=model.points.flip(0)[::2]))
    with torch.no_grad():
        before, after = (m.predict_step(scenes(2), 0).belief for m in (method, again))
    torch.testing.assert_close(before.best, after.best)
    torch.testing.assert_close(before.poses, after.poses)


def test_an_image_without_depth_gets_a_finite_belief() -> None:
    method = working(PatchPF, 3, pose_head=SurfacePointFragments(16)).eval()
    batch = scenes(2)
    batch.depth[1] = 0
    with torch.no_grad():
        belief = method.predict_step(batch, 0).belief
    for part in belief:
        assert part.isfinite().all()
