"""How a sweep's runs are grouped, ordered and summed up."""

import json
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
import yaml

from posefilter.errors import UserError
from posefilter.metrics.image_errors import FILE, ImageError, write_errors
from posefilter.metrics.registry import find_metric
from posefilter.report.gather import read_run
from posefilter.report.sweep_charts import chart_against_time, chart_over, draw_summary, name_axis
from posefilter.report.sweep_page import (
    format_mean,
    format_spread,
    head_lines,
    list_notes,
    make_sweep_page,
)
from posefilter.report.sweeps import (
    Group,
    Job,
    Sweep,
    find_best_group,
    find_best_job,
    find_ties,
    group_jobs,
    read_sweep,
)


def test_axes_groups_and_best(sweep: Path) -> None:
    """Runs that differ in their seed are one group; numbers are sorted by size, names as they were
    asked for.
    """
    found = read_sweep(sweep)
    assert found.axes == ["filter.particles", "refine", "seed"]  # `out` differs too, and is none
    assert found.shown == ["filter.particles", "refine"]
    assert [tuple(group.place.values()) for group in group_jobs(found)] == [
        (50, "none"),
        (50, "gradient"),
        (1000, "none"),
        (1000, "gradient"),
    ]
    assert [len(group.jobs) for group in group_jobs(found)] == [3, 3, 2, 3]
    assert found.unfinished == ["filter.particles=1000,refine=none,seed=2"]
    assert find_best_job(found).place == {"filter.particles": 1000, "refine": "gradient", "seed": 2}
    assert find_best_group(group_jobs(found)) == 3


def test_panels_hold_means_and_ranges(sweep: Path) -> None:
    """Over the particles, a line a refinement, with the seeds' range about it."""
    found = read_sweep(sweep)
    panel = chart_over("filter.particles", found, group_jobs(found), [find_metric("add/auc")])[0]
    none, gradient = panel.lines
    assert none.label == "refine=none"
    assert list(gradient.x) == [50.0, 1000.0]
    assert list(gradient.y) == pytest.approx([70.5 + 1 / 3, 80 + 1 / 3])
    assert list(gradient.low) == pytest.approx([68.5, 78.0])
    assert list(gradient.high) == pytest.approx([73.5, 83.0])
    assert panel.log_x
    assert chart_over("refine", found, group_jobs(found), [find_metric("add/auc")])[
        0
    ].categories == ["none", "gradient"]


def test_charts_name_the_settings_that_they_take_the_mean_over(tmp_path: Path) -> None:
    axes = ["steps", "loss", "model", "seed"]
    places = list(product((5, 10), ("bce", "focal"), ("a", "b"), (0, 1)))
    jobs = [
        Job(dict(zip(axes, place, strict=True)), {"add/auc": float(i)}, str(i))
        for i, place in enumerate(places)
    ]
    found = Sweep(tmp_path, axes, jobs, [])
    (panel,) = chart_over("steps", found, group_jobs(found), [find_metric("add/auc")])
    assert [line.label for line in panel.lines] == ["loss=bce", "loss=focal"]
    assert list(panel.lines[0].y) == [1.5, 9.5]  # of both models and seeds
    assert panel.xlabel == "steps (mean over model)"
    assert "model (mean over loss)" in make_sweep_page(found, None, None, "").render()
    two = Sweep(
        tmp_path, ["steps", "loss", "seed"], [job for job in jobs if job.place["model"] == "a"], []
    )
    assert name_axis("steps", two) == "steps"


def test_cells() -> None:
    """Means and extremes with the sample's standard deviation."""
    auc, share = find_metric("add/auc"), find_metric("particles_on_object")

    def group(*values: float | None, key: str = "add/auc") -> Group:
        numbers: list[dict[str, float]] = [{} if x is None else {key: x} for x in values]
        return Group({}, [Job({"seed": i}, own, str(i)) for i, own in enumerate(numbers)])

    assert format_mean(group(1.0, 2.0, 6.0), auc) == "3.0 ± 2.6"
    assert format_mean(group(0.02, key=share.key), share) == "2.0"  # in the unit of its column
    assert format_mean(group(), auc) == format_mean(group(None), auc) == "–"
    spread = format_spread(group(0.01, 0.03, key=share.key), share)
    assert spread == "1.0 to 3.0 (sd 1.4)"
    # a run without the number, as of a median that is infinite, is not passed over in silence
    assert format_mean(group(3.0, None, 4.0), auc) == "3.5 ± 0.7 (2 of 3)"
    assert format_spread(group(3.0, None, 4.0), auc) == "3.0 to 4.0 (sd 0.7) (2 of 3)"


def test_of_a_symmetric_object_the_best_is_up_to_symmetry(tmp_path: Path) -> None:
    jobs = [
        Job({"steps": i}, {"add/auc": plain, "add_up_to_symmetry/auc": symmetric}, str(i))
        for i, (plain, symmetric) in enumerate(((60.0, 80.0), (40.0, 95.0)))
    ]
    assert find_best_job(Sweep(tmp_path, ["steps"], jobs, [])).place == {"steps": 1}


def test_what_is_said_of_the_best_of_a_symmetric_object_is_up_to_symmetry(tmp_path: Path) -> None:
    """The same error decides, is named, and is drawn."""
    error = "add_up_to_symmetry"

    def make_sweep(seeds: int, auc: float) -> Sweep:
        rows = ((50, 30.0, 80.0, 97.0, 2.0), (100, 70.0, 8.0, auc, 5.0))
        jobs = [
            Job(
                {"filter.particles": n, **({"seed": seed} if seeds > 1 else {})},
                {"add/auc": plain, "add/median_mm": far, f"{error}/auc": own,
                 f"{error}/median_mm": near, "seconds_per_image": n / 500},
                f"{n}_{seed}",
            )
            for n, plain, far, own, near in rows
            for seed in range(seeds)
        ]  # fmt: skip
        return Sweep(tmp_path, ["filter.particles", *(["seed"] if seeds > 1 else [])], jobs, [])

    tied = make_sweep(1, 97.01)
    assert find_best_job(tied).place == {"filter.particles": 50}
    head = str(head_lines(tied, find_best_job(tied))[0])
    assert (
        "2 runs have its score to one decimal; it has the least median ADD up to symmetry" in head
    )
    several = make_sweep(2, 90.0)
    head = str(head_lines(several, find_best_job(several))[0])
    assert "(ADD up to symmetry AUC 97.0 ± 0.0, mean of 2 seeds)" in head
    (panel,) = chart_against_time(group_jobs(several))
    assert (panel.title, list(panel.lines[0].y)) == ("ADD up to symmetry AUC", [97.0])
    figure = draw_summary(several)
    assert figure is not None
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles == ["ADD up to symmetry AUC", "time per image [s]"]


def test_detectors_that_tie_have_no_median(tmp_path: Path) -> None:
    numbers = {"iou": 0.5, "particles_on_object": 0.7}
    jobs = [Job({"filter.particles": n}, numbers, str(n)) for n in (50, 100)]
    found = Sweep(tmp_path, ["filter.particles"], jobs, [])
    head = str(head_lines(found, find_best_job(found))[0])
    assert "2 runs have its score to one decimal; it is the first of them" in head
    seeds = [job._replace(place={**job.place, "seed": s}) for job in jobs for s in (0, 1)]
    found = Sweep(tmp_path, ["filter.particles", "seed"], seeds, [])
    head = str(head_lines(found, find_best_job(found))[0])
    assert "(box IoU 0.500 ± 0.000, particles on the object 70.0 ± 0.0, mean of 2 seeds)" in head


@pytest.mark.parametrize("seeds", [1, 2])
def test_detectors_and_methods_of_poses_are_ranked_by_what_both_have(
    seeds: int, tmp_path: Path
) -> None:
    """By its own score the detector has 65, and the others 40 and 50."""
    rows = {
        "cnn_patch": {"iou": 0.6, "particles_on_object": 0.7},
        "pose_pf": {"iou": 0.7, "particles_on_object": 0.8, "add/auc": 40.0},
        "pixel_pf": {"iou": 0.5, "particles_on_object": 0.1, "add/auc": 50.0},
    }
    jobs = [
        Job({"model": name, "seed": seed}, {**numbers, "seconds_per_image": 1.0}, f"{name}_{seed}")
        for name, numbers in rows.items()
        for seed in range(seeds)
    ]
    found = Sweep(tmp_path, ["model", "seed"], jobs, [])
    assert find_best_job(found).place["model"] == "pose_pf"
    assert find_ties(found) == seeds
    page = make_sweep_page(found, None, None, "x")
    assert any("by the mean of the particles on the object and the" in note for note in page.notes)
    head = str(head_lines(found, find_best_job(found))[0])
    assert ("(box IoU 0.700 ± 0.000, particles on the object 80.0" in head) == (seeds > 1)
    (panel,) = chart_against_time(group_jobs(found))
    assert (panel.title, len(panel.lines)) == ("particles on the object", 3)
    figure = draw_summary(found)
    assert figure is not None
    assert figure.axes[0].get_title(loc="left") == "ADD AUC"  # of those that have it

    poses = Sweep(tmp_path, ["model", "seed"], jobs[seeds:], [])
    assert find_best_job(poses).place["model"] == "pixel_pf"
    assert not any("predict no pose" in note for note in list_notes(poses, None))


def test_runs_of_both_kinds_that_tie_have_no_median(tmp_path: Path) -> None:
    numbers = {"iou": 0.5, "particles_on_object": 0.7}
    pose = numbers | {"add/auc": 50.0, "add/median_mm": 4.0}
    jobs = [Job({"model": name}, own, name) for name, own in (("a", numbers), ("b", pose))]
    found = Sweep(tmp_path, ["model"], jobs, [])
    head = str(head_lines(found, find_best_job(found))[0])
    assert "model=a" in head
    assert "2 runs have its score to one decimal; it is the first of them" in head


def test_where_scores_tie_the_median_names_the_best(sweep: Path) -> None:
    """To one decimal: a hundredth of a point more is no better, a tenth is."""
    best, other = (
        sweep / f"filter.particles=1000,refine=gradient,seed={seed}" / "metrics.json"
        for seed in (2, 1)
    )
    first, second = json.loads(best.read_text()), json.loads(other.read_text())
    for auc, median, seed, ties in ((82.98, 2.0, 1, 2), (82.98, 9.0, 2, 2), (82.8, 2.0, 2, 1)):
        second["add"] |= {"auc": auc, "median_mm": median}
        other.write_text(json.dumps(second))
        found = read_sweep(sweep)
        assert find_best_job(found).place["seed"] == seed
        assert find_ties(found) == ties
        head, _ = head_lines(found, find_best_job(found))
        assert any("mean of 3 seeds" in str(part) for part in head.parts)
    assert first["add"]["auc"] == 83.0


@pytest.mark.parametrize(("auc", "ties"), [(80.46, 2), (80.4, 1)])
def test_ties_of_single_runs_are_said(tmp_path: Path, auc: float, ties: int) -> None:
    rows = f"filter.particles,add_auc,add_median_mm,folder\n1000,80.5,2,b\n50,{auc},1,a\n"
    (tmp_path / "summary.csv").write_text(rows)
    found = read_sweep(tmp_path)
    assert find_ties(found) == ties
    head, _ = head_lines(found, find_best_job(found))
    assert any("least median ADD" in str(part) for part in head.parts) == (ties > 1)


def test_one_lucky_seed_makes_no_setting_the_best(sweep: Path) -> None:
    """The seed with the highest score of all is of a setting whose mean is lower."""
    lucky = sweep / "filter.particles=50,refine=none,seed=0" / "metrics.json"
    numbers = json.loads(lucky.read_text())
    numbers["add"]["auc"] = 99.0
    lucky.write_text(json.dumps(numbers))
    found = read_sweep(sweep)
    winner = find_best_job(found)
    assert winner.place == {"filter.particles": 1000, "refine": "gradient", "seed": 2}
    page = make_sweep_page(found, read_run(sweep / winner.folder), None, "x")
    assert not page.tiles  # they would be of one seed
    head, _ = head_lines(found, winner)
    assert "seed=" not in "".join(str(part) for part in head.parts)


def test_summary_alone_is_enough(tmp_path: Path) -> None:
    """Where the runs are gone, summary.csv is read, and the page says so."""
    rows = "filter.particles,add_auc,seconds_per_image,folder\n1000,80.5,2,b\n50,70,1,a\n"
    (tmp_path / "summary.csv").write_text(rows)
    found = read_sweep(tmp_path)
    assert found.axes == ["filter.particles"]
    assert [job.place["filter.particles"] for job in found.jobs] == [50, 1000]
    assert find_best_job(found).numbers == {"add/auc": 80.5, "seconds_per_image": 2.0}
    content = make_sweep_page(found, None, None, "x")
    page, files = content.render(), content.files()
    assert "those of summary.csv" in page
    assert "add-auc-filter-particles.png" in files


def test_a_failed_job_of_a_summary_counts_for_no_setting(tmp_path: Path) -> None:
    rows = "filter.particles,seed,add_auc,folder,error\n"
    rows += "50,0,90,a,\n50,1,,b,out of memory\n1000,0,50,c,\n1000,1,50,d,\n"
    (tmp_path / "summary.csv").write_text(rows)
    found = read_sweep(tmp_path)
    assert [job.folder for job in found.jobs] == ["a", "c", "d"]
    assert [(job.folder, job.error) for job in found.failed] == [("b", "out of memory")]
    assert find_best_job(found).folder == "a"


def test_tables_are_read_as_they_are_written_whatever_the_locale(tmp_path: Path) -> None:
    """A file that is opened in the locale's encoding is a warning, and here an error."""
    write_errors(
        tmp_path / FILE, [ImageError(0, 0, 1, "box", "K\xfcche/0", 1.0, 2.0, 1.0, 90.0, 1, 0, 0)]
    )
    summary = tmp_path / "summary.csv"
    summary.write_text("data.root,add_auc,folder\nK\xfcche,50,a\n", encoding="utf-8")
    code = (
        "import sys, warnings; from pathlib import Path;"
        "from posefilter.metrics.image_errors import read_errors;"
        "from posefilter.report.sweeps import read_jobs_from_csv;"
        "warnings.simplefilter('error', EncodingWarning);"
        "assert read_errors(Path(sys.argv[1]))[0].image == 'K\\xfcche/0';"
        "assert read_jobs_from_csv(Path(sys.argv[2]))[1][0].place == {'data.root': 'K\\xfcche'}"
    )
    strict = [sys.executable, "-X", "warn_default_encoding", "-c", code]
    subprocess.run([*strict, tmp_path / FILE, summary], check=True)


def test_mistakes_are_one_line(sweep: Path, run: Path, tmp_path: Path) -> None:
    """No folder, no sweep, a run, nothing finished."""
    (tmp_path / "empty").mkdir()
    for folder, cause in (
        (tmp_path / "nowhere", "no such folder"),
        (tmp_path / "empty", "no sweep's folder"),
        (run, "run="),
    ):
        with pytest.raises(UserError, match=cause):
            read_sweep(folder)
    for path in sweep.rglob("metrics.json"):
        path.unlink()
    with pytest.raises(UserError, match="none of its 12 runs has ended"):
        read_sweep(sweep)
    shutil.rmtree(sweep)


def test_the_page_tells_why_a_run_failed(sweep: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(sweep, folder)
    failed = folder / "filter.particles=0"
    failed.mkdir()
    content = {"overrides": ["filter.particles=0"], "error": "filter.particles=0: must be more"}
    (failed / "failed.json").write_text(json.dumps(content))
    page = make_sweep_page(read_sweep(folder), None, None, "python report.py")
    assert "Failed: filter.particles=0: filter.particles=0: must be more" in page.notes
    (without,) = [note for note in page.notes if note.startswith("Without a result")]
    assert without == "Without a result: filter.particles=1000,refine=none,seed=2."


def test_threads_are_an_axis_where_they_are_swept_alone(tmp_path: Path) -> None:
    for number in (1, 2):
        run = tmp_path / f"threads={number}"
        run.mkdir()
        typed = ["model=patch_pf", f"threads={number}"]
        (run / "metrics.json").write_text(json.dumps({"overrides": typed, "iou": 0.5}))
    assert read_sweep(tmp_path).axes == []  # one was gone on with by other hands
    asked = {"hydra": {"overrides": {"task": ["model=patch_pf", "threads=1,2"]}}}
    (tmp_path / "multirun.yaml").write_text(json.dumps(asked))
    assert read_sweep(tmp_path).axes == ["threads"]


def test_a_run_that_was_evaluated_since_keeps_its_row(sweep: Path) -> None:
    before = read_sweep(sweep)
    own = sweep / before.jobs[0].folder
    shutil.copy2(own / "metrics.json", own / "metrics_train.json")
    others = {"add": {"auc": 1.0}, "overrides": ["checkpoint=a.ckpt", "data=ycb_video"]}
    (own / "metrics.json").write_text(json.dumps(others))
    (own / "evaluation_1").mkdir()
    shutil.copy2(own / "metrics.json", own / "evaluation_1")
    after = read_sweep(sweep)
    assert (after.axes, after.jobs) == (before.axes, before.jobs)
    with pytest.raises(UserError, match="is a run's folder; give it as run="):
        read_sweep(own)


def test_lines_go_through_their_numbers_by_size(tmp_path: Path) -> None:
    """Also where the first job of a sweep has no result."""
    rows = [
        f"{loss},{n},{n / 10}"
        for loss, n in product("ab", (50, 100, 400))
        if (loss, n) != ("a", 50)
    ]
    text = "\n".join(["loss,filter.particles,add_auc", *rows])
    (tmp_path / "summary.csv").write_text(text + "\n")
    found = read_sweep(tmp_path)
    (panel,) = chart_over("filter.particles", found, group_jobs(found), [find_metric("add/auc")])
    assert [list(line.x) for line in panel.lines] == [[100.0, 400.0], [50.0, 100.0, 400.0]]


def test_a_sweep_over_seeds_is_not_asked_for_seeds(tmp_path: Path) -> None:
    (tmp_path / "summary.csv").write_text("seed,add_auc\n0,80\n1,82\n2,81\n")
    assert "One seed each" not in make_sweep_page(read_sweep(tmp_path), None, None, "x").render()
    (tmp_path / "summary.csv").write_text("filter.particles,add_auc\n50,80\n100,82\n")
    assert "One seed each" in make_sweep_page(read_sweep(tmp_path), None, None, "x").render()


def test_tiles_are_of_the_test_that_the_table_shows(tmp_path: Path, run: Path) -> None:
    """Also where an evaluation has written its own numbers since."""
    own = tmp_path / "sweep" / "filter.particles=50"
    shutil.copytree(run, own)
    typed = {"overrides": ["filter.particles=50"]}
    for name, auc in (("metrics_train.json", 95.0), ("metrics.json", 10.0)):
        (own / name).write_text(json.dumps({"add": {"auc": auc}, **typed}))
    other = tmp_path / "sweep" / "filter.particles=100"
    other.mkdir()
    (other / "metrics.json").write_text(
        json.dumps({"add": {"auc": 50.0}, "overrides": ["filter.particles=100"]})
    )
    found = read_sweep(tmp_path / "sweep")
    page = make_sweep_page(found, read_run(own), None, "x")
    assert [tile.value for tile in page.tiles if tile.label == "ADD AUC"] == ["95.0"]


def test_what_changes_no_result_divides_no_setting(tmp_path: Path) -> None:
    """A sweep that is gone on with under another tag, with other workers, is one sweep."""
    for seed, tag, workers in ((0, "first", 2), (1, "first", 2), (2, "second", 4)):
        run = tmp_path / f"seed={seed}"
        (run / ".hydra").mkdir(parents=True)
        words = [f"seed={seed}", f"tags=[{tag}]", f"data.workers={workers}"]
        (run / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(words))
        metrics = {"overrides": words, "seed": seed, "add": {"auc": 60.0 + seed}}
        (run / "metrics.json").write_text(json.dumps(metrics))
    assert read_sweep(tmp_path).axes == ["seed"]
