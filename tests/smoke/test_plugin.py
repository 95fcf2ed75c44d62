"""The example plug-in: a loss, a likelihood, a reader and a method of one's own, trained and
tested.
"""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import posefilter.cli.trust
from posefilter.cli import run_command
from posefilter.cli.trust import ENTRY_POINTS, installed
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
    own = ["plugins=[posefilter_example]", *TINY, f"data.root={root}", f"out={out}"]
    return run_command("train", None, [*own, *typed])


@pytest.fixture
def forget_trust(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Trust nothing that another test has, and forget what this one does."""
    monkeypatch.setattr("posefilter.cli.trust._trusted", set())
    installed.cache_clear()
    yield
    installed.cache_clear()


@pytest.mark.slow
def test_method_reader_and_loss_of_ones_own(
    npz_scenes: Path,
    tmp_path: Path,
    forget_trust: None,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.syspath_prepend(str(PLUGIN))
    run = tmp_path / "run"
    assert train(npz_scenes, run, "model=color_walk", "loss=brier", "data=npz") == 0
    following = json.loads(capfd.readouterr().out.splitlines()[-1])["next"]
    assert any("evaluate" in line and "plugins=[posefilter_example]" in line for line in following)
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


@pytest.mark.slow
def test_a_method_of_ones_own_whose_particles_are_poses(
    tiny_scenes: Path, tmp_path: Path, forget_trust: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(PLUGIN))
    assert train(tiny_scenes, tmp_path / "run", "model=depth_fit", "trainer.max_steps=4") == 0
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["add"]["auc"] >= 0
    drawn = {file.stem.removeprefix("validation_") for file in (tmp_path / "run").rglob("*.jpg")}
    assert "belief" in drawn  # it said that its particles are poses


@pytest.fixture
def entry_point(tmp_path: Path) -> Path:
    """Return a folder that says, as pip does, that the example is installed."""
    about = tmp_path / "site" / "posefilter_example-0.1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: posefilter-example\nVersion: 0.1.0\n"
    )
    points = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["entry-points"]
    ((name, package),) = points[ENTRY_POINTS].items()
    (about / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\n{name} = {package}\n")
    return about.parent


@pytest.mark.slow
def test_likelihood_of_ones_own(
    tiny_scenes: Path,
    tmp_path: Path,
    entry_point: Path,
    forget_trust: None,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Trained where it is named; its checkpoint predicts where it is trusted, and only there."""
    monkeypatch.syspath_prepend(str(PLUGIN))
    run = tmp_path / "run"
    plain = ["model/proposals=none", "filter/initialize=from_depth", "filter/refine=none"]
    assert train(tiny_scenes, run, "model=pose_pf", "model/likelihood=linear", *plain) == 0
    assert json.loads((run / "metrics.json").read_text())["add"]["auc"] >= 0

    rgb = next(tiny_scenes.rglob("*.left.jpg"))
    depth = rgb.with_name(rgb.name.replace(".jpg", ".depth.png"))
    typed = [f"checkpoint={run}/checkpoints/best.ckpt", f"rgb={rgb}", f"depth={depth}"]
    typed += ["intrinsics=150,150,80,60", "console=json", "threads=1", f"out={tmp_path / 'found'}"]
    posefilter.cli.trust._trusted.clear()
    assert run_command("predict", None, typed) == 2
    assert "packages that you trust: plugins=[posefilter_example]" in capfd.readouterr().err
    assert run_command("predict", None, [*typed, "plugins=[posefilter_example]"]) == 0
    pose = json.loads((tmp_path / "found" / "pose.json").read_text())
    assert pose["object"] == "carton"

    posefilter.cli.trust._trusted.clear()
    installed.cache_clear()
    monkeypatch.syspath_prepend(str(entry_point))
    assert run_command("predict", None, typed) == 0
    assert run_command("train", None, ["--cfg", "job", "model/likelihood=linear"]) == 0
    assert json.loads((tmp_path / "found" / "pose.json").read_text())["score"] == pose["score"]
