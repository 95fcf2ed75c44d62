"""Scripts that are run from another folder, and jobs of a sweep that are resumed by themselves."""

from pathlib import Path

import pytest

from posefilter.cli.console import name_program
from posefilter.cli.folders import deciding


def test_a_script_is_named_by_the_path_that_was_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("train", "report"):
        (tmp_path / f"{name}.py").touch()
    monkeypatch.setattr("sys.argv", [str(tmp_path / "train.py")])
    assert name_program("report") == f"python {tmp_path / 'report.py'}"
    assert name_program("track") == "python track.py"  # there is none beside it
    monkeypatch.setattr("sys.argv", ["train.py"])
    assert name_program("report") == "python report.py"
    monkeypatch.setattr("sys.argv", ["/usr/bin/posefilter"])
    assert name_program("report") == "posefilter report"


def test_a_job_that_was_resumed_by_itself_is_still_its_sweeps() -> None:
    typed = ["model=patch_pf", "seed=1"]
    assert deciding([*typed, "resume=outputs/sweep/a", "plugins=[mine]"]) == deciding(typed)
    assert deciding([*typed, "loss=add"]) != deciding(typed)
