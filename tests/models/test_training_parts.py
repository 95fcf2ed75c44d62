"""Parts of a training, by hand: the loss on the context's map, the stages' walk, and where a long
gradient is cut.
"""

import math
import sys
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from omegaconf import OmegaConf
from torch import Tensor
from torch.utils.data import DataLoader

sys.path.insert(0, str(Path(__file__).parent))
from test_image_space import run_filter, working
from toy import scenes

from posefilter.filters.propagate import Identity
from posefilter.filters.resample import Systematic
from posefilter.models.base import with_lightning
from posefilter.models.cnn_patch import CnnPatch
from posefilter.models.image_space import ImageSpace, objectness_loss
from posefilter.models.loss_schedule import Stage
from posefilter.models.patch_pf import PatchPF
from posefilter.nets.encoders import ContextMap
from posefilter.types import Trace

CONF = Path(__file__).parents[2] / "conf"
LOG2 = math.log(2)

# -- the loss on the context's map ----------------------------------------------------------------


def told(chance: Tensor) -> ContextMap:
    """Return a map that tells these chances, (B, h, w), of showing the object."""
    return ContextMap((), (), chance.logit().requires_grad_())


def loss_and_gradient(seen: ContextMap, mask: Tensor) -> tuple[Tensor, Tensor]:
    assert seen.objectness is not None
    loss = objectness_loss(seen, mask)
    return loss.detach(), torch.autograd.grad(loss.sum(), seen.objectness)[0]


def test_the_objectnesss_loss_is_the_mean_of_both_kinds_of_cells_means() -> None:
    mask = torch.zeros(2, 1, 4, 8, dtype=torch.bool)  # 2 x 4 cells of 2 x 2 pixels
    mask[0, 0, 1, 3] = True  # one pixel is enough for a cell: row 0, column 1
    mask[1, 0, :, 2:] = True  # six of the eight cells
    chance = torch.full((2, 2, 4), 0.5)
    chance[0, 0, 1] = 0.25  # the one that shows it
    chance[0, 1, 3] = 0.75  # one of the seven that do not
    chance[1, 0, 3] = 0.25  # one of the six that do
    chance[1, 1, 0] = 0.75  # one of the two that do not
    loss, gradient = loss_and_gradient(told(chance), mask)
    # every cell costs log 2, the four named ones log 4
    want = torch.tensor([(2 + 8 / 7) / 2, (7 / 6 + 3 / 2) / 2]) * LOG2
    torch.testing.assert_close(loss, want)
    # half of (chance - truth) over the cells of its kind
    torch.testing.assert_close(
        gradient[0], torch.tensor([[0.5, -0.75 * 7, 0.5, 0.5], [0.5, 0.5, 0.5, 0.75]]) / 14
    )
    torch.testing.assert_close(
        gradient[1], torch.tensor([[1.5, -0.5, -0.5, -0.75], [2.25, -0.5, -0.5, -0.5]]) / 12
    )


@pytest.mark.parametrize("count", [1, 4, 7])
def test_the_objects_cells_count_half_however_few_they_are(count: int) -> None:
    mask = (torch.arange(8) < count).view(1, 1, 2, 4)
    chance = torch.where(mask[:, 0], 0.25, 0.5)
    loss, _ = loss_and_gradient(told(chance), mask)
    torch.testing.assert_close(loss, torch.tensor([1.5 * LOG2]))  # half of log 4, and half of log 2


def test_where_one_kind_of_cell_is_missing_the_other_still_counts_half() -> None:
    mask = torch.stack([torch.zeros(1, 4, 8), torch.ones(1, 4, 8)]).bool()
    chance = torch.full((2, 2, 4), 0.5)
    chance[:, 0, 0] = 0.75
    loss, gradient = loss_and_gradient(told(chance), mask)
    # nowhere: seven cells cost log 2 and one log 4; everywhere: seven cost log 2 and one -log 0.75
    torch.testing.assert_close(loss, torch.tensor([9 * LOG2, 7 * LOG2 - math.log(0.75)]) / 16)
    torch.testing.assert_close(gradient, (chance - mask[:, :, ::2, ::2].float()[:, 0]) / 16)


def test_the_objectnesss_loss_and_gradient_stay_finite_however_sure_it_is() -> None:
    mask = torch.stack(
        [torch.zeros(1, 4, 8), torch.ones(1, 4, 8), torch.eye(4).repeat(1, 1, 2)]
    ).bool()
    for logit in (-300.0, 300.0):
        loss, gradient = loss_and_gradient(
            ContextMap((), (), torch.full((3, 2, 4), logit, requires_grad=True)), mask
        )
        assert loss.isfinite().all()
        assert gradient.isfinite().all()
        assert loss[int(logit < 0)] == 150.0  # wholly wrong: half of 300


# -- stages --------------------------------------------------------------------------------------


def tiny(kind: type[ImageSpace], **changes: Any) -> ImageSpace:
    """Return a tiny method whose lessons are called as in conf/."""
    method = working(with_lightning(kind), 3, **changes)
    if "pose" in kind.requires:
        method.aux_losses["pose"] = method.aux_losses.pop("own_point")
    return method


def stages_of(name: str) -> tuple[Stage, ...]:
    """Return the stages of conf/loss/schedule/NAME.yaml."""
    said: Any = OmegaConf.to_container(OmegaConf.load(CONF / "loss" / "schedule" / f"{name}.yaml"))
    return tuple(Stage(one["until"], one.get("loss_weights", {})) for one in said["loss_schedule"])


def at(method: ImageSpace, step: int, steps: int) -> None:
    """Have the method believe that so many of a training's steps are done."""
    trainer: Any = SimpleNamespace(
        global_step=step, estimated_stepping_batches=steps, current_epoch=0
    )
    method.trainer = trainer


def losses_of(method: ImageSpace) -> dict[str, Tensor]:
    return method.train().training_losses(scenes(2), torch.Generator().manual_seed(3))


def teaches(loss: Tensor, method: ImageSpace) -> bool:
    gradients = torch.autograd.grad(
        loss.sum(), list(method.parameters()), retain_graph=True, allow_unused=True
    )
    return any(bool(gradient.any()) for gradient in gradients if gradient is not None)


def test_progress_is_the_share_of_the_steps_that_are_done() -> None:
    method = tiny(CnnPatch, loss_schedule=stages_of("three_stages_displacement"))
    assert method.progress() == 0.0  # no trainer counts
    for step, share in ((0, 0.0), (5, 0.25), (19, 0.95), (20, 1.0)):
        at(method, step, 20)
        assert method.progress() == share


# twenty steps: stages end at 0.4 and 0.6 of them, so that steps 8 and 12 are the first of the next
THREE = {
    0: {"displacement"},
    7: {"displacement"},
    8: {"loss", "likelihood", "pose", "objectness"},
    11: {"loss", "likelihood", "pose", "objectness"},
    12: set(),
    19: set(),
}
THREE_MOTION = {
    0: {"loss", "displacement"},
    7: {"loss", "displacement"},
    8: {"likelihood", "sides", "objectness"},
    11: {"likelihood", "sides", "objectness"},
    12: set(),
    19: set(),
}


@pytest.mark.parametrize(
    ("name", "kind", "off"),
    [("three_stages", PatchPF, THREE), ("three_stages_displacement", CnnPatch, THREE_MOTION)],
)
def test_what_a_stage_switches_off_is_zero_and_teaches_nothing_until_its_turn_comes(
    name: str, kind: type[ImageSpace], off: Mapping[int, set[str]]
) -> None:
    torch.manual_seed(0)
    method = tiny(kind)
    whole = losses_of(method)
    assert all(bool((value > 0).all()) and teaches(value, method) for value in whole.values())
    method.loss_schedule = stages_of(name)
    for step, silent in off.items():
        at(method, step, 20)
        now = losses_of(method)
        assert now.keys() == whole.keys()
        for loss, value in now.items():
            assert torch.equal(value, torch.zeros(2) if loss in silent else whole[loss]), (
                step,
                loss,
            )
            assert teaches(value, method) == (loss not in silent), (step, loss)


def test_a_factor_between_weakens_a_loss() -> None:
    torch.manual_seed(0)
    method = tiny(CnnPatch)
    whole = losses_of(method)
    method.loss_schedule = (Stage(0.5, {"displacement": 0.25}), Stage(1.0, {"displacement": 2.0}))
    for step, factor in ((1, 0.25), (2, 2.0)):
        at(method, step, 4)
        now = losses_of(method)
        torch.testing.assert_close(now["displacement"], factor * whole["displacement"])
        assert torch.equal(now["sides"], whole["sides"])


class Watch(Callback):
    """Notes how far the method believes to be before each step, and which losses are 0 in it."""

    def __init__(self) -> None:
        self.seen: list[tuple[float, set[str]]] = []

    def on_train_batch_start(
        self, trainer: Trainer, method: LightningModule, batch: Any, number: int
    ) -> None:
        assert isinstance(method, ImageSpace)
        self.share = method.progress()

    def on_train_batch_end(
        self, trainer: Trainer, method: LightningModule, out: Any, batch: Any, number: int
    ) -> None:
        logged = trainer.callback_metrics
        names = ("main", "displacement", "likelihood", "sides", "objectness")
        off = {name for name in names if not logged[f"train/loss_{name}"]}
        self.seen.append((self.share, off))


@pytest.mark.filterwarnings("ignore:You defined a `validation_step`")  # none is wanted here
def test_a_training_walks_through_its_stages() -> None:
    """With a trainer that counts for itself: over two epochs, and where two batches make a step."""
    torch.manual_seed(0)
    watch = Watch()
    trainer = Trainer(
        max_steps=5,
        accumulate_grad_batches=2,
        callbacks=[watch],
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    data = DataLoader([scenes(2, seed) for seed in range(6)], batch_size=None)
    trainer.fit(tiny(CnnPatch, loss_schedule=stages_of("three_stages_displacement")), data)
    first, second = {"main", "displacement"}, {"likelihood", "sides", "objectness"}
    want = [(0.0, first), (0.2, first), (0.4, second), (0.6, set()), (0.8, set())]
    assert watch.seen == [one for one in want for _ in range(2)]


# -- where a long gradient is cut ----------------------------------------------------------------


def roll(method: ImageSpace, truncate: int | None) -> Trace:
    method.truncate = truncate
    trace: Trace = method.train_rollout(scenes(2), method, torch.Generator().manual_seed(5))
    return trace


def flows(of: Tensor, into: Tensor) -> bool:
    (gradient,) = torch.autograd.grad(of.sum(), into, retain_graph=True, allow_unused=True)
    return gradient is not None and bool(gradient.any())


def pairs(trace: Trace, what: str) -> set[tuple[int, int]]:
    """Return (later, earlier): to which earlier steps' `what` the gradient of a later step's
    likelihood flows.
    """
    outputs = trace.outputs
    return {
        (later, earlier)
        for later in range(len(outputs))
        for earlier in range(later)
        if flows(outputs[later].log_likelihood, getattr(outputs[earlier], what))
    }


def parts(trace: Trace) -> list[Tensor]:
    """Return every tensor of a run."""
    assert trace.log_evidence is not None
    tuples = (*trace.particles, *trace.outputs, trace.belief)
    return [
        trace.log_evidence,
        *(part for one in tuples for part in one if isinstance(part, Tensor)),
    ]


@pytest.mark.parametrize("truncate", [1, 2, 5])
@pytest.mark.parametrize("kind", [PatchPF, CnnPatch])
def test_a_cut_gradient_changes_no_value(kind: type[ImageSpace], truncate: int) -> None:
    torch.manual_seed(0)
    method = working(
        kind, 3, detach_position=False, train_rollout=run_filter(12, 6, resample=Systematic())
    )
    whole, cut = roll(method, None), roll(method, truncate)
    for a, b in zip(parts(whole), parts(cut), strict=True):
        assert torch.equal(a, b)
    # they went somewhere and remember something that changes, or nothing is tested
    assert (whole.particles[-1].state - whole.particles[0].state).abs().max() > 1
    assert (whole.outputs[-1].latent - whole.outputs[0].latent).abs().max() > 0.01


def test_a_truncated_step_has_no_gradient_of_earlier_ones() -> None:
    torch.manual_seed(0)
    # reads patch, context and place
    method = working(PatchPF, 3, detach_position=False, train_rollout=run_filter(12, 6))
    every = {(later, earlier) for later in range(6) for earlier in range(later)}
    whole = roll(method, None)
    assert pairs(whole, "displacement") == pairs(whole, "latent") == every
    for truncate in (1, 2, 3):
        trace = roll(method, truncate)
        for found in (pairs(trace, "displacement"), pairs(trace, "latent")):
            assert not {later for later, _ in found if later % truncate == 0}
            # the others are not cut
            assert {(later, later - 1) for later in range(1, 6) if later % truncate} <= found


def test_a_latent_is_cut_into_stretches() -> None:
    torch.manual_seed(0)
    method = working(PatchPF, 3, detach_position=False, train_rollout=run_filter(12, 6))
    # no particle moves, so that latent is all that a step hands on
    method.train_rollout.propagate = Identity()
    assert pairs(roll(method, 2), "latent") == {(1, 0), (3, 2), (5, 4)}
    assert pairs(roll(method, 3), "latent") == {(1, 0), (2, 0), (2, 1), (4, 3), (5, 3), (5, 4)}
    assert not pairs(roll(method, 1), "latent")
    assert len(pairs(roll(method, None), "latent")) == 15


def test_positions_with_a_loss_are_not_truncated() -> None:
    """A loss on where particles went teaches every displacement that led there: only what was
    looked at is cut.
    """
    torch.manual_seed(0)
    trace = roll(working(PatchPF, 3, detach_position=False, train_rollout=run_filter(12, 4)), 1)
    for earlier in range(3):
        (gradient,) = torch.autograd.grad(
            trace.particles[3].state.sum(), trace.outputs[earlier].displacement, retain_graph=True
        )
        assert torch.equal(gradient, torch.ones_like(gradient))
