"""A schedule is given the number of steps by the name of its parameter, and only where it has
one.
"""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.optim import lr_scheduler

from posefilter.cli.archive import check_archive
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.plain import to_plain
from posefilter.errors import UserError
from posefilter.models.base import PoseEstimator
from posefilter.models.lr_schedulers import check_length, warmup_cosine
from posefilter.ranges import check_ranges

CONF = Path(__file__).parents[2] / "conf"
STEPS, RATE = 40, 0.5


def build(**scheduler: Any) -> PoseEstimator:
    job = compose_job("train", CONF, ["model=cnn_patch", "optimizer.lr=0.5"], Path())
    job.cfg.scheduler = scheduler
    return build_method(recipe(job))


def schedule(**scheduler: Any) -> Any:
    """Return the schedule of a training of 40 steps."""
    method = build(**scheduler)
    method.__dict__["_trainer"] = type("Trainer", (), {"estimated_stepping_batches": STEPS})
    return method.configure_optimizers()["lr_scheduler"]["scheduler"]


@pytest.fixture(autouse=True)
def a_trainer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        PoseEstimator, "trainer", property(lambda self: self._trainer), raising=False
    )


TORCH = {
    "ConstantLR": {},
    "CosineAnnealingLR": {},
    "CosineAnnealingWarmRestarts": {"T_0": 6, "T_mult": 2},
    "CyclicLR": {"base_lr": 1e-4, "max_lr": 1e-2, "step_size_up": 5, "mode": "triangular2"},
    "ExponentialLR": {"gamma": 0.9},
    "LinearLR": {"total_iters": 7},
    "MultiStepLR": {"milestones": [3, 5]},
    "OneCycleLR": {"max_lr": 1.0},
    "PolynomialLR": {"total_iters": 30, "power": 2.0},
    "StepLR": {"step_size": 3},
}
LENGTH = {"CosineAnnealingLR": "T_max", "OneCycleLR": "total_steps"}


@pytest.mark.parametrize("name", TORCH)
def test_torchs_schedules_are_what_their_settings_say(name: str) -> None:
    made = schedule(_target_=f"torch.optim.lr_scheduler.{name}", _partial_=True, **TORCH[name])
    length = {LENGTH[name]: STEPS} if name in LENGTH else {}
    optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=RATE)
    same = getattr(lr_scheduler, name)(optimizer, **TORCH[name], **length)
    for _ in range(STEPS - 1):
        assert made.get_last_lr()[0] == same.get_last_lr()[0]
        for one in (made, same):
            one.optimizer.step()
            one.step()


@pytest.mark.parametrize("name", ["CosineAnnealingWarmRestarts", "CyclicLR", "PolynomialLR"])
def test_a_schedules_state_can_be_read_from_a_checkpoint(name: str, tmp_path: Path) -> None:
    made = schedule(_target_=f"torch.optim.lr_scheduler.{name}", _partial_=True, **TORCH[name])
    made.optimizer.step()
    made.step()
    file = tmp_path / "last.ckpt"
    torch.save({"lr_schedulers": [made.state_dict()]}, file)
    check_archive(file)
    assert torch.load(file, weights_only=True)["lr_schedulers"][0]["last_epoch"] == 1


def test_adafactor_takes_the_methods_weights() -> None:
    node = {"_target_": "torch.optim.Adafactor", "_partial_": True, "eps": [None, 1e-3]}
    job = compose_job("train", CONF, ["model=cnn_patch", "scheduler=none"], Path())
    job.cfg.optimizer = node
    check_ranges(to_plain(job.cfg), "train")
    method = build_method(recipe(job))
    optimizer = method.configure_optimizers()
    sum(weight.square().sum() for weight in method.parameters()).backward()
    optimizer.step()
    assert isinstance(optimizer, torch.optim.Adafactor)
    assert len(optimizer.state) == len([*method.parameters()])


def test_a_length_that_is_set_is_kept() -> None:
    name = "torch.optim.lr_scheduler.CosineAnnealingLR"
    assert schedule(_target_=name, _partial_=True, T_max=9).T_max == 9


@pytest.mark.parametrize("name", TORCH)
def test_a_training_that_goes_on_for_longer_than_its_schedule_is_refused(name: str) -> None:
    """A checkpoint brings the schedule's length: torch's would end in an error, or rise again."""
    node = {"_target_": f"torch.optim.lr_scheduler.{name}", "_partial_": True, **TORCH[name]}
    made, make = schedule(**node), build(**node).make_scheduler
    assert make is not None
    for steps in (STEPS - 1, STEPS):
        check_length(make, made, SimpleNamespace(estimated_stepping_batches=steps))
    longer = SimpleNamespace(estimated_stepping_batches=STEPS + 1, max_steps=STEPS + 1)
    if name in LENGTH:
        told = rf"^trainer\.max_steps=41: .*{name}, ends after 40, .* warm_start="
        with pytest.raises(UserError, match=told):
            check_length(make, made, longer)
    else:
        check_length(make, made, longer)


def test_the_projects_own_takes_the_trainings_steps() -> None:
    made = schedule(_target_="posefilter.models.lr_schedulers.warmup_cosine", _partial_=True)
    optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=RATE)
    same = partial(warmup_cosine)(optimizer, STEPS)
    assert [made.lr_lambdas[0](i) for i in range(STEPS)] == [
        same.lr_lambdas[0](i) for i in range(STEPS)
    ]


def test_a_warm_up_is_linear_and_the_decay_a_cosine_to_the_last_rate() -> None:
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=RATE)
    factor = warmup_cosine(optimizer, 40, 200, 0.02).lr_lambdas[0]  # at most a tenth of the steps
    assert [factor(i) for i in range(4)] == [0.25, 0.5, 0.75, 1.0]
    wanted = [1.0, 0.02 + 0.49 * (1 + 0.5**0.5), 0.51, 0.02, 0.02]
    assert [factor(i) for i in (4, 13, 22, 40, 99)] == pytest.approx(wanted)
    short = warmup_cosine(optimizer, 40, 2).lr_lambdas[0]
    assert [short(i) for i in (0, 1, 2, 40)] == pytest.approx([0.5, 1.0, 1.0, 0.01])


MISTAKES = {
    ("ExponentialLR", True): r"scheduler\.gamma: is missing, and has no default; the number of",
    ("StepLR", True): r"scheduler\.step_size: is missing",
    ("ConstantLR", False): r"scheduler\.optimizer: is missing.*add `_partial_: true`",
}


@pytest.mark.parametrize(("name", "partial"), MISTAKES)
def test_what_is_missing_is_told_when_the_method_is_built(name: str, partial: bool) -> None:
    with pytest.raises(UserError, match=MISTAKES[name, partial]) as told:
        build(_target_=f"torch.optim.lr_scheduler.{name}", _partial_=partial)
    assert "\n" not in str(told.value)
