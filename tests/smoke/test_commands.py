"""The commands, the whole way at toy size: what one writes the next one reads, and they agree."""

import csv
import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tests.smoke.conftest import SMALL_POSE_PF

from posefilter.cli import run_command
from posefilter.cli.evaluate import evaluate
from posefilter.cli.train import train
from posefilter.errors import UserError
from posefilter.metrics.registry import find_metric

HOME = Path(__file__).parents[2]
TIMES = ("seconds_per_image",)


def numbers(metrics: dict) -> dict:
    """Return what must agree between a training's test and an evaluation."""
    keys = ("instances", "missed", "add", "add_s", "mssd", "mspd")
    keys += ("iou", "particles_on_object", "belief")
    return {key: metrics[key] for key in keys}


def check_registry(metrics: dict) -> None:
    """Assert that each number which a run writes down is known by name: nothing else can be
    shown.
    """
    keys = [key for key in list_numbers(metrics) if key != "seed" and not key.startswith("data/")]
    assert len(keys) > 10
    assert all(find_metric(key).label for key in keys)


def list_numbers(content: object, name: str = "") -> list[str]:
    """Return where numbers are, and lists of numbers."""
    if isinstance(content, dict):
        return [
            key
            for own, value in content.items()
            for key in list_numbers(value, f"{name}/{own}" if name else own)
        ]
    return (
        [name]
        if isinstance(content, int | float)
        or (isinstance(content, list) and name.startswith("diagnostics"))
        else []
    )


def read(folder: Path) -> dict:
    return json.loads((folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def trained(tiny_scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run of the pose-space method, trained by its command."""
    run = tmp_path_factory.mktemp("runs") / "pose"
    typed = [
        "debug=smoke",
        "console=json",
        "threads=1",
        "data.progress=false",
        f"data.root={tiny_scenes}",
        f"out={run}",
        *SMALL_POSE_PF,
    ]
    assert run_command("train", HOME, typed) == 0
    return run


def test_a_validation_is_at_the_step_that_the_model_had_come_to(trained: Path) -> None:
    """Metrics, and what callbacks draw and log of the same validation."""
    logged = EventAccumulator(str(trained), size_guidance={"images": 0}).Reload()
    tags = logged.Tags()
    validations = {event.step for event in logged.Scalars("val/add/auc")}
    filters = [tag for tag in tags["scalars"] if tag.startswith("filter/")]
    assert filters
    assert {event.step for event in logged.Scalars(filters[0])} == validations
    assert max(validations) == 8
    tested = read(trained)["training"]["tested_step"]
    assert {event.step for event in logged.Scalars("test/add/auc")} == {tested}
    assert "6_test/worst" in tags["images"]
    for tag in tags["images"]:
        last = max(event.step for event in logged.Images(tag))
        assert last == (tested if tag.startswith("6_test") else 8), tag  # none stays behind


def test_a_run_leaves_what_was_promised(trained: Path) -> None:
    for name in (
        ".hydra/config.yaml",
        "checkpoints/best.ckpt",
        "checkpoints/last.ckpt",
        "metrics.json",
    ):
        assert (trained / name).is_file(), name
    assert list(trained.glob("events.out.tfevents.*"))
    figures = list((trained / "figures").rglob("*.jpg"))
    assert figures
    assert all(cv2.imread(str(figure)) is not None for figure in figures)
    metrics = read(trained)
    assert metrics["instances"] > 0
    assert (
        set(metrics["add"])
        == set(metrics["add_s"])
        == {"auc", "recall_01d", "recall_2cm", "median_mm"}
    )
    assert {
        "iou",
        "particles_on_object",
        "seconds_per_image",
        "belief",
        "data",
        "git",
        "versions",
    } <= set(metrics)
    assert "debug=smoke" in metrics["overrides"]
    assert metrics["training"]["steps"] == 8
    assert 0 < metrics["training"]["tested_step"] <= 8
    assert metrics["training"]["seconds_per_step"] > 0
    assert metrics["training"]["cpu_seconds_per_step"] > 0
    check_registry(metrics)


def test_checkpoints_are_plain_data(trained: Path) -> None:
    checkpoint = torch.load(trained / "checkpoints" / "best.ckpt", weights_only=True)
    assert checkpoint["object_model"]["name"] == "carton"
    assert checkpoint["recipe"]["choices"]["model"] == "pose_pf"


def test_a_share_of_no_batch_is_refused_before_it_is_evaluated(
    trained: Path, tmp_path: Path, tiny_scenes: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = [f"checkpoint={trained}", f"data.root={tiny_scenes}", "+trainer.limit_test_batches=0.1"]
    assert run_command("evaluate", HOME, [*words, "console=json", f"out={tmp_path / 'a'}"]) == 2
    said = capfd.readouterr().err
    assert "evaluate: trainer.limit_test_batches=0.1: of 1 batches this is none" in said


def test_evaluate_finds_what_the_training_found_and_so_do_its_own_estimates(
    trained: Path, tmp_path: Path, tiny_scenes: Path
) -> None:
    checkpoint = trained / "checkpoints" / "best.ckpt"
    common = ["console=json", "threads=1"]
    assert (
        run_command(
            "evaluate",
            HOME,
            [
                *common,
                f"checkpoint={checkpoint}",
                f"data.root={tiny_scenes}",
                f"out={tmp_path / 'a'}",
            ],
        )
        == 0
    )
    assert numbers(read(tmp_path / "a")) == numbers(read(trained))
    with (tmp_path / "a" / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == read(trained)["instances"]
    beliefs = np.load(tmp_path / "a" / "beliefs.npz")
    assert beliefs["poses"].shape[0] == len(rows)
    assert np.allclose(beliefs["weights"].sum(1), 1, atol=1e-4)

    data = [
        "data=scenes",
        f"data.root={tiny_scenes}",
        "data.image_width=160",
        "data.progress=false",
    ]
    data += [
        "data.split={train: 0.6, val: 0.2, test: 0.2}",
        "data.min_visibility_test=0.3",
        "data.num_model_points=500",
    ]
    typed = [*common, *data, f"estimates={tmp_path / 'a' / 'poses.csv'}", f"out={tmp_path / 'b'}"]
    assert run_command("evaluate", HOME, typed) == 0
    again, before = read(tmp_path / "b"), read(trained)
    assert again["instances"] == before["instances"]
    for key in ("add", "add_s"):
        assert again[key]["median_mm"] == pytest.approx(before[key]["median_mm"], rel=1e-3)
    assert again["iou"] == pytest.approx(before["iou"], abs=1e-3)


@pytest.mark.slow
def test_pieces_change_at_test_time_and_sweeps_sum_up(
    trained: Path, tiny_scenes: Path, tmp_path: Path
) -> None:
    typed = [
        f"checkpoint={trained / 'checkpoints' / 'best.ckpt'}",
        f"data.root={tiny_scenes}",
        "filter/refine=none",
        "-m",
        "filter.particles=4,8",
    ]
    assert (
        run_command("evaluate", HOME, [*typed, f"out={tmp_path}", "console=json", "threads=1"]) == 0
    )
    with (tmp_path / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["filter.particles"] for row in rows] == ["4", "8"]
    assert (tmp_path / "summary.png").is_file()
    assert "| filter.particles |" in (tmp_path / "summary.md").read_text()
    for row in rows:
        beliefs = np.load(tmp_path / row["folder"] / "beliefs.npz")
        assert beliefs["poses"].shape[1] == int(row["filter.particles"])


def test_unknown_components_are_refused(
    trained: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    typed = [
        f"checkpoint={trained / 'checkpoints' / 'best.ckpt'}",
        f"out={tmp_path}",
        "filter.partcles=4",
    ]
    assert run_command("evaluate", HOME, typed) == 2
    assert "did you mean 'particles'" in capfd.readouterr().err


def test_an_exported_checkpoint_predicts(trained: Path, tmp_path: Path, tiny_scenes: Path) -> None:
    weights = tmp_path / "carton.ckpt"
    typed = [f"checkpoint={trained / 'checkpoints' / 'best.ckpt'}", f"out={weights}"]
    assert run_command("export", HOME, [*typed, "filter/refine=none", "filter.particles=9"]) == 0
    assert weights.stat().st_size < 5e6
    recipe = torch.load(weights, weights_only=True)["recipe"]
    kept = torch.load(trained / "checkpoints" / "best.ckpt", weights_only=True)["recipe"]["choices"]
    assert recipe["choices"] == {**kept, "filter/refine": "none"}
    rgb = min(tiny_scenes.rglob("*.left.jpg"))
    depth = rgb.with_name(rgb.name.replace(".left.jpg", ".left.depth.png"))
    out = tmp_path / "prediction"
    typed = [
        f"checkpoint={weights}",
        f"rgb={rgb}",
        f"depth={depth}",
        "intrinsics=266,266,78,60",
        f"out={out}",
        "threads=1",
    ]
    can_view = importlib.util.find_spec("rerun") is not None  # the optional extra [viz]
    assert (
        run_command(
            "predict", HOME, [*typed, "meshes=builtin", f"save_rerun={str(can_view).lower()}"]
        )
        == 0
    )
    assert (out / "view.rrd").is_file() == can_view
    told = json.loads((out / "pose.json").read_text())
    R = np.array(told["camera_from_object"])[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-4)
    assert told["object"] == "carton"
    belief = np.load(out / "belief.npz")
    assert belief["poses"].shape == (9, 4, 4)
    assert belief["weights"].sum() == pytest.approx(1, abs=1e-4)
    assert (out / "overlay.png").is_file()
    assert (out / "belief.png").is_file()
    assert (out / "band.png").is_file()


@pytest.mark.parametrize(
    ("view", "told"), [("true", "pip install -e '.[viz]'"), ("maybe", "choose true or false")]
)
def test_a_view_that_cannot_be_written_is_refused_before_the_work(
    view: str,
    told: str,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util,
        "find_spec",
        lambda name, *rest: None if name == "rerun" else found(name, *rest),
    )
    assert run_command("predict", HOME, [f"save_rerun={view}", f"out={tmp_path}"]) == 2
    assert [told in line for line in capfd.readouterr().err.splitlines()] == [True]


@pytest.mark.slow
@pytest.mark.parametrize("model", ["pixel_pf", "patch_pf", "cnn_patch", "downsized"])
def test_every_image_space_method_goes_the_whole_way(model: str, tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    train(tiny_job(tmp_path, f"model={model}", "trainer.max_steps=4"))
    metrics = read(tmp_path)
    assert (metrics["add"] is None) == (model in ("cnn_patch", "downsized"))
    assert 0 <= metrics["particles_on_object"] <= 1
    check_registry(metrics)


def test_a_training_shorter_than_its_interval_is_validated_at_its_end(
    tiny_job, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    train(
        tiny_job(
            tmp_path,
            "model=cnn_patch",
            "trainer.max_steps=2",
            "trainer.val_check_interval=100",
            "callbacks=checkpoints",
        )
    )
    assert read(tmp_path)["training"]["steps"] == 2
    assert (tmp_path / "checkpoints" / "best.ckpt").is_file()


def test_the_last_step_is_validated_wherever_it_is(tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    typed = ("trainer.max_steps=5", "trainer.val_check_interval=3", "callbacks=checkpoints")
    train(tiny_job(tmp_path, "model=cnn_patch", "logger=csv", *typed))
    rows = [row for file in tmp_path.rglob("metrics.csv") for row in csv.DictReader(file.open())]
    assert [int(row["step"]) for row in rows if row.get("val/score")] == [3, 5]
    assert read(tmp_path)["training"]["steps"] == 5


def test_a_split_without_a_test_is_refused_before_the_training(tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(UserError, match=r"data\.split: no frames for test"):
        train(tiny_job(tmp_path, "model=cnn_patch", "data.split={train: 0.5, val: 0.5}"))
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("callbacks.figures=true", r"callbacks\.figures=True: is no callback; null leaves it out"),
        ("logger.tensorboard=5", r"logger\.tensorboard=5: is no logger; null leaves it out"),
    ],
)
def test_what_is_no_callback_is_refused(typed: str, told: str, tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(UserError, match=told):
        train(tiny_job(tmp_path, "model=cnn_patch", f"++{typed}"))


@pytest.mark.slow
def test_the_same_seed_gives_the_same_result_and_another_another(tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    found = []
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        settings = (
            "model=cnn_patch",
            f"seed={seed}",
            "trainer.max_steps=4",
            "callbacks=checkpoints",
        )
        train(tiny_job(tmp_path / name, *settings))
        found.append(numbers(read(tmp_path / name)))
    assert found[0] == found[1]
    assert found[0] != found[2]


def test_a_mesh_of_another_kind_is_refused(
    trained: Path, tmp_path: Path, tiny_scenes: Path
) -> None:
    from posefilter.cli.command import compose_job

    checkpoint = torch.load(trained / "checkpoints" / "best.ckpt", weights_only=True)
    checkpoint["object_model"]["center"] = checkpoint["object_model"]["center"] + 0.05
    torch.save(checkpoint, tmp_path / "moved.ckpt")
    typed = [
        f"checkpoint={tmp_path / 'moved.ckpt'}",
        f"++data.root={tiny_scenes}",
        "console=json",
        "threads=1",
    ]
    with pytest.raises(UserError, match="is not the mesh"):
        evaluate(compose_job("evaluate", HOME / "conf", typed, tmp_path))


@pytest.mark.slow
def test_plain_is_for_machines(
    tiny_scenes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Every line on stdout is a JSON object, the last one tells where everything is; stderr is
    silent.
    """
    typed = [
        "debug=smoke",
        "model=cnn_patch",
        "console=json",
        "threads=1",
        "trainer.max_steps=4",
        "logger=none",
    ]
    assert (
        run_command("train", HOME, [*typed, f"data.root={tiny_scenes}", f"out={tmp_path / 'run'}"])
        == 0
    )
    out, err = capfd.readouterr()
    lines = [json.loads(line) for line in out.splitlines()]
    assert [line["event"] for line in lines] == ["started", "validation", "trained"]
    assert lines[-1]["iou"] == read(tmp_path / "run")["iou"]
    assert all(Path(path).exists() for path in lines[-1]["files"].values())
    assert err == ""


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("filter/initialize=from_depth", "filter/initialize=from_depth.*patch_pf"),
        ("filter/initialize=from_objectness model/encoder=pyramid", "from_objectness.*patch_pf"),
        ("filter/resample=auxiliary model/encoder=none", "filter/resample=auxiliary"),
        ("filter/refine=rescore", "refine.*patch_pf"),
    ],
)
def test_components_that_do_not_fit_are_refused_before_any_training(
    choice: str, words: str, tiny_job, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=words):
        train(tiny_job(tmp_path, "model=patch_pf", *choice.split()))
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.parametrize("resample", ["optimal_transport_sampled", "optimal_transport"])
@pytest.mark.slow
def test_particles_are_resampled_by_optimal_transport(
    resample: str, tiny_job, tmp_path: Path
) -> None:
    settings = ("model=patch_pf", "trainer.max_steps=2", "callbacks=checkpoints")
    train(tiny_job(tmp_path, f"filter/resample={resample}", *settings))
    assert 0 <= read(tmp_path)["particles_on_object"] <= 1
