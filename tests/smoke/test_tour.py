"""docs/tour.md does what it says: its commands run one after the other, and leave the files that it
speaks of.
"""

import json
import re
from pathlib import Path

import pytest
from docs.run_tour import HOME, PAGE, call, commands, go_on, settings
from tests.smoke.conftest import SMALL_POSE_PF

from posefilter.data.splits import split_records

TOY = {  # what is added to each command so that all of them together take less than a minute
    "generate": [
        "frames=24",
        "frames_per_scene=4",
        "size=[160,120]",
        "distractors=[1,2]",
        "workers=1",
    ],
    "check_data": ["max_frames=3"],
    "train": [
        "debug=smoke",
        "threads=1",
        "trainer.max_steps=2",
        "trainer.val_check_interval=2",
        "data.limit_test=2",
        *SMALL_POSE_PF,
    ],
    "predict": ["threads=1"],
}


def test_five_commands_and_their_pictures() -> None:
    """From a mesh to a belief in five; each has its picture."""
    text = PAGE.read_text()
    assert [words[1] for words in commands(text)[1:]] == [
        "generate.py", "check_data.py", "train.py", "report.py", "predict.py",
    ]  # fmt: skip
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(pictures) == 5
    for picture in pictures:
        assert (PAGE.parent / picture).stat().st_size < 300_000, picture


def test_the_image_at_the_end_was_held_out() -> None:
    """At the size that the page gives, the split keeps its scene for the test."""
    _, generate, _, train, _, predict = map(settings, commands(PAGE.read_text()))
    scenes = int(generate["frames"]) // int(generate["frames_per_scene"])
    assert not any(key.startswith("data.split") for key in train)

    class Record:
        def __init__(self, number: int) -> None:
            self.group = f"scene{number:04d}_0"

    records = [Record(i) for i in range(scenes)]
    held_out = split_records(records, {"train": 0.8, "val": 0.1, "test": 0.1}, 0, HOME)["test"]  # type: ignore[arg-type]
    assert Path(predict["rgb"]).parent.name in {records[i].group for i in held_out}


@pytest.mark.slow
def test_the_tour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every command ends well at toy size, and every file that the page names is there."""
    monkeypatch.chdir(tmp_path)
    text = PAGE.read_text()
    for words in commands(text):
        assert call(words, TOY) == 0, (words, capfd.readouterr().err)
    named = set(re.findall(r"`(outputs/tour/[^`]*)`", text))
    assert len(named) >= 6
    for path in named:
        assert (tmp_path / path).is_file(), path
    assert (
        json.loads((tmp_path / "outputs/tour/prediction/pose.json").read_text())["object"] == "duck"
    )


def test_a_second_tour_goes_on_with_the_first(tmp_path: Path) -> None:
    """A run's folder is protected, so that the same command would be refused."""
    every = commands(PAGE.read_text())
    assert [go_on(words, tmp_path) for words in every] == every
    run = tmp_path / "outputs" / "tour" / "run"
    (run / "checkpoints").mkdir(parents=True)
    again = [go_on(words, tmp_path) for words in every]
    assert [a for a, b in zip(again, every, strict=True) if a != b] == [
        ["python", "train.py", "resume=outputs/tour/run"]
    ]
    (run / "metrics.json").write_text("{}")
    assert [go_on(words, tmp_path) for words in every].count([]) == 1


def test_a_command_that_breaks_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A setting that is no more, as after a change of the code that forgot the page."""
    monkeypatch.chdir(tmp_path)
    assert call(["python", "check_data.py", "data=fat", "data.roots=x"], {}) == 2
