"""What a sweep writes when its jobs have ended: rows and pictures in the order in which one reads them."""

import csv
import json
from pathlib import Path

import pytest

from posefilter.run.sweeps import draw, read_rows, summarise


def sweep(folder: Path, key: str, words: list[str]) -> Path:
    """Write a sweep's folder whose jobs ended in another order than they were asked for in."""
    (folder / "multirun.yaml").write_text(f"hydra:\n  sweeper:\n    params:\n      {key}: {','.join(words)}\n")
    for place, word in reversed(list(enumerate(words))):
        run = folder / f"{key}={word}"
        run.mkdir()
        own = {"overrides": [f"{key}={word}"], "particles_on_object": place / 10, "seconds_per_image": 0.1}
        (run / "metrics.json").write_text(json.dumps(own))
    return folder


def test_a_ladder_is_read_as_one_climbs_it(tmp_path: Path) -> None:
    rungs = ["paper", "s1_glimpse", "c1_normalisation", "c10_resample", "working"]
    summarise(sweep(tmp_path, "rung", rungs))
    with (tmp_path / "summary.csv").open() as file:
        assert [row["rung"] for row in csv.DictReader(file)] == rungs
    panel = draw(*read_rows(tmp_path)).axes[0]
    assert [text.get_text() for text in panel.get_yticklabels()] == rungs
    assert panel.yaxis_inverted(), "from the top"
    assert [bar.get_width() for bar in panel.patches] == pytest.approx([place / 10 for place in range(5)])


def test_numbers_are_read_by_size(tmp_path: Path) -> None:
    summarise(sweep(tmp_path, "filter.particles", ["1000", "50", "100"]))
    rows, _ = read_rows(tmp_path)
    assert [row["filter.particles"] for row in rows] == [50, 100, 1000]
    assert draw(*read_rows(tmp_path)).axes[0].get_xscale() == "log"
