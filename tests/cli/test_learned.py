"""Scenes that a run has learned from are not tested on unawares."""

import json
import logging
from pathlib import Path

import pytest
from tests.data.dataset_trees import bop_scene, pose

from posefilter.cli import run_command
from posefilter.cli.learned import list_learned, warn_of_learned
from posefilter.cli.train import check_scenes
from posefilter.data.module import PoseDataModule
from posefilter.data.splits import find_learned
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]


def open_data(root: Path, split: dict[str, float] | None = None) -> PoseDataModule:
    """Return a dataset of BOP's layout, nothing of it decoded."""
    return PoseDataModule("bop", root, "obj_000002", split=split, workers=0, progress=False)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for scene in range(10):
        bop_scene(tmp_path / "data" / f"{scene:06d}", [[(2, pose())]])
    return tmp_path / "data"


def write_record(path: Path, data: PoseDataModule) -> dict[str, dict[str, int]]:
    split = data.split_record()
    path.write_text(json.dumps({"root": str(data.root), "split": split}))
    return split


def test_scenes_that_are_added_move_others_and_that_is_told(root: Path, tmp_path: Path) -> None:
    record = tmp_path / "data.json"
    before = write_record(record, open_data(root))
    assert list_learned(record, open_data(root)) == []
    check_scenes(record, open_data(root))
    for scene in range(10, 16):
        bop_scene(root / f"{scene:06d}", [[(2, pose())]])
    after = open_data(root)
    learned = list_learned(record, after)
    assert learned == sorted(
        {*before["train"], *before["val"]} & {*after.split_record()["test"]} - {*before["test"]}
    )
    assert learned  # else nothing was shown
    with pytest.raises(UserError, match=rf"{len(learned)} that it learned from would be tested on"):
        check_scenes(record, after)


def test_what_is_calibrated_on_was_not_learned(root: Path, tmp_path: Path) -> None:
    """That a checkpoint was chosen by a scene does no harm here; that it was learned does."""
    record = tmp_path / "data.json"
    shares = {"train": 0.5, "val": 0.4, "test": 0.1}
    before = write_record(record, open_data(root, shares))
    assert list_learned(record, open_data(root, shares), "val") == []
    moved = {"train": before["val"], "val": before["train"], "test": before["test"]}
    assert find_learned(before, moved, "val") == sorted(before["train"])
    tested = {"val": before["test"], "test": before["val"]}
    assert find_learned(before, tested, "val") == []
    for scene in range(10, 14):
        bop_scene(root / f"{scene:06d}", [[(2, pose())]])
    after = open_data(root, shares)
    learned = list_learned(record, after, "val")
    assert learned == sorted({*before["train"]} & {*after.split_record()["val"]})
    assert learned  # else nothing was shown


@pytest.mark.parametrize("named", ["run", "run/checkpoints/best.ckpt"])
def test_an_evaluation_warns_whether_a_run_or_its_checkpoint_is_named(
    named: str, root: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "best.ckpt").touch()
    write_record(tmp_path / "run" / "data.json", open_data(root))
    warn_of_learned(str(tmp_path / named), open_data(root, {"test": 1.0}), "rich")
    assert "were learned from by this run" in capfd.readouterr().out


def test_the_log_has_what_a_reader_notes_once(root: Path, caplog: pytest.LogCaptureFixture) -> None:
    data = open_data(root)
    with caplog.at_level(logging.WARNING):
        data.setup("validate")
        data.reader.notes["masks are split by geometry"] += 3
        data.setup("test")
        data.setup("test")
    noted = [text for text in caplog.messages if "by geometry" in text]
    assert noted == ["masks are split by geometry (3)"]


def test_a_test_of_everything_tests_what_was_learned(root: Path, tmp_path: Path) -> None:
    record = tmp_path / "data.json"
    before = write_record(record, open_data(root))
    assert list_learned(record, open_data(root, {"test": 1.0})) == sorted(
        {*before["train"], *before["val"]}
    )


def test_other_data_and_tests_of_memory_are_no_mistake(root: Path, tmp_path: Path) -> None:
    record = tmp_path / "data.json"
    write_record(record, open_data(root))
    bop_scene(tmp_path / "other" / "000001", [[(2, pose())]])
    assert list_learned(record, open_data(tmp_path / "other", {"test": 1.0})) == []
    assert list_learned(tmp_path / "none.json", open_data(root)) == []
    record.write_text('{"split": 3}')
    assert list_learned(record, open_data(root)) == []
    same = {"train": {"a": 1}, "test": {"a": 1}}
    assert find_learned(same, same) == []


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("+trainer.fast_dev_run=true", "trainer.fast_dev_run=True: writes no checkpoint"),
        ("+trainer.barebones=true", "trainer.barebones=True: writes no checkpoint"),
        ("+trainer.gradient_clip_algorithm=value", "are clipped by the norm of each network"),
        ("trainer.val_check_interval=0.5", "a share of an epoch needs trainer.check_val_every_n"),
        ("trainer.accumulate_grad_batches=2", "type +trainer.accumulate_grad_batches=..."),
        ("logger=false", "logger=false: choose csv, mlflow, none, tensorboard, wandb"),
    ],
)
def test_settings_of_the_trainer_that_cannot_be_are_told(
    typed: str, told: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["debug=smoke", "model=cnn_patch", f"out={tmp_path / 'run'}", typed]
    assert run_command("train", HOME, arguments) == 2
    error = capfd.readouterr().err.strip()
    assert told in error
    assert "\n" not in error


def test_known_settings_of_lightning_are_its_own() -> None:
    import inspect

    from lightning import Trainer

    from posefilter.cli.explain import LIGHTNINGS

    assert {*LIGHTNINGS} <= {*inspect.signature(Trainer.__init__).parameters}
