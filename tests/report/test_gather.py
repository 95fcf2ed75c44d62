"""What is read from a run's folder, and what is said where something is not there."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from torch.utils.tensorboard import SummaryWriter

from posefilter.errors import UserError
from posefilter.report.diagnostics import (
    collect_numbers,
    collect_timings,
    diagnose,
    format_duration,
)
from posefilter.report.events import Curve, drop_repeats, list_starts, rename_losses
from posefilter.report.gather import read_run
from posefilter.report.images import group_by_section, sort_by_number
from posefilter.report.settings import Change, compare_settings


def test_losses_of_earlier_runs_get_todays_names() -> None:
    one, two, three, four, five = (Curve((i,), (float(i),), (0.0,)) for i in range(5))
    old = {"train/total": one, "train/loss": two, "train/pose": three, "val/score": four}
    old |= {"train/coordinate_error_mm": five, "train/learning_rate": one}
    new = rename_losses(old)
    assert new == {
        "train/loss": one,
        "train/loss_main": two,
        "train/loss_pose": three,
        "val/score": four,
        "train/coordinate_error_mm": five,
        "train/learning_rate": one,
    }
    assert rename_losses(new) == new


def test_numbers_of_earlier_runs_get_todays_names(run: Path) -> None:
    """In their metrics.json, and in events, which a later version may have gone on with."""
    file = run / "metrics.json"
    file.write_text(file.read_text().replace("distance_coverage_", "coverage_"))
    assert "distance_coverage" not in file.read_text()
    assert "coverage_90" in json.loads(file.read_text())["belief"]
    with SummaryWriter(str(run)) as log:
        log.add_scalar("val/belief/coverage_90", 30.0, 49, walltime=1030.0)
        log.add_scalar("val/belief/distance_coverage_90", 35.0, 99, walltime=1060.0)
    record = read_run(run)
    assert collect_numbers(record)["belief/distance_coverage_90"] == 41.0
    assert "belief/coverage_90" not in collect_numbers(record)
    assert record.curves["val/belief/distance_coverage_90"].values == (30.0, 35.0)
    assert "val/belief/coverage_90" not in record.curves
    with SummaryWriter(str(run)) as log:
        log.add_scalar("train/loss_chosen", 2.0, 49, walltime=1030.0)
        log.add_scalar("train/loss_main", 1.0, 99, walltime=1060.0)
    assert read_run(run).curves["train/loss_main"].values == (2.0, 1.0)
    file.unlink()
    assert collect_numbers(read_run(run))["belief/distance_coverage_90"] == 35.0


def test_scalars_and_pictures_are_read(run: Path) -> None:
    """Every scalar at its step; a logged picture only where no file shows it; 2 before 10."""
    record = read_run(run)
    assert record.curves["val/score"].steps == (49, 99)
    assert record.curves["val/score"].values == (60.0, 40.0)
    assert len(record.curves["train/loss"].values) == 10
    shown = group_by_section(record.pictures)
    assert [p.name for p in shown["worst"]] == ["worst_2", "worst_10"]
    assert [p.name for p in shown["overlays"]] == ["validation_overlays"]
    assert [p.name for p in shown["belief"]] == ["3_belief/belief"]
    assert record.missing == ["No errors.csv: what the test found in single images is not known."]
    assert sorted(["a10", "a9", "b1"], key=sort_by_number) == ["a9", "a10", "b1"]
    assert sorted(["1²2", "1²", "a"], key=sort_by_number)  # ² is a digit, and no number


def test_a_resumed_run_is_one_curve() -> None:
    """What was logged beyond the checkpoint that a run went on from is void, in whatever order the
    files are read.
    """
    first = [(step, 1.0, 10.0 + step) for step in (0, 10, 20, 30)]
    resumed = [(step, 2.0, 100.0 + step) for step in (15, 25)]
    assert drop_repeats([*resumed, *first]).steps == (0, 10, 15, 25)
    assert drop_repeats([*first, *resumed]).values == (1.0, 1.0, 2.0, 2.0)


def test_diagnostics_are_found(run: Path) -> None:
    """Those beyond their limits, and no others."""
    found = {
        finding.diagnostic.key: (finding.value, finding.bad) for finding in diagnose(read_run(run))
    }
    assert found["diagnostics/pairwise_cosine"] == (0.95, True)
    assert found["diagnostics/off_frame/last"] == (0.625, True)  # the last step's
    assert found["diagnostics/offset_r2"] == (0.5, False)
    assert found["missed_fraction"] == (0.25, True)
    assert found["belief/distance_coverage_90"] == (41.0, True)
    assert found["val_score_drop"] == (20.0, True)
    assert found["particles_on_object"] == (0.75, False)
    assert "diagnostics/auroc" not in found


def test_diagnostics_of_before_have_todays_names(run: Path) -> None:
    path = run / "metrics.json"
    metrics = json.loads(path.read_text())
    metrics["diagnostics"] |= {"heading": 0.1, "line_share": [0.6, 0.9]}
    metrics["apparent_size"] = {"images": 5, "ratio": 1.25, "contradicting": 4}
    path.write_text(json.dumps(metrics))
    found = collect_numbers(read_run(run))
    assert found["diagnostics/offset_cosine"] == 0.1
    assert found["diagnostics/first_axis_share/last"] == 0.9
    assert found["scale_ratio/ratio"] == 1.25
    assert not [key for key in found if "heading" in key or "line" in key or "apparent" in key]


def test_timings(run: Path) -> None:
    """Two steps a second, as the events' times have it."""
    told = dict(collect_timings(read_run(run)))
    assert told["training steps a second (median)"] == "2.00"
    assert told["training, validations included"] == "45 s"
    assert [format_duration(s) for s in (59.6, 61, 3700)] == ["1 min 0 s", "1 min 1 s", "1 h 1 min"]


def test_without_a_test_the_last_validation_counts(run: Path) -> None:
    """Numbers are then of the last validation, and it is said."""
    (run / "metrics.json").unlink()
    record = read_run(run)
    assert collect_numbers(record)["add/auc"] == 40.0
    assert any("metrics.json" in sentence for sentence in record.missing)


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ("figures", "pictures"),
        ("events", "events"),
        (".hydra", ".hydra"),
        ("data.json", "data.json"),
    ],
)
def test_missing_pieces_are_named(run: Path, gone: str, said: str) -> None:
    """A run that lacks a piece is read none the less."""
    for path in [*run.glob("events.*")] if gone in ("events", "figures") else [run / gone]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    if gone == "figures":
        shutil.rmtree(run / "figures")
    assert any(said in sentence for sentence in read_run(run).missing)


def test_mistakes_are_one_line(run: Path, sweep: Path, tmp_path: Path) -> None:
    """No folder, no run, a sweep, a broken file: each names the folder and the cause."""
    (tmp_path / "empty").mkdir()
    for folder, cause in (
        (tmp_path / "nowhere", "no such folder"),
        (tmp_path / "empty", "no run's folder"),
        (sweep, "sweep="),
    ):
        with pytest.raises(UserError, match=cause) as caught:
            read_run(folder)
        assert str(folder) in str(caught.value)
        assert "\n" not in str(caught.value)
    (run / "metrics.json").write_text('{"add": ')
    with pytest.raises(UserError, match=r"metrics\.json: not readable as JSON"):
        read_run(run)


def test_settings_that_differ() -> None:
    """By dotted key, lists of sections item by item; where a run was made does not count."""
    default = {"seed": 0, "a": {"b": 1, "gone": 2}, "steps": [{"x": 1}, {"x": 2}], "out": None}
    own = {"seed": 0, "a": {"b": 1.5, "new": "text"}, "steps": [{"x": 1}, {"x": 3}], "out": "there"}
    assert compare_settings(own, default) == [
        Change("a.b", "1", "1.5"),
        Change("a.new", None, "text"),
        Change("steps.1.x", "2", "3"),
        Change("a.gone", "2", None),
    ]
    assert compare_settings(default, default) == []


def test_credible_sets_that_are_too_small_are_a_sign_of_failure(run: Path) -> None:
    """Where the distances from the mean alone look calibrated."""
    file = run / "metrics.json"
    metrics = json.loads(file.read_text())
    metrics["belief"]["distance_coverage_90"] = 92.0
    for coverage, bad in ((33.0, True), (88.0, False)):
        metrics["credibility"] = {"coverage_90": coverage}
        file.write_text(json.dumps(metrics))
        found = {one.diagnostic.key: one.bad for one in diagnose(read_run(run))}
        assert found["credibility/coverage_90"] == bad
        assert not found["belief/distance_coverage_90"]


def test_a_pause_before_a_run_went_on_is_no_training_time(run: Path) -> None:
    record = read_run(run)
    curve = record.curves["train/loss"]
    before, gap = len(curve.times) // 2, 3 * 24 * 3600.0
    times = tuple(t + gap * (n >= before) for n, t in enumerate(curve.times))
    late = replace(record, curves={**record.curves, "train/loss": curve._replace(times=times)})
    assert dict(collect_timings(late))["training, validations included"].startswith("72 h")
    # its second event file was begun half a second before the next entry, 5 s after the last
    known = replace(late, starts=[curve.times[0] - 1, times[before] - 0.5])
    assert dict(collect_timings(known))["training, validations included"] == "40 s"


def test_event_files_say_when_they_were_begun(tmp_path: Path) -> None:
    for name in ("1700000500.pc.1.0", "1700000000.my.host.2.0", "odd"):
        (tmp_path / f"events.out.tfevents.{name}").touch()
    assert list_starts(tmp_path) == [1700000000.0, 1700000500.0]


def test_a_symmetric_object_is_not_judged_by_a_distance_that_knows_no_symmetry(run: Path) -> None:
    file = run / "metrics.json"
    metrics = json.loads(file.read_text())
    metrics["belief"]["distance_coverage_90"] = 1.5
    for auc, judged in ((metrics["add"]["auc"], True), (99.0, False)):
        metrics["add_up_to_symmetry"] = {"auc": auc}
        file.write_text(json.dumps(metrics))
        keys = {one.diagnostic.key for one in diagnose(read_run(run))}
        assert ("belief/distance_coverage_90" in keys) == judged


def test_tracks_are_no_run(tmp_path: Path) -> None:
    for name in ("metrics.json", "tracks.csv"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(UserError, match=r"holds tracks of track\.py"):
        read_run(tmp_path)
