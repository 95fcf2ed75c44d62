"""A probability, the whole way at toy size: calibrated, stored, predicted, evaluated."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tests.smoke.conftest import SMALL_POSE_PF

from posefilter import Costs, PoseTolerance, load
from posefilter.cli import run_command
from posefilter.cli.build import build_data
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.errors import UserError
from posefilter.synthetic.generate import generate

pytestmark = pytest.mark.slow

HOME = Path(__file__).parents[2]
QUIET = ["console=json", "threads=1"]
TINY = ["debug=smoke", *QUIET, "logger=none", "data.progress=false", "filter.particles=16"]


def save_untrained(words: list[str], path: Path) -> None:
    """Write the checkpoint of a method that has not been trained."""
    job = compose_job("train", HOME / "conf", words, path.parent)
    data = build_data(job.cfg.data, "json")
    method = build_method(recipe(job), data.object_to_learn(), lightning=False)
    content: dict[str, Any] = {"state_dict": method.state_dict(), "global_step": 0, "epoch": 0}
    method.on_save_checkpoint(content)
    torch.save(content, path)


@pytest.fixture(scope="module")
def weights(tiny_scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an untrained checkpoint of the pose-space method."""
    folder = tmp_path_factory.mktemp("untrained")
    words = [*TINY, f"data.root={tiny_scenes}", "filter.steps=3", *SMALL_POSE_PF]
    save_untrained(words, folder / "untrained.ckpt")
    return folder / "untrained.ckpt"


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return twelve frames that lack the carton."""
    out = tmp_path_factory.mktemp("without") / "scenes"
    few = {"distractors": (1, 2), "frames_per_scene": 4, "workers": 1, "progress": False}
    generate(out, 12, object="carton", size=(160, 120), absent_fraction=1.0, **few)  # type: ignore[arg-type]
    return out


@pytest.fixture(scope="module")
def calibrated(
    weights: Path, tiny_scenes: Path, without: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Return a calibrated copy, written by the command."""
    out = tmp_path_factory.mktemp("calibrated") / "carton.ckpt"
    typed = [
        f"checkpoint={weights}",
        f"data.root={tiny_scenes}",
        "data.split={train: 0, val: 1.0, test: 0}",
    ]
    typed += ["data.min_visibility_test=0", f"absent={without}", f"out={out}", *QUIET]
    assert run_command("calibrate", HOME, [*typed, "frames=12", "absent_frames=10"]) == 0
    return out


def plant(path: Path, out: Path, presence: float, success: float) -> Path:
    """Write a copy whose calibration answers the same whatever it sees."""
    content = torch.load(path, weights_only=True)
    for name, bias in (("presence", presence), ("success", success)):
        none = [0.0] * len(content["calibration"]["features"])
        content["calibration"][name] = {"weights": none, "bias": bias}
    torch.save(content, out)
    return out


def photograph(scenes: Path) -> list[str]:
    rgb = min(scenes.rglob("*.left.jpg"))
    depth = rgb.with_name(rgb.name.replace(".left.jpg", ".left.depth.png"))
    return [f"rgb={rgb}", f"depth={depth}", "intrinsics=266,266,78,60", *QUIET]


def test_a_calibration_is_stored_and_not_overwritten(
    calibrated: Path, weights: Path, tiny_scenes: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stored = torch.load(calibrated, weights_only=True)["calibration"]
    assert stored["counts"]["right"] + stored["counts"]["wrong"] == 12
    assert stored["counts"]["absent"] == 10
    assert stored["source"] == "scenes"
    again = [f"checkpoint={calibrated}", f"data.root={tiny_scenes}", *QUIET]
    assert run_command("calibrate", HOME, again) == 2
    assert "overwrite=true" in capfd.readouterr().err
    assert run_command("calibrate", HOME, [*again, "filter.particles=9"]) == 2
    assert "export.py" in capfd.readouterr().err
    few = [
        f"checkpoint={weights}",
        f"data.root={tiny_scenes}",
        "data.split={train: 0, val: 1.0, test: 0}",
        *QUIET,
    ]
    assert run_command("calibrate", HOME, few) == 2
    assert "absent_fraction=1" in capfd.readouterr().err


def test_sets_are_learned_alone_and_all_else_stays(
    calibrated: Path,
    weights: Path,
    tiny_scenes: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out, split = tmp_path / "sets.ckpt", "data.split={train: 0, val: 1.0, test: 0}"
    typed = [f"data.root={tiny_scenes}", split, "data.min_visibility_test=0", *QUIET]
    alone = [*typed, "sets_only=true", "frames=11", f"out={out}"]
    assert run_command("calibrate", HOME, [f"checkpoint={weights}", *alone]) == 2
    assert "has no probability to group frames by" in capfd.readouterr().err
    assert run_command("calibrate", HOME, [f"checkpoint={calibrated}", *alone]) == 0
    before, now = (torch.load(x, weights_only=True)["calibration"] for x in (calibrated, out))
    sets, other = now.pop("conformal"), before.pop("conformal")
    assert str(now) == str(before)
    assert sets != other
    assert sum(map(len, sets["scores"])) == 11
    assert sets["by"] == "probability"


def test_an_absent_object_gets_no_pose_and_status_1(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    nothing = plant(calibrated, tmp_path / "nothing.ckpt", -9.0, 9.0)
    typed = [f"checkpoint={nothing}", *photograph(tiny_scenes), f"out={tmp_path / 'a'}"]
    assert run_command("predict", HOME, typed) == 1
    out, err = capfd.readouterr()
    assert err.splitlines() == ["predict: carton: absent, probability 0.01 that it is there"]
    assert json.loads(out.splitlines()[-1])["verdict"] == "absent"
    told = json.loads((tmp_path / "a" / "pose.json").read_text())
    assert told["verdict"] == "absent"
    assert told["camera_from_object"] is None
    assert told["presence"] < 0.01
    rgb = cv2.imread(typed[1].removeprefix("rgb="))
    height = rgb.shape[0] * 640 // rgb.shape[1]
    drawn = cv2.imread(str(tmp_path / "a" / "overlay.png"))[:height]
    plain = cv2.resize(rgb, (640, height), interpolation=cv2.INTER_CUBIC)
    assert np.abs(drawn.astype(int) - plain).mean() < 1

    there = plant(calibrated, tmp_path / "there.ckpt", 9.0, 9.0)
    both = [f"checkpoint=[{nothing},{there}]", *typed[1:-1], f"out={tmp_path / 'b'}"]
    assert run_command("predict", HOME, both) == 0
    rows = json.loads((tmp_path / "b" / "poses.json").read_text())
    assert [row["verdict"] for row in rows] == ["absent", "found"]
    assert [row["camera_from_object"] is None for row in rows] == [True, False]


def test_verdicts_go_by_what_errors_cost(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    fair = plant(calibrated, tmp_path / "fair.ckpt", 1.0, 1.0)  # 0.73, and 0.53 for the pose
    typed = [f"checkpoint={fair}", *photograph(tiny_scenes)]
    verdicts = []
    for number, words in enumerate(([], ["cost_false_alarm=1"], ["cost_miss=1", "cost_unsure=5"])):
        assert run_command("predict", HOME, [*typed, *words, f"out={tmp_path / str(number)}"]) < 2
        told = json.loads((tmp_path / str(number) / "pose.json").read_text())
        verdicts.append(told["verdict"])
        assert told["probability"] == pytest.approx(0.731**2, abs=1e-3)
    assert verdicts == ["unsure", "found", "absent"]
    capfd.readouterr()
    assert run_command("predict", HOME, [*typed, "cost_miss=-1", f"out={tmp_path / 'c'}"]) == 2
    assert "cost_miss=-1" in capfd.readouterr().err


def plant_errors(path: Path, out: Path) -> Path:
    """Write a copy whose calibration frames were all turned: wrong by ADD, right by ADD-S."""
    content = torch.load(path, weights_only=True)
    rows, count = content["calibration"]["errors"], len(content["calibration"]["features"])
    assert rows.shape == (12, count + 4)
    turned = torch.zeros(12, count + 4)
    turned[:, count:] = torch.tensor([0.001, 3.0, 0.5, 0.02])
    content["calibration"]["errors"] = turned.half()
    torch.save(content, out)
    return out


def test_verdicts_go_by_a_tolerance_of_ones_own(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    turned = plant_errors(
        plant(calibrated, tmp_path / "a.ckpt", 5.0, -3.0), tmp_path / "turned.ckpt"
    )
    photo = photograph(tiny_scenes)
    typed = [f"checkpoint={turned}", *photo]
    told = []
    for number, words in enumerate(
        ([], ["pose_tolerance.add_s=0.1"], ["pose_tolerance.add_s=0.1", "pose_tolerance.add=0.2"])
    ):
        out = f"out={tmp_path / str(number)}"
        assert run_command("predict", HOME, [*typed, *words, out]) == 0
        told.append(json.loads((tmp_path / str(number) / "pose.json").read_text()))
    assert [one["verdict"] for one in told] == ["unsure", "found", "unsure"]
    assert len({one["probability"] for one in told}) == 1  # always that of ADD
    assert told[0]["probability_within"] is told[0]["pose_tolerance"] is None
    assert told[1]["probability_within"] > 0.9 > 0.1 > told[2]["probability_within"]
    assert told[1]["pose_tolerance"]["add_s"] == 0.1
    several = [f"checkpoint=[{turned},{calibrated}]", *photo, "pose_tolerance.add_s=0.1"]
    assert run_command("predict", HOME, [*several, f"out={tmp_path / 'both'}"]) < 2
    rows = json.loads((tmp_path / "both" / "poses.json").read_text())
    assert rows[0]["verdict"] == "found"
    capfd.readouterr()
    plain = [*typed[:-2], "threads=1", f"out={tmp_path / 'plain'}"]
    assert run_command("predict", HOME, plain) == 0
    assert "within ADD-S 0.1 d: its place is surer" in capfd.readouterr().out
    for wrong, said in (
        ("pose_tolerance.add=-1", "pose_tolerance.add=-1"),
        ("pose_tolerance.mm=5", "pose_tolerance.mm"),
    ):
        assert run_command("predict", HOME, [*typed, wrong, f"out={tmp_path / 'wrong'}"]) == 2
        assert said in capfd.readouterr().err
    assert not (tmp_path / "wrong").exists()


def test_a_calibration_of_an_earlier_version_knows_no_tolerance_and_says_so(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    content = torch.load(calibrated, weights_only=True)
    del content["calibration"]["errors"]
    torch.save(content, tmp_path / "old.ckpt")
    typed = [f"checkpoint={tmp_path / 'old.ckpt'}", *photograph(tiny_scenes)]
    for command, words in (
        ("predict", [*typed, f"out={tmp_path / 'a'}"]),
        ("evaluate", [typed[0], f"data.root={tiny_scenes}", *QUIET, f"out={tmp_path / 'b'}"]),
    ):
        assert run_command(command, HOME, [*words, "pose_tolerance.translation_mm=5"]) == 2
        assert "calibrate it again" in capfd.readouterr().err
    assert run_command("predict", HOME, [*typed, f"out={tmp_path / 'c'}"]) < 2


def test_the_library_gives_what_the_command_gives(
    calibrated: Path, weights: Path, tiny_scenes: Path
) -> None:
    rgb = cv2.imread(str(min(tiny_scenes.rglob("*.left.jpg"))))[..., ::-1]
    depth = np.tile(np.linspace(0.6, 0.8, rgb.shape[1]), (len(rgb), 1))
    K = np.array([[266.0, 0, 78], [0, 266, 60], [0, 0, 1]])
    result = load(calibrated, device="cpu").predict(rgb, depth, K)
    assert 0 <= result.probability <= result.presence <= 1
    assert result.verdict in ("found", "unsure", "absent")
    assert result.decide(Costs(miss=1e6)) != "absent"
    within = PoseTolerance(translation_mm=20, rotation_deg=30)
    assert 0 < result.probability_within(within) <= result.presence
    assert result.probability_within(PoseTolerance(add=0.1)) == result.probability
    again = load(calibrated, device="cpu", pose_tolerance=within).predict(rgb, depth, K)
    assert again.verdict == result.decide(Costs(), within)
    assert again.probability_within(within) == result.probability_within(within)
    assert again.probability == result.probability
    words = f"{again.probability_within(within):.2f} within 20 mm and 30 degrees"
    assert again.verdict == "absent" or words in again.describe()
    several = load(calibrated, device="cpu", pose_tolerance=within)
    for one in several.predict(rgb, depth, K, instances=1):
        assert one.pose_tolerance == within
        assert 0 < one.probability_within(within) <= one.presence
    plain = load(weights, device="cpu").predict(rgb, depth, K)
    with pytest.raises(UserError, match="has no probability"):
        plain.probability_within(within)
    with pytest.raises(UserError, match=r"expected posefilter\.PoseTolerance"):
        load(weights, pose_tolerance=0.1)  # type: ignore[arg-type]
    assert plain.probability is plain.presence is plain.verdict is None
    assert "run calibrate" in plain.calibration_note
    other = load(calibrated, overrides=["filter.particles=8"], device="cpu").predict(rgb, depth, K)
    assert other.probability is None
    assert "another filter" in other.calibration_note


def plant_scale(path: Path, out: Path, bias: float) -> Path:
    """Write a copy whose beliefs are as wide as the particles are, times exp(bias)."""
    content = torch.load(path, weights_only=True)
    content["calibration"]["belief_scale"] = {"bias": bias, "slope": 0.0}
    torch.save(content, out)
    return out


def test_a_belief_is_as_wide_as_the_calibration_says_in_results_files_and_metrics(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    stored = torch.load(calibrated, weights_only=True)["calibration"]
    assert stored["belief_scale"] is None  # untrained: too few of its answers are right
    photo = photograph(tiny_scenes)
    files = [plant_scale(calibrated, tmp_path / f"{x}.ckpt", math.log(x)) for x in (1.0, 3.0)]
    there = [plant(file, file, 9.0, 0.5) for file in files]
    rgb = cv2.imread(photo[0].removeprefix("rgb="))[..., ::-1]
    depth = np.tile(np.linspace(0.6, 0.8, rgb.shape[1]), (len(rgb), 1))
    K = np.array([[266.0, 0, 78], [0, 266, 60], [0, 0, 1]])
    plain = load(calibrated, device="cpu").predict(rgb, depth, K)
    narrow, wide = (load(file, device="cpu").predict(rgb, depth, K) for file in there)
    assert [one.belief_calibrated for one in (plain, narrow, wide)] == [False, True, True]
    assert narrow.pose.tolist() == wide.pose.tolist() == plain.pose.tolist()
    shares = [result.covariance for result in (narrow, wide)]
    assert np.diag(shares[1])[:3].sum() > np.diag(shares[0])[:3].sum()
    several = load(there[0], device="cpu").predict(rgb, depth, K, instances=1)
    assert several
    assert all(one.belief_calibrated for one in several)

    for file, said in ((there[0], "if it is right"), (calibrated, "the particles")):
        out = tmp_path / f"of_{file.stem}"
        assert run_command("predict", HOME, [f"checkpoint={file}", *photo[:3], f"out={out}"]) < 2
        told = json.loads((out / "pose.json").read_text())
        if told["verdict"] != "absent":
            assert f"{said}: within " in capfd.readouterr().out
        assert ("not calibrated" in told["belief"]["belief_is"]) == (file == calibrated)

    coverage, spread = [], []
    for file in there:
        out = tmp_path / f"test_of_{file.stem}"
        typed = [f"checkpoint={file}", f"data.root={tiny_scenes}", *QUIET, f"out={out}"]
        typed += ["data.split={train: 0, val: 0, test: 1.0}"]
        assert run_command("evaluate", HOME, typed) == 0
        coverage.append(json.loads((out / "metrics.json").read_text())["belief"])
        with np.load(out / "beliefs.npz") as found:
            assert found["weights"].shape[1] == 200  # filters have 16
            spread.append(float(found["poses"][:, :, :3, 3].std(1).mean()))
    assert coverage[0] != coverage[1]
    assert spread[0] < spread[1]


def test_an_evaluation_reports_how_much_the_probability_tells(
    calibrated: Path, tiny_scenes: Path, tmp_path: Path
) -> None:
    typed = [f"checkpoint={calibrated}", f"data.root={tiny_scenes}", *QUIET, f"out={tmp_path}"]
    assert run_command("evaluate", HOME, [*typed, "data.split={train: 0, val: 0, test: 1.0}"]) == 0
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["confidence"]["frames"] == metrics["instances"] > 5
    assert metrics["confidence"]["frames_without"] == 0
    assert 0 <= metrics["confidence"]["ece"] <= 1
    assert metrics["confidence"]["pose_tolerance"] == "within ADD 0.1 d"
    wide = [*typed[:-1], f"out={tmp_path / 'wide'}", "pose_tolerance.translation_mm=1e6"]
    assert run_command("evaluate", HOME, [*wide, "data.split={train: 0, val: 0, test: 1.0}"]) == 0
    wide_metrics = json.loads((tmp_path / "wide" / "metrics.json").read_text())
    assert wide_metrics["confidence"]["wrong"] == 0 < metrics["confidence"]["wrong"]
    assert wide_metrics["add"] == metrics["add"]
    with (tmp_path / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    with (tmp_path / "poses.csv").open() as file:
        scores = [float(row["score"]) for row in csv.DictReader(file)]
    assert scores == [float(row["probability"]) for row in rows]
    assert all(float(row["probability"]) <= float(row["presence"]) <= 1 for row in rows)


def test_a_detector_is_refused(tiny_scenes: Path, tmp_path: Path) -> None:
    words = [*TINY, f"data.root={tiny_scenes}", "model=cnn_patch"]
    save_untrained(words, tmp_path / "detector.ckpt")
    from posefilter.cli.calibrate import calibrate

    typed = [f"checkpoint={tmp_path / 'detector.ckpt'}"]
    with pytest.raises(UserError, match="estimates no pose"):
        calibrate(compose_job("calibrate", HOME / "conf", typed, tmp_path))


@pytest.mark.parametrize("name", ["patch_pf", "pixel_pf"])
def test_methods_in_image_space_are_calibrated_too(
    name: str, tiny_scenes: Path, without: Path, tmp_path: Path
) -> None:
    typed = [f"model={name}", *TINY, f"data.root={tiny_scenes}", "filter.steps=3"]
    save_untrained(typed, tmp_path / "bare.ckpt")
    out = tmp_path / "calibrated.ckpt"
    words = [f"checkpoint={tmp_path / 'bare.ckpt'}", f"data.root={tiny_scenes}"]
    words += ["data.split={train: 0, val: 1.0, test: 0}", "data.min_visibility_test=0"]
    words += [f"absent={without}", "frames=12", f"out={out}", *QUIET]
    assert run_command("calibrate", HOME, words) == 0
    stored = torch.load(out, weights_only=True)["calibration"]
    known = {"score", "concentration", "surface", "free_space", "texture"}
    known |= {"texture_density", "rotation_margin"}  # of the carton, whose shape allows rotations
    assert set(stored["features"]) == known
    rgb = min(tiny_scenes.rglob("*.left.jpg"))
    depth = rgb.with_name(rgb.name.replace(".left.jpg", ".left.depth.png"))
    color = cv2.cvtColor(cv2.imread(str(rgb)), cv2.COLOR_BGR2RGB)
    z = cv2.imread(str(depth), cv2.IMREAD_UNCHANGED) / 10_000
    K = np.array([[266.0, 0, 78], [0, 266, 60], [0, 0, 1]])
    result = load(str(out)).predict(color, z, K)
    assert result.probability is not None
    assert result.presence is not None
    assert 0 < result.probability < result.presence < 1
    assert result.conformal_set(0.8).level == 0.8


@pytest.mark.parametrize(("searches", "kept"), [(1, True), (4, False)])
def test_an_export_keeps_the_calibration_of_a_filter_with_fewer_searches(
    searches: int,
    kept: bool,
    calibrated: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "exported.ckpt"
    typed = [f"checkpoint={calibrated}", f"filter.max_searches={searches}", f"out={out}", QUIET[0]]
    assert run_command("export", HOME, typed) == 0
    assert ('"calibration": "left out"' in capfd.readouterr().out) != kept
    assert (torch.load(out, weights_only=True).get("calibration") is not None) == kept
