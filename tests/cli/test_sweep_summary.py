"""What a sweep writes when its jobs have ended: rows and pictures in the order in which one reads
them.
"""

import csv
import json
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from omegaconf import OmegaConf

from posefilter.cli import run_command
from posefilter.cli.folders import note_failure
from posefilter.cli.job import Job as Run
from posefilter.cli.sweeps import SweepSummary, list_rows, summarize
from posefilter.errors import Carrier
from posefilter.metrics.registry import PERCENT
from posefilter.report.sweep_charts import draw_summary
from posefilter.report.sweeps import Job, Sweep, read_sweep

HOME = Path(__file__).parents[2]


def sweep(folder: Path, key: str, words: list[str]) -> Path:
    """Write a sweep's folder whose jobs ended in another order than they were asked for in."""
    (folder / "multirun.yaml").write_text(
        f"hydra:\n  sweeper:\n    params:\n      {key}: {','.join(words)}\n"
    )
    for place, word in reversed(list(enumerate(words))):
        run = folder / f"{key}={word}"
        run.mkdir()
        own = {
            "overrides": [f"{key}={word}"],
            "particles_on_object": place / 10,
            "seconds_per_image": 0.1,
        }
        (run / "metrics.json").write_text(json.dumps(own))
    return folder


def draw(sweep: Sweep) -> Figure:
    """Draw a sweep of several values."""
    figure = draw_summary(sweep)
    assert figure is not None
    return figure


def title(figure: Figure) -> str:
    """Return the figure's title."""
    return str(figure.get_suptitle())


def test_ablations_are_in_the_order_of_the_table(tmp_path: Path) -> None:
    ablations = ["paper", "s1_glimpse", "c1_normalization", "c10_resample", "working"]
    summarize(sweep(tmp_path, "ablation", ablations))
    with (tmp_path / "summary.csv").open() as file:
        assert [row["ablation"] for row in csv.DictReader(file)] == ablations
    panel = draw(read_sweep(tmp_path)).axes[0]
    assert [text.get_text() for text in panel.get_yticklabels()] == ablations
    assert panel.yaxis_inverted(), "from the top"
    assert panel.lines[0].get_xdata() == pytest.approx([10 * place for place in range(5)])  # [%]


def test_a_sweep_fails_by_its_own_jobs_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What an earlier start in the folder has left is listed, and no failure of this one."""
    bad, good = tmp_path / "seed=x", tmp_path / "seed=1"
    for job in (bad, good):
        job.mkdir()
    note = json.dumps({"overrides": ["seed=x"], "error": "no number"})
    (bad / "failed.json").write_text(note)
    config = OmegaConf.create({"console": "json", "hydra": {"sweep": {"dir": str(tmp_path)}}})
    summary = SweepSummary()
    summary.on_multirun_start(config)
    (good / "metrics.json").write_text(json.dumps({"overrides": ["seed=1"], "iou": 0.5}))
    summary.on_multirun_end(config)
    assert json.loads(capsys.readouterr().out)["failed"] == []
    assert "no number" in (tmp_path / "summary.md").read_text()

    (bad / "failed.json").write_text(note)  # again
    with pytest.raises(Carrier, match="1 of 2 jobs failed"):
        summary.on_multirun_end(config)
    assert json.loads(capsys.readouterr().out)["failed"] == ["seed=x"]


def test_numbers_are_read_by_size(tmp_path: Path) -> None:
    summarize(sweep(tmp_path, "filter.particles", ["1000", "50", "100"]))
    rows = list_rows(read_sweep(tmp_path))
    assert [row["filter.particles"] for row in rows] == [50, 100, 1000]
    assert draw(read_sweep(tmp_path)).axes[0].get_xscale() == "log"


def test_an_axis_has_the_tried_values_and_a_share_its_whole_range(tmp_path: Path) -> None:
    """So that figures of several sweeps can be compared, and a value is read where it was tried."""
    summarize(sweep(tmp_path, "filter.steps", ["3", "10", "7"]))
    panel = draw(read_sweep(tmp_path)).axes[0]
    assert [text.get_text() for text in panel.get_xticklabels()] == ["3", "7", "10"]
    assert panel.get_ylim() == pytest.approx(PERCENT)
    assert panel.get_title(loc="left") == "particles on the object [%]"


@pytest.mark.parametrize("words", [["1", "2"], ["a", "b"]])
def test_one_seed_is_no_trend(tmp_path: Path, words: list[str]) -> None:
    """Nothing is joined, and the title says why; with two seeds the means are."""
    values = [float(word) if word in "12" else word for word in words]
    jobs = [
        Job({"filter": x}, {"add/auc": 50.0}, word) for x, word in zip(values, words, strict=True)
    ]
    once = draw(Sweep(tmp_path, ["filter"], jobs, []))
    assert "one seed each" in title(once)
    assert [line.get_linestyle() for line in once.axes[0].lines] == ["None"]
    assert not once.axes[0].collections
    first = [job._replace(place={**job.place, "seed": 0}) for job in jobs]
    second = [Job({**job.place, "seed": 1}, {"add/auc": 70.0}, job.folder) for job in jobs]
    twice = draw(Sweep(tmp_path, ["filter", "seed"], [*first, *second], []))
    assert "one seed" not in title(twice)
    panel = twice.axes[0]
    assert panel.collections, "the range over seeds"
    means = panel.lines[-1].get_xdata() if words == ["a", "b"] else panel.lines[0].get_ydata()
    assert means == pytest.approx([60.0, 60.0])


def test_nothing_to_compare_is_no_figure(tmp_path: Path) -> None:
    assert draw_summary(Sweep(tmp_path, [], [Job({}, {"add/auc": 50.0}, "a")], [])) is None


def test_a_job_that_was_started_again_meanwhile_has_not_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The second start is refused, and notes that down in the folder that the first one holds."""

    def end(job: Run) -> float:
        note_failure(job, "is in use by another run")
        metrics = {"overrides": job.overrides, "iou": 0.5}
        (job.folder / "metrics.json").write_text(json.dumps(metrics))
        return 0.5

    monkeypatch.setattr("posefilter.cli.train.train", end)
    monkeypatch.setattr("posefilter.cli.running.check_files", lambda name, cfg: None)
    words = ["-m", "seed=1,2", "logger=none", "console=json", f"out={tmp_path}"]
    assert run_command("train", HOME, words) == 0
    assert json.loads(capfd.readouterr().out.splitlines()[-1])["failed"] == []
    assert not [*tmp_path.rglob("failed.json")]
    assert len(read_sweep(tmp_path).jobs) == 2


def test_the_legend_lies_beside_the_data(tmp_path: Path) -> None:
    """Lines at the top and at the bottom leave no room within the axes."""
    jobs = [
        Job({"steps": n, "refine": kind, "seed": s}, {"add/auc": auc + s}, f"{n}{kind}{s}")
        for n in (1, 2, 3)
        for kind, auc in (("none", 2.0), ("gradient", 50.0), ("icp", 97.0))
        for s in (0, 1)
    ]
    figure = draw(Sweep(tmp_path, ["steps", "refine", "seed"], jobs, []))
    figure.canvas.draw()
    legends = [legend for part in figure.subfigs for legend in part.legends]
    assert [text.get_text() for text in legends[0].get_texts()] == [
        f"refine={kind}" for kind in ("none", "gradient", "icp")
    ]
    for legend in legends:
        area = legend.get_window_extent()
        assert not any(area.overlaps(axes.get_tightbbox()) for axes in figure.axes)
    assert not any(axes.get_legend() for axes in figure.axes)


def test_an_error_stays_in_its_cell(tmp_path: Path) -> None:
    (tmp_path / "seed=1").mkdir()
    note = {"overrides": ["seed=1"], "error": "give data=fat|bop\nand data.root=DIR"}
    (tmp_path / "seed=1" / "failed.json").write_text(json.dumps(note))
    summarize(tmp_path)
    *_, row = (tmp_path / "summary.md").read_text().splitlines()
    assert row == r"| give data=fat\|bop and data.root=DIR |"
