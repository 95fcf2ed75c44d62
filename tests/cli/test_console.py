"""What commands say: nothing where nobody watches, JSON to machines, and commands that can be typed
as they stand.
"""

import json
import math
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hydra.core.override_parser.overrides_parser import OverridesParser
from rich.progress import Progress

from posefilter.callbacks.time_budget import TimeBudget
from posefilter.cli.console import ended, logging_for, say, show_table, typed
from posefilter.cli.progress_bar import Bars, Lines, briefly, format_metrics, progress
from posefilter.cli.train import say_ended
from posefilter.progress import bars, watched

METRICS = {
    "train/loss": torch.tensor(1.25),
    "val/add/auc": torch.tensor(71.0),
    "val/by_visibility/0.3-0.5/iou": torch.tensor(1.0),
}


def test_bars_print_nothing_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """Not even the empty line that rich's own bar leaves there, which shows that this test can
    fail.
    """
    for shown in (True, False):
        with bars(shown=shown) as bar:
            bar.advance(bar.add_task("x", total=2))
    assert list(watched([1, 2, 3], 3, "x", True)) == [1, 2, 3]
    assert capsys.readouterr().out == ""
    with Progress():
        pass
    assert capsys.readouterr().out == "\n"


def test_bars_are_for_terminals(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert isinstance(progress("rich"), Lines)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert isinstance(progress("rich"), Bars)
    assert isinstance(progress("json"), Lines)


def test_a_bar_goes_on_where_nothing_is_logged() -> None:
    bars = Bars()
    trainer: Any = SimpleNamespace(
        global_step=1,
        max_steps=4,
        estimated_stepping_batches=4,
        callback_metrics=METRICS,
        log_every_n_steps=0,
    )
    module: Any = SimpleNamespace()
    bars.on_train_start(trainer, module)
    try:
        for trainer.global_step, said in ((2, ""), (4, briefly(METRICS))):
            bars.on_train_batch_end(trainer, module)
            (task,) = bars._shown().tasks
            assert (task.completed, task.fields["said"]) == (trainer.global_step, said)
    finally:
        bars.teardown()


def test_a_long_training_prints_its_progress(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One a pause, also where a validation spoke last; earlier validations' figures are not told
    again.
    """
    now = [0.0]
    monkeypatch.setattr("posefilter.cli.progress_bar.time.perf_counter", lambda: now[0])
    trainer: Any = SimpleNamespace(
        global_step=0,
        estimated_stepping_batches=40,
        callback_metrics=METRICS,
        sanity_checking=False,
    )
    lines, module = Lines(pause=60), SimpleNamespace()
    lines.on_train_start(trainer, module)  # type: ignore[arg-type]
    lines.on_train_batch_start(trainer, module)  # type: ignore[arg-type]
    for step, seconds in ((1, 30), (2, 61), (3, 100)):
        trainer.global_step, now[0] = step, seconds
        lines.on_train_batch_end(trainer, module)  # type: ignore[arg-type]
    assert capsys.readouterr().out == "step 2 of 40: loss 1.25, 0.03 steps/s, 19 min 19 s left\n"
    lines.on_validation_end(trainer, module)  # type: ignore[arg-type]
    now[0] = 159
    lines.on_train_batch_end(trainer, module)  # type: ignore[arg-type]
    assert capsys.readouterr().out.count("\n") == 1


@pytest.mark.parametrize(
    ("before", "spent", "left"),
    [(0.0, 0.25, "3 min 0 s left"), (0.5, 0.75, "1 min 0 s left"), (0.0, 0.05, "9 min 0 s left")],
)
def test_the_time_left_is_that_of_a_time_budget_which_ends_the_training_sooner(
    before: float,
    spent: float,
    left: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """After 60 s and a tenth of the steps; the budget's share is known once the training began, and
    part of it may be of an earlier sitting.
    """
    now = [0.0]
    monkeypatch.setattr("posefilter.cli.progress_bar.time.perf_counter", lambda: now[0])
    trainer: Any = SimpleNamespace(
        global_step=0,
        estimated_stepping_batches=100,
        callback_metrics={},
        sanity_checking=False,
    )
    lines, module = Lines(pause=60), SimpleNamespace(time_spent=0.0)
    lines.on_train_start(trainer, module)  # type: ignore[arg-type]
    module.time_spent = before
    lines.on_train_batch_start(trainer, module)  # type: ignore[arg-type]
    trainer.global_step, now[0], module.time_spent = 10, 60, spent
    lines.on_train_batch_end(trainer, module)  # type: ignore[arg-type]
    assert capsys.readouterr().out == f"step 10 of 100: 0.17 steps/s, {left}\n"


def test_a_long_test_prints_its_progress(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [1000.0]
    monkeypatch.setattr("posefilter.cli.progress_bar.time.perf_counter", lambda: now[0])
    trainer: Any = SimpleNamespace(num_test_batches=[30])
    lines, module = Lines(pause=60), SimpleNamespace()
    lines.on_test_start(trainer, module)  # type: ignore[arg-type]
    for batch in range(10):
        now[0] += 30
        lines.on_test_batch_end(trainer, module, None, None, batch)  # type: ignore[arg-type]
    told_at = [line.split(":")[0] for line in capsys.readouterr().out.splitlines()]
    assert told_at == [f"batch {done} of 30" for done in (2, 4, 6, 8, 10)]


@pytest.mark.parametrize("console", ["rich", "json"])
def test_a_validation_is_one_line(console: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Words for people, numbers for machines; parts of the images are in the log alone."""
    trainer: Any = SimpleNamespace(
        global_step=10,
        estimated_stepping_batches=40,
        callback_metrics=METRICS,
        sanity_checking=False,
    )
    lines, module = Lines(console), SimpleNamespace()
    lines.on_train_start(trainer, module)  # type: ignore[arg-type]
    lines.on_train_batch_start(trainer, module)  # type: ignore[arg-type]
    trainer.global_step = 20
    lines.on_validation_end(trainer, module)  # type: ignore[arg-type]
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    if console == "rich":
        assert out.startswith("step 20 of 40: loss 1.25, ADD AUC 71.0, ")
        assert out.endswith(" left\n")
    else:
        said = json.loads(out)
        assert said["step"] == 20
        assert said["val/add/auc"] == 71.0
        assert not any("by_visibility" in name for name in said)


@pytest.mark.parametrize(
    ("max_steps", "expected", "told"), [(-1, 40, "step 20 of 40: "), (-1, math.inf, "step 20: ")]
)
def test_a_training_by_epochs_or_by_the_clock_has_no_steps_below_zero(
    max_steps: int, expected: float, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer: Any = SimpleNamespace(
        global_step=20,
        max_steps=max_steps,
        estimated_stepping_batches=expected,
        callback_metrics=METRICS,
        sanity_checking=False,
    )
    lines, module = Lines(), SimpleNamespace()
    lines.on_train_start(trainer, module)  # type: ignore[arg-type]
    lines.on_validation_end(trainer, module)  # type: ignore[arg-type]
    assert capsys.readouterr().out.startswith(told)


@pytest.mark.parametrize(
    ("step", "steps", "is_budget_up", "said"),
    [
        (2, 5, None, "ended at step 2 of 5, by a callback or trainer.max_time\n"),
        (2, 5, False, "ended at step 2 of 5, by a callback or trainer.max_time\n"),
        (2, 5, True, ""),
        (5, 5, None, ""),
        (2, math.inf, None, ""),  # whose end is no step
    ],
)
def test_a_training_that_ends_early_says_so(
    step: int,
    steps: float,
    is_budget_up: bool | None,
    said: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Unless by its time budget, as it was asked to."""
    callbacks = [] if is_budget_up is None else [TimeBudget(9.0)]
    for budget in callbacks:
        budget.ended = bool(is_budget_up)
    trainer = SimpleNamespace(
        global_step=step, estimated_stepping_batches=steps, callbacks=callbacks
    )
    job = SimpleNamespace(cfg=SimpleNamespace(console="rich"))
    run: Any = SimpleNamespace(trainer=trainer, job=job)
    say_ended(run)
    assert capsys.readouterr().out == said


def test_the_end_says_where_and_what_next(capsys: pytest.CaptureFixture[str]) -> None:
    """For machines one JSON object in which what is no number is null; for people every path, whole
    and unbroken.
    """
    long = Path("outputs") / ("x" * 150) / "[bold]"
    ended("json", "done", {"run": long}, ["python report.py"], score=float("nan"), best=1.5)
    expected = {
        "event": "done",
        "score": None,
        "best": 1.5,
        "files": {"run": str(long)},
        "next": ["python report.py"],
    }
    assert json.loads(capsys.readouterr().out) == expected
    ended("rich", "done", {"run": long}, ["python report.py"])
    out = capsys.readouterr().out
    assert str(long) in out
    assert "\nnext\n  python report.py\n" in out
    say("rich", "event", "a sentence", number=1)
    assert capsys.readouterr().out == "a sentence\n"


@pytest.mark.parametrize(
    "value", ["a/b", "a b", "x/filter.particles=8,model=y/best.ckpt", "it's", "a(b)", "1.5", "a$b"]
)
def test_commands_can_be_typed_as_they_stand(value: str) -> None:
    """The shell and Hydra give back what was meant: also of a sweep's folders, that are full of
    signs.
    """
    words = shlex.split(typed("train", data__root=value))
    assert words[:2] == ["python", "train.py"]
    override = OverridesParser.create().parse_override(words[2])
    assert override.key_or_group == "data.root"
    assert not override.is_sweep_override()
    assert str(override.value()) == value


def test_words_and_hydras_own_log() -> None:
    assert format_metrics(METRICS) == "loss 1.25, ADD AUC 71.0"
    assert (
        briefly({"train/loss": 2.0, "val/particles_on_object": 0.5, "val/iou": 1.0})
        == "loss 2, on object 50.0 %"
    )
    assert logging_for(["console=rich"]) == []
    assert len(logging_for(["model=x", "console=json"])) == 1


def test_a_title_is_not_cut_where_its_table_is_narrower(capsys) -> None:
    show_table("rich", "003_cracker_box", [("frames", "1"), ("lost", "0")])
    assert capsys.readouterr().out.splitlines()[0].rstrip() == "003_cracker_box"
    path = "outputs/runs/" + "2026-01-01_a_run_of_a_long_name/" * 5 + "checkpoints/best.ckpt"
    show_table("rich", path, [("frames", "1")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].rstrip() == path
    assert len(lines[1]) < 30
