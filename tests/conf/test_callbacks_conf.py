"""One line of config switches the looking off; runs are told apart by their choices and
settings.
"""

from pathlib import Path

from lightning.pytorch.callbacks import Checkpoint

from posefilter.callbacks.figures import Figures
from posefilter.callbacks.tensorboard_layout import TensorBoardLayout
from posefilter.cli.best import Best, Last
from posefilter.cli.build import build_trainer
from posefilter.cli.command import compose_job
from posefilter.cli.comparing import comparable
from posefilter.cli.job import Job

CONF = Path(__file__).parents[2] / "conf"


def compose(folder: Path, *overrides: str) -> Job:
    return compose_job(
        "train",
        CONF,
        ["console=json", "logger=none", "trainer.accelerator=cpu", *overrides],
        folder,
    )


def kinds(job: Job) -> list[type]:
    trainer = build_trainer(job)
    return [type(callback) for callback in trainer.callbacks]  # type: ignore[attr-defined]


def test_no_callbacks_are_left_but_the_checkpoints(tmp_path: Path) -> None:
    usual, none = kinds(compose(tmp_path)), kinds(compose(tmp_path, "callbacks=checkpoints"))
    assert Figures in usual
    assert [kind for kind in none if issubclass(kind, Checkpoint)] == [Best, Last]
    assert none.count(Best) == usual.count(Best) == 1
    assert not [kind for kind in none if kind.__module__.startswith("posefilter.callbacks")]


def test_a_single_figure_is_switched_off_by_its_name(tmp_path: Path) -> None:
    trainer = build_trainer(compose(tmp_path, "callbacks.figures.exclude=[animation]"))
    (figures,) = [c for c in trainer.callbacks if isinstance(c, Figures)]  # type: ignore[attr-defined]
    assert "animation" not in figures.drawings
    assert "belief" in figures.drawings


def test_runs_are_distinguished_by_choices_and_settings_not_by_their_folder(tmp_path: Path) -> None:
    job = compose(
        tmp_path, "filter/refine=none", "filter.particles=50", f"out={tmp_path}", "seed=3"
    )
    settings = comparable(job)
    assert settings["filter/refine"] == "none"
    assert settings["filter.particles"] == 50
    assert settings["seed"] == 3
    assert "model.filter" not in settings  # it repeats the section `filter`
    assert not [
        key
        for key in settings
        if key.split(".")[0] in ("out", "folder", "callbacks", "logger", "console")
    ]
    assert not [value for value in settings.values() if isinstance(value, str) and "${" in value]
    (layout,) = [c for c in build_trainer(job).callbacks if isinstance(c, TensorBoardLayout)]  # type: ignore[attr-defined]
    assert layout.settings == settings
