"""`make pictures`: what it draws of a checkpoint and of the tour, and what it says where something
is not there.
"""

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image, ImageColor
from tests.smoke.conftest import SMALL_POSE_PF

from posefilter.cli.train import train
from posefilter.figures.canvas import TRUTH
from posefilter.report.charts import LIGHT
from posefilter.synthetic.generate import generate

HOME = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return docs/make_pictures.py."""
    return load_script("docs/make_pictures.py")


@pytest.mark.slow
def test_a_checkpoint_is_pictured(script: ModuleType, tiny_job, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Every scene has its tile with the truth's outline in it; the belief and the particles have
    theirs.
    """
    train(
        tiny_job(
            tmp_path / "run",
            "trainer.max_steps=1",
            "trainer.val_check_interval=1",
            "data.limit_test=1",
            *SMALL_POSE_PF,
        )
    )
    few = (1, 1)
    size = (160, 120)
    generate(
        tmp_path / "scenes",
        2,
        object="carton",
        seed=5,
        workers=1,
        size=size,
        distractors=few,
        frames_per_scene=1,
        progress=False,
    )
    out = tmp_path / "pictures"
    script.of_checkpoint(
        tmp_path / "run" / "checkpoints" / "best.ckpt", tmp_path / "scenes", "builtin", out
    )
    shown = np.asarray(Image.open(out / "predictions.jpg").convert("RGB")).astype(int)
    green = np.abs(shown - TRUTH).max(2) < 40
    tile = shown.shape[1] // 2
    assert green[60:, :tile].sum() > 100
    assert green[60:, tile:].sum() > 100
    for name in ("belief", "particles"):
        assert np.asarray(Image.open(out / f"{name}.jpg")).std() > 10
    with Image.open(out / "convergence.webp") as moving:
        assert moving.n_frames > 20


def test_the_tour_is_pictured_as_far_as_it_was_run(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A picture that is there becomes a smaller JPEG; the others are named."""
    (tmp_path / "tour" / "check").mkdir(parents=True)
    Image.fromarray(np.full((300, 2800, 3), (200, 30, 90), np.uint8)).save(
        tmp_path / "tour" / "check" / "contact_sheet.png"
    )
    script.of_tour(tmp_path / "tour", tmp_path / "out")
    shown = Image.open(tmp_path / "out" / "tour_check.jpg")
    assert shown.size == (script.WIDTH, 150)
    assert np.abs(np.asarray(shown).astype(int) - (200, 30, 90)).max() < 6
    said = capsys.readouterr().out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["tour_check.jpg"]
    for name in ("tour_scenes", "tour_train", "tour_predict", "tour_report"):
        assert f"left as it is: {name}.jpg" in said


def test_what_a_filter_s_size_buys_is_pictured_where_it_was_measured(
    script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row a setting, a chart a figure, a color a method; one without a pose has no line in
    ADD's.
    """
    script.of_filters(tmp_path, tmp_path / "out")
    assert "left as it is: filters.jpg" in capsys.readouterr().out
    for axis, table in script.SIZES.items():
        for model, scores in (("downsized", {}), ("pixel_pf", {"add": {"auc": 80.0}})):
            for value in (10, 100):
                run = tmp_path / table / model / f"{axis}={value}"
                run.mkdir(parents=True)
                told = {
                    "overrides": [f"{axis}={value}"],
                    "particles_on_object": 0.9,
                    "seconds_per_image": 0.001 * value,
                }
                (run / "metrics.json").write_text(json.dumps(told | scores))
    script.of_filters(tmp_path, tmp_path / "out")
    shown = np.asarray(Image.open(tmp_path / "out" / "filters.jpg").convert("RGB")).astype(int)
    first, second = (
        np.abs(shown - np.array(ImageColor.getrgb(color))).max(2) < 40 for color in LIGHT.lines[:2]
    )
    third = shown.shape[1] // 3
    for row in np.array_split(np.arange(len(shown)), 2):
        assert all(first[row][:, i * third : (i + 1) * third].sum() > 50 for i in range(3))
        assert [bool(second[row][:, i * third : (i + 1) * third].sum() > 50) for i in range(3)] == [
            True,
            False,
            True,
        ]


def test_mistakes_are_one_line(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:  # type: ignore[no-untyped-def]
    monkeypatch.setattr(
        "sys.argv", ["make_pictures.py", "--checkpoint", str(tmp_path / "none.ckpt")]
    )
    assert script.main() == 2
    assert capsys.readouterr().err.startswith(f"make_pictures: checkpoint={tmp_path / 'none.ckpt'}")


def test_committed_scenes_tell_nothing_of_the_machine_that_made_them() -> None:
    """They can be read without their meshes, and hold no folder's name."""
    for path in (HOME / "docs" / "scenes").rglob("*.json"):
        assert "/" not in json.dumps(json.loads(path.read_text())), path
