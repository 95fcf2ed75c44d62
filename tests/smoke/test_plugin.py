"""The example plug-in: a loss, a likelihood, a reader and a method of one's own, trained and
tested.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from posefilter.cli import run_command
from posefilter.data.readers.registry import open_reader

HOME = Path(__file__).parents[2]
PLUGIN = HOME / "examples" / "plugin"
TINY = ["debug=smoke", "console=json", "threads=1", "data.progress=false"]


@pytest.fixture(scope="module")
def npz_scenes(tiny_scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the tiny dataset in the plug-in's own format."""
    out = tmp_path_factory.mktemp("npz")
    reader = open_reader("scenes", tiny_scenes, "carton")
    for i, record in enumerate(reader.records()):
        sample, file = reader.read(i), out / record.group / f"{record.im_id:06d}.npz"
        file.parent.mkdir(exist_ok=True)
        names = ("rgb", "depth", "mask", "intrinsics", "camera_from_object")
        np.savez(file, **{name: getattr(sample, name) for name in names})
    return out


def train(root: Path, out: Path, *typed: str) -> int:
    folder = ["--config-dir", str(PLUGIN / "conf"), "plugins=[posefilter_example]"]
    return run_command("train", None, [*folder, *TINY, f"data.root={root}", f"out={out}", *typed])


def test_method_reader_and_loss_of_ones_own(
    npz_scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(PLUGIN))
    run = tmp_path / "run"
    assert train(npz_scenes, run, "model=color_walk", "loss=brier", "data=npz") == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["instances"] > 0
    assert 0 <= metrics["particles_on_object"] <= 1
    assert metrics["add"] is None
    drawn = {
        file.stem.removeprefix("validation_")
        for file in run.rglob("*")
        if file.suffix in (".jpg", ".gif")
    }
    assert {
        "particles",
        "trajectories",
        "animation",
    } <= drawn  # it said that its particles are pixels
    assert not {"belief", "silhouettes", "field"} & drawn
    checkpoint = run / "checkpoints" / "best.ckpt"
    typed = [
        f"checkpoint={checkpoint}",
        "plugins=[posefilter_example]",
        "console=json",
        "threads=1",
    ]
    where = [f"data.root={npz_scenes}", f"out={tmp_path / 'tested'}"]
    assert run_command("evaluate", None, [*typed, *where]) == 0
    again = json.loads((tmp_path / "tested" / "metrics.json").read_text())
    assert again["particles_on_object"] == metrics["particles_on_object"]
    capfd.readouterr()
    assert train(npz_scenes, tmp_path / "b", "model=color_walk", "loss=add", "data=npz") == 2
    assert "loss=add does not fit model=color_walk" in capfd.readouterr().err


def test_likelihood_of_ones_own(
    tiny_scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(PLUGIN))
    run = tmp_path / "run"
    plain = ["model/proposals=none", "filter/initialize=from_depth", "filter/refine=none"]
    assert train(tiny_scenes, run, "model=pose_pf", "model/likelihood=linear", *plain) == 0
    assert json.loads((run / "metrics.json").read_text())["add"]["auc"] >= 0
