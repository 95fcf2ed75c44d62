"""What is there is not overwritten, and a command that fails at once leaves nothing."""

import json
import shlex
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from posefilter.cli import run_command
from posefilter.cli.folders import KeepResults, keep_training_results, move_evaluation, own_metrics
from posefilter.cli.predict import find_photograph, remove_answers
from posefilter.errors import UserError

HOME = Path(__file__).parents[2]


def fill(folder: Path, **metrics: object) -> Path:
    """Write what a finished run has."""
    (folder / ".hydra").mkdir(parents=True)
    (folder / ".hydra" / "overrides.yaml").write_text("[seed=7]")
    (folder / "checkpoints").mkdir()
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("command", "arguments", "told"),
    [
        ("train", [], "holds a run already; choose another folder, or resume it: resume="),
        ("train", ["-m", "seed=1,2"], "holds a single run; choose another folder"),
        ("evaluate", ["checkpoint=weights/x.ckpt"], "holds an evaluation already; choose another"),
    ],
    ids=["a run", "a sweep", "an evaluation"],
)
def test_a_folder_with_results_is_refused_before_anything_is_written(
    command: str,
    arguments: list[str],
    told: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    run = fill(tmp_path / "run", command=command)
    before = contents(run)
    nowhere = ["data.root=/nonexistent"] if command == "train" else []
    assert run_command(command, HOME, [*arguments, *nowhere, f"out={run}", "console=json"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: out={run}: {told}")
    assert contents(run) == before


@pytest.mark.parametrize(
    ("command", "arguments"),
    [("train", []), ("train", ["-m", "seed=1,2"]), ("generate", []), ("predict", ["checkpoint=x"])],
    ids=["train", "a sweep", "generate", "predict"],
)
def test_a_run_does_not_move_to_its_own_folder(
    command: str,
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Each path that was typed would be looked for there."""
    monkeypatch.chdir(tmp_path)
    words = [*arguments, "hydra.job.chdir=true", "out=run", "console=json"]
    assert run_command(command, HOME, words) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith(f"{command}: hydra.job.chdir=True: paths are relative to the folder")
    assert [*tmp_path.iterdir()] == []


def test_advice_on_a_folder_with_a_blank_can_be_typed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = fill(tmp_path / "my run", command="train")
    assert run_command("train", HOME, ["data.root=/nonexistent", f"out={run}"]) == 2
    assert shlex.split(capfd.readouterr().err)[-1] == f"resume={run}"


def test_what_a_run_found_is_set_aside_before_its_first_evaluation(tmp_path: Path) -> None:
    run = fill(tmp_path / "run", iou=0.5)
    (run / "errors.csv").write_text("of the run")
    keep_training_results(run)
    assert json.loads((run / "metrics_train.json").read_text()) == {"iou": 0.5}
    assert (run / "errors_train.csv").read_text() == "of the run"


def test_an_evaluation_of_an_unfinished_run_is_not_its_result(tmp_path: Path) -> None:
    """It was cut short, and its sweep is to go on with it."""
    run = fill(tmp_path / "run", command="evaluate", iou=0.1)
    assert own_metrics(run) == {}
    (run / "metrics_train.json").write_text('{"iou": 0.5}')
    assert own_metrics(run) == {"iou": 0.5}
    job = tmp_path / "job"  # of a sweep of evaluations
    job.mkdir()
    (job / "metrics.json").write_text('{"command": "evaluate", "iou": 0.1}')
    assert own_metrics(job)["iou"] == 0.1


def test_an_evaluation_stays_where_its_run_goes_on(tmp_path: Path) -> None:
    run = fill(tmp_path / "run", iou=0.5)
    (run / "errors.csv").write_text("of the run")
    (run / "figures").mkdir()
    (run / "figures" / "test_worst.jpg").write_text("a picture of the run")
    assert move_evaluation(run) is None
    before = contents(run)
    for number in (1, 2):
        keep_training_results(run)
        found = {"metrics.json": json.dumps({"command": "evaluate", "iou": number})}
        names = ("errors.csv", "poses.csv", "figures/test_worst.jpg")
        found |= dict.fromkeys(names, f"of evaluation {number}")
        for name, text in found.items():
            (run / name).write_text(text)
        place = run / f"evaluation_{number}"
        assert move_evaluation(run) == place
        assert contents(place) == found
        shown = contents(run)
        assert {name: text for name, text in shown.items() if "evaluation" not in name} == before


@pytest.mark.parametrize("command", ["train", "predict"])
def test_a_command_that_fails_at_once_leaves_no_folder(command: str, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "train.log").write_text("of another run")
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    for name in ("new", "mine"):
        assert run_command(command, HOME, ["seed=-1", f"out={tmp_path / name}"]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("typed", [["seed=-1"], ["model=pose_pf", "loss=bce"]])
@pytest.mark.slow
def test_what_is_above_the_folder_goes_with_it_where_it_is_ours(
    typed: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_command("train", HOME, typed) == 2
    assert [*tmp_path.iterdir()] == []
    (tmp_path / "outputs" / "data").mkdir(parents=True)
    assert run_command("train", HOME, typed) == 2
    assert [path.name for path in (tmp_path / "outputs").iterdir()] == ["data"]
    (tmp_path / "empty").mkdir()  # somebody else's
    assert run_command("train", HOME, [*typed, f"out={tmp_path / 'empty' / 'run'}"]) == 2
    assert (tmp_path / "empty").is_dir()


def test_a_sweep_of_predictions_stays_in_its_folder_and_reports_what_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    typed = ["-m", "checkpoint=none.ckpt", "seed=0,1", "out=there", "console=json"]
    assert run_command("predict", HOME, typed) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
    assert "2 of 2 jobs failed" in capfd.readouterr().err.splitlines()[-1]
    assert "none.ckpt: no such file" in (tmp_path / "there" / "summary.md").read_text()


def test_the_settings_of_several_jobs_are_not_shown_as_one(
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert run_command("train", HOME, ["--cfg", "job", "-m", "seed=0,1"]) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line == "train: --cfg shows the settings of one job; leave -m out"


def test_the_folder_of_all_runs_is_no_runs_own(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    run = fill(tmp_path / "runs" / "first")
    (run / ".hydra" / "config.yaml").write_text("seed: 7")
    typed = [f"out={run.parent}", "data.root=/nonexistent", "console=json"]
    assert run_command("train", HOME, typed) == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line == (
        f"train: out={run.parent}: holds other runs, such as first; choose a folder of its own"
    )
    assert [path.name for path in run.parent.iterdir()] == ["first"]


def test_a_run_with_another_inside_is_resumed(tmp_path: Path) -> None:
    """Such as one that was warm-started from it."""
    run = fill(tmp_path / "first")
    (fill(run / "second") / ".hydra" / "config.yaml").write_text("seed: 7")
    config = OmegaConf.create(
        {"resume": str(run), "out": str(run), "hydra": {"run": {"dir": str(run)}}}
    )
    config.hydra.job = {"name": "train"}
    KeepResults()._check_run(config)
    config.resume = None
    with pytest.raises(UserError, match="holds a run already"):
        KeepResults()._check_run(config)


def test_of_an_answer_before_nothing_is_left(tmp_path: Path) -> None:
    alone = ("pose.json", "belief.png", "belief.npz", "band.png", "view.rrd")
    several = ("poses.json", "poses.csv", "beliefs/00_a.npz", "beliefs/13_b.npz")
    others = ("overlay.png", "photo.png")
    (tmp_path / "beliefs").mkdir()
    for name in (*alone, *several, *others):
        (tmp_path / name).touch()
    remove_answers(tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == sorted(others)
    for name in ("poses.csv", "view.rrd"):  # of an evaluation or a track: there is no answer
        (tmp_path / name).touch()
    remove_answers(tmp_path)
    assert (tmp_path / "poses.csv").exists()
    assert (tmp_path / "view.rrd").exists()


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("pose.json", '{"rgb": "a.png"}', "a.png"),
        ("poses.json", '[{"rgb": "b.png"}, {"rgb": "b.png"}]', "b.png"),
        ("poses.json", "[]", ""),
        ("pose.json", '{"rgb": 3}', ""),
        ("pose.json", "", ""),
        ("other.json", '{"rgb": "a.png"}', ""),
    ],
)
def test_the_photograph_of_an_answer_before_is_found(
    name: str, content: str, found: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    assert find_photograph(tmp_path) == found
