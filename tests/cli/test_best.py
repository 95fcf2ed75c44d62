"""Which of a run's validations is tested."""

import logging
import signal
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import EarlyStopping
from torch import Tensor, nn
from torch.utils.data import DataLoader

from posefilter.cli.best import Best, Last, check_kept
from posefilter.cli.stopping import FinalValidation, Stop
from posefilter.cli.train import check_validated
from posefilter.errors import Stopped, UserError


class Scored(LightningModule):
    """A module whose validations have given scores."""

    def __init__(self, scores: list[float]) -> None:
        super().__init__()
        self.scores = iter(scores)
        self.validated: list[int] = []  # at these steps
        self.weight = nn.Parameter(torch.zeros(()))

    def training_step(self, batch: Tensor, index: int) -> Tensor:
        return self.weight.square()

    def validation_step(self, batch: Tensor, index: int) -> None:
        self.log("val/score", next(self.scores))
        self.validated.append(self.global_step)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


@pytest.mark.parametrize(
    ("scores", "step"),
    [([0.0, 0.0, 0.0], 3), ([0.0, 5.0, 5.0], 3), ([5.0, 5.0, 1.0], 2), ([1.0, 9.0, 3.0], 2)],
)
def test_of_equal_validations_the_latest_is_kept(
    scores: list[float], step: int, tmp_path: Path
) -> None:
    keep = Best(
        dirpath=tmp_path,
        filename="best",
        monitor="val/score",
        mode="max",
        enable_version_counter=False,
    )
    trainer = Trainer(
        max_epochs=3,
        callbacks=[keep],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    one = DataLoader([torch.zeros(1)])
    trainer.fit(Scored(scores), one, one)
    assert torch.load(tmp_path / "best.ckpt", weights_only=True)["global_step"] == step
    assert [path.name for path in tmp_path.iterdir()] == ["best.ckpt"]


def fit_epochs(
    folder: Path, changed: dict[str, Any], start: Path | None = None, minutes: float = 3.0
) -> list[int]:
    """Train for two epochs of four batches; return the steps that were validated."""
    keep = Best(dirpath=folder, filename="best", monitor="val/score", mode="max")
    settings = {"max_epochs": 2, "val_check_interval": 5, "check_val_every_n_epoch": None}
    trainer = Trainer(
        **{**settings, **changed},
        callbacks=[keep, Last(str(folder), minutes), FinalValidation()],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
    )
    method, four = Scored([0.0] * 9), DataLoader(torch.zeros(4, 1))
    trainer.fit(method, four, DataLoader(torch.zeros(1, 1)), ckpt_path=start, weights_only=True)
    return method.validated


EACH_EPOCH = {"check_val_every_n_epoch": 1, "val_check_interval": 1.0}


@pytest.mark.parametrize(
    ("changed", "validated"),
    [
        ({}, [5, 8]),
        ({"val_check_interval": 50}, [8]),
        ({"val_check_interval": 4}, [4, 8]),  # once where one is due anyway
        ({"max_steps": 100}, [5, 8]),
        ({"max_steps": 7, "max_epochs": -1}, [5, 7]),
        ({"limit_train_batches": 3}, [5, 6]),
        ({"accumulate_grad_batches": 3}, [2, 4]),  # a step is of three batches, and of the rest
        ({"min_epochs": 2}, [5, 8]),
        (EACH_EPOCH, [4, 8]),
        ({**EACH_EPOCH, "val_check_interval": 0.75}, [3, 7, 8]),
        ({**EACH_EPOCH, "check_val_every_n_epoch": 2}, [8]),
    ],
)
@pytest.mark.filterwarnings("ignore:Checkpoint directory", "ignore:.*dirpath has changed")
@pytest.mark.filterwarnings("ignore:You're resuming")
@pytest.mark.filterwarnings("ignore:.*could not find the monitored key")  # where none was left
def test_the_last_step_is_validated_and_no_other_follows_when_it_is_resumed(
    changed: dict[str, Any], validated: list[int], tmp_path: Path
) -> None:
    assert fit_epochs(tmp_path, changed) == validated
    read = {p: torch.load(tmp_path / p, weights_only=True) for p in ("best.ckpt", "last.ckpt")}
    assert {one["global_step"] for one in read.values()} == {validated[-1]}
    assert fit_epochs(tmp_path, changed, tmp_path / "last.ckpt") == []
    again = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert again["global_step"] == validated[-1]
    if len(validated) > 1:  # one that was cut short does as much
        before = tmp_path / "last.previous.ckpt"
        assert fit_epochs(tmp_path / "again", changed, before) == validated[-1:]


@pytest.mark.filterwarnings("ignore:Checkpoint directory", "ignore:You're resuming")
def test_nothing_is_resumed_amid_the_validation_of_the_last_step(tmp_path: Path) -> None:
    """It would not be gone on with."""
    fit_epochs(tmp_path, {}, minutes=0)  # the last but one is the one before that validation
    assert fit_epochs(tmp_path, {}, tmp_path / "last.previous.ckpt") == [8]


@pytest.mark.parametrize("moved", [False, True])
def test_a_run_whose_folder_was_moved_keeps_its_best(moved: bool, tmp_path: Path) -> None:
    settings = {"filename": "best", "monitor": "val/score", "mode": "max"}
    before, after = tmp_path / "a", tmp_path / ("b" if moved else "a")
    before.mkdir()
    (before / "best.ckpt").touch()
    keep = Best(dirpath=before, **settings)
    keep.best_model_score = keep.kth_value = torch.tensor(90.0)
    keep.best_model_path = keep.kth_best_model_path = str(before / "best.ckpt")
    keep.best_k_models = {keep.best_model_path: torch.tensor(90.0)}
    state = keep.state_dict()
    before.rename(after)
    resumed = Best(dirpath=after, **settings)
    resumed.load_state_dict(state)
    trainer: Any = SimpleNamespace(
        strategy=SimpleNamespace(reduce_boolean_decision=lambda decision, **_: decision)
    )
    assert resumed.best_model_path == str(after / "best.ckpt")
    assert not resumed.check_monitor_top_k(trainer, torch.tensor(10.0))
    assert resumed.check_monitor_top_k(trainer, torch.tensor(95.0))


def test_a_copy_of_a_run_does_not_replace_the_best_of_the_other(tmp_path: Path) -> None:
    settings = {"filename": "best", "monitor": "val/score", "mode": "max"}
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "best.ckpt").touch()
    path = str(tmp_path / "a" / "best.ckpt")
    state = {"dirpath": str(tmp_path / "a"), "best_k_models": {path: torch.tensor(90.0)}}
    state |= dict.fromkeys(("best_model_path", "last_model_path", "kth_best_model_path"), path)
    keep = Best(dirpath=tmp_path / "b", **settings)
    with pytest.warns(UserWarning, match="dirpath"):
        keep.load_state_dict(state)
    assert (keep.best_model_path, keep.best_k_models) == ("", {})


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"dirpath": "elsewhere"}, "callbacks.best.dirpath=.*elsewhere: .*checkpoints"),
        ({"filename": "good"}, "callbacks.best.filename=good: must be best"),
        ({"save_top_k": 3}, "callbacks.best.save_top_k=3: must be 1"),
        ({"save_top_k": 0}, "callbacks.best.save_top_k=0: must be 1"),
        ({"monitor": "None"}, "callbacks.best.monitor=None: must be .*val/score"),
        ({"monitor": "val/add/median_mm"}, "mode=max: would keep the worst .*median_mm; .* min"),
        ({"mode": "min"}, "callbacks.best.mode=min: would keep the worst val/score; must be max"),
    ],
)
def test_a_run_whose_best_checkpoint_would_not_be_found_is_refused_before_it(
    wrong: dict[str, Any], told: str, tmp_path: Path
) -> None:
    folder = tmp_path / "checkpoints"
    right = {"dirpath": folder, "filename": "best", "monitor": "val/score", "mode": "max"}
    last = Last(str(folder))
    check_kept([last, Best(**right)], tmp_path)
    least = {"monitor": "val/add/median_mm", "mode": "min"}
    check_kept([last, Best(**(right | least))], tmp_path)
    check_kept([last, Best(**(right | {"monitor": "val/of_a_plugin"}))], tmp_path)
    with pytest.raises(UserError, match=told):
        check_kept([last, Best(**(right | wrong))], tmp_path)
    with pytest.raises(UserError, match=r"callbacks\.best: is missing"):
        check_kept([last], tmp_path)
    with pytest.raises(UserError, match=r"callbacks\.last\.dirpath"):
        check_kept([Last(str(tmp_path)), Best(**right)], tmp_path)


@pytest.mark.parametrize(
    ("monitor", "mode", "better"),
    [
        ("val/score", "min", "max"),  # min is Lightning's default
        ("val/score", "max", None),
        ("val/add/median_mm", "max", "min"),
        ("val/add/median_mm", "min", None),
        ("val/of_a_plugin", "min", None),
    ],
)
def test_a_training_does_not_end_because_it_gets_better(
    monitor: str, mode: str, better: str | None, tmp_path: Path
) -> None:
    folder = tmp_path / "checkpoints"
    best = Best(dirpath=folder, filename="best", monitor="val/score", mode="max")
    callbacks = [best, EarlyStopping(monitor, mode=mode)]
    if better is None:
        check_kept(callbacks, tmp_path)
        return
    told = rf"EarlyStopping>\.mode={mode}: would end .* better {monitor}; must be {better}$"
    with pytest.raises(UserError, match=told):
        check_kept(callbacks, tmp_path)


def test_saving_says_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    trainer = Trainer(
        max_steps=1,
        callbacks=[Last(str(tmp_path), minutes=0)],
        logger=False,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    with caplog.at_level(logging.INFO):
        trainer.fit(Scored([]), DataLoader([torch.zeros(1)]))
        assert (tmp_path / "last.ckpt").is_file()
        assert "weights_only" not in caplog.text
        trainer.save_checkpoint(tmp_path / "other.ckpt")  # what Lightning says by itself
    assert "weights_only" in caplog.text


class TwoProcesses:
    """A trainer of two processes, of which the other decides."""

    world_size, accumulate_grad_batches = 2, 1
    callbacks: ClassVar[list[Callback]] = []

    def __init__(self, other: bool) -> None:
        self.other, self.asked = other, list[bool]()
        self.strategy = self

    def reduce_boolean_decision(self, decision: bool, all: bool) -> bool:
        assert not all
        self.asked.append(decision)
        return decision or self.other


@pytest.mark.parametrize(("mine", "other"), [(True, False), (False, True), (False, False)])
def test_processes_write_where_the_clock_of_any_says_so(
    tmp_path: Path, mine: bool, other: bool
) -> None:
    """Each asks, whatever its own clock says: else the others would wait for its answer."""
    last = Last(str(tmp_path), minutes=0 if mine else 60)
    last._saved_at = time.monotonic()
    trainer = TwoProcesses(other)
    assert last._due(trainer) == (mine or other)  # type: ignore[arg-type]
    assert trainer.asked == [mine]


def test_processes_stop_together() -> None:
    """One that got no signal stops with the one that did, after a checkpoint."""
    stop = Stop()
    stop.on_train_batch_start()
    stop.on_train_batch_end(TwoProcesses(True), None)  # type: ignore[arg-type]
    with pytest.raises(Stopped):
        stop.on_train_batch_start()


def test_a_signal_between_two_batches_waits_for_the_checkpoint() -> None:
    stop, alone = Stop(), TwoProcesses(False)
    alone.world_size = 1
    stop._note(signal.SIGINT, None)
    stop.on_train_batch_start()  # nothing was written since the last batch: one more is done
    stop.on_train_batch_end(alone, None)  # type: ignore[arg-type]
    with pytest.raises(Stopped):
        stop.on_train_batch_start()


def test_what_a_run_goes_on_from_is_written_where_no_gradients_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No checkpoint has them: the step would be done without the batches before it."""
    stop, last = Stop(), Last(str(tmp_path), minutes=60)
    waits = [True]
    loop = SimpleNamespace(_should_accumulate=lambda: waits[0], _data_fetcher=1)
    loop._should_check_val_fx = lambda fetcher: False
    written: list[Path] = []
    trainer: Any = SimpleNamespace(
        accumulate_grad_batches=2,
        callbacks=[stop, last],
        fit_loop=SimpleNamespace(epoch_loop=loop, _data_fetcher=1),
        is_global_zero=False,
        save_checkpoint=lambda path, **_: written.append(path),
        sanity_checking=False,
        world_size=1,
    )
    last._saved_at = time.monotonic()
    last.on_validation_end(trainer, None)  # type: ignore[arg-type]
    stop._note(signal.SIGTERM, None)
    for waiting in (True, False):
        waits[0] = waiting
        for one in (stop, last):
            one.on_train_batch_end(trainer, None)  # type: ignore[arg-type]
        assert bool(written) == (not waiting)
        if waiting:
            stop.on_train_batch_start()  # the batch that completes the step
    with pytest.raises(Stopped):
        stop.on_train_batch_start()


@pytest.mark.parametrize(
    ("every", "interval", "steps", "accumulated", "first"),
    [
        (2, 1.0, 8, 1, None),
        (2, 1.0, 7, 1, 8),
        (3, 0.5, 9, 1, 10),
        (1, 4, 3, 1, 4),
        (2, 1.0, 4, 2, None),
        (9, 1.0, -1, 1, None),
        (None, 50, 3, 1, None),  # in steps; build_trainer validates at the end
    ],
)
def test_a_training_that_ends_before_its_first_validation_is_refused(
    every: int | None, interval: float, steps: int, accumulated: int, first: int | None
) -> None:
    trainer = SimpleNamespace(
        check_val_every_n_epoch=every,
        val_check_interval=interval,
        max_steps=steps,
        accumulate_grad_batches=accumulated,
        max_epochs=-1,
        limit_train_batches=1.0,
        limit_val_batches=1.0,
        limit_test_batches=1.0,
    )
    run: Any = SimpleNamespace(
        trainer=trainer, data=SimpleNamespace(train_dataloader=lambda: range(4))
    )
    if first is None:
        check_validated(run)
    else:
        with pytest.raises(UserError, match=f"first validation is after step {first},"):
            check_validated(run)


EVERY_SECOND = {"check_val_every_n_epoch": 2, "val_check_interval": 1.0}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"limit_val_batches": 0}, "trainer.limit_val_batches=0: "),
        ({"limit_train_batches": 0.0}, "trainer.limit_train_batches=0: "),
        ({"limit_test_batches": 0}, "trainer.limit_test_batches=0: "),
        ({"limit_test_batches": 0.2}, "trainer.limit_test_batches=0.2: of 3 batches this is none"),
        ({"limit_test_batches": 0.4, "max_epochs": 3}, None),
        ({"limit_train_batches": 0.2}, "trainer.limit_train_batches=0.2: of 4 batches this is no"),
        ({"max_epochs": 2}, None),  # 8 batches: validated at the end
        ({"max_epochs": 1, "check_val_every_n_epoch": 1, "val_check_interval": 1.0}, None),
        ({**EVERY_SECOND, "max_epochs": 2}, None),
        ({**EVERY_SECOND, "max_epochs": 1}, "trainer.check_val_every_n_epoch=2: trainer.max_e"),
        ({**EVERY_SECOND, "max_steps": 7}, "trainer.check_val_every_n_epoch=2: an epoch has 4"),
        ({**EVERY_SECOND, "max_steps": 7, "limit_train_batches": 3}, None),
    ],
)
def test_a_training_without_a_validation_is_refused_before_it_begins(
    changed: dict[str, Any], told: str | None
) -> None:
    settings = {"check_val_every_n_epoch": None, "val_check_interval": 10, "max_steps": -1}
    settings |= {"accumulate_grad_batches": 1, "max_epochs": -1}
    settings |= dict.fromkeys(
        ("limit_train_batches", "limit_val_batches", "limit_test_batches"), 1.0
    )
    trainer = SimpleNamespace(**{**settings, **changed})
    data = SimpleNamespace(train_dataloader=lambda: range(4), test_dataloader=lambda: range(3))
    run: Any = SimpleNamespace(trainer=trainer, data=data)
    if told is None:
        check_validated(run)
        return
    with pytest.raises(UserError) as refusal:
        check_validated(run)
    assert str(refusal.value).startswith(told)
