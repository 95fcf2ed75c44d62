"""The plan of runs behind the docs' tables: every job of it composes, and an evaluation waits for
its checkpoint.
"""

import importlib.util
import itertools
import os
import re
import sys
from pathlib import Path

import pytest

from posefilter.cli.command import compose_job

HOME = Path(__file__).parents[2]
NOT_SHOWN = {"held_out_less", "paper_longer", "patch"}  # single runs, in runs.csv alone
sys.path.insert(0, str(HOME / "bench"))  # scripts import their neighbors
spec = importlib.util.spec_from_file_location("methods", HOME / "bench" / "methods.py")
assert spec is not None
assert spec.loader is not None
methods = importlib.util.module_from_spec(spec)
spec.loader.exec_module(methods)


def jobs(words: str) -> list[tuple[str, ...]]:
    pairs = [word.split("=", 1) for word in words.split()]
    return list(
        itertools.product(
            *([f"{key}={x}" for x in methods.VALUES.split(values)] for key, values in pairs)
        )
    )


@pytest.mark.parametrize(
    "line",
    [line for line in methods.plan("DIR", "DIR") if line.of is None],
    ids=lambda line: line.words,
)
def test_every_line_composes(line, tmp_path: Path) -> None:
    every = jobs(line.words)
    for overrides in {every[0], every[-1]}:
        job = compose_job("train", HOME / "conf", list(overrides), tmp_path)
        assert job.cfg.seed in range(5)


def test_every_table_of_the_plan_has_its_place_in_the_docs() -> None:
    pages = "".join(page.read_text() for page in (HOME / "docs").rglob("*.md"))
    shown = set(re.findall(r"<!-- runs table=(\w+) ", pages))
    assert {line.table for line in methods.plan("DIR", "DIR")} - shown <= NOT_SHOWN


def test_an_evaluation_waits_for_its_checkpoint_and_is_not_done_twice(tmp_path: Path) -> None:
    swept = ("particles", "filter.particles=50,100", methods.HELD_OUT)
    (line,) = methods.vary_filter(*swept, ("patch_pf",))
    words = methods.command(line, tmp_path)
    assert words[:2] == ["evaluate.py", "-m"]
    assert "filter.particles=50,100" in words
    assert methods.waits(line, tmp_path)  # nothing was trained
    run = tmp_path / line.of
    (run / "checkpoints").mkdir(parents=True)
    (run / "metrics.json").write_text("{}")
    checkpoint = run / "checkpoints" / "best.ckpt"
    checkpoint.touch()
    assert not methods.waits(line, tmp_path)
    os.utime(checkpoint, (1, 1))
    points = [
        tmp_path / line.table / line.into / f"filter.particles={n}" / "metrics.json"
        for n in (50, 100)
    ]
    # cut short after the first, it goes on
    for point, waits in zip(points, (False, True), strict=True):
        point.parent.mkdir(parents=True)
        point.touch()
        assert methods.waits(line, tmp_path) is waits
    os.utime(checkpoint)
    os.utime(points[0], (1, 1))  # trained anew since
    assert not methods.waits(line, tmp_path)
