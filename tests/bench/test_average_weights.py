"""The average of weights before and after a training."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.models.quantization import unpack
from posefilter.weights import find_weights


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/average_weights.py")


def test_floating_weights_lie_between_and_counts_are_the_later(bench: ModuleType) -> None:
    before = {"a": torch.tensor([0.0, 4.0]).half(), "n": torch.tensor(3)}
    after = {"a": torch.tensor([2.0, 0.0]), "n": torch.tensor(9)}
    found = bench.average(before, after, 0.25)
    torch.testing.assert_close(found["a"], torch.tensor([0.5, 3.0]))
    assert found["n"] == 9


def test_a_surface_term_that_is_new_is_scaled_at_its_end_alone(bench: ModuleType) -> None:
    names = ("likelihood.surface.enter.weight", "likelihood.surface.leave.weight")
    found = bench.average({}, {name: torch.ones(2) for name in names}, 0.25)
    torch.testing.assert_close(found[names[0]], torch.ones(2))
    torch.testing.assert_close(found[names[1]], 0.25 * torch.ones(2))


def test_weights_of_another_network_are_refused(bench: ModuleType) -> None:
    with pytest.raises(ValueError, match="other: the file has no such weights"):
        bench.average({}, {"other": torch.ones(2)}, 0.5)
    with pytest.raises(ValueError, match=r"a: \(3,\) before, \(2,\) after"):
        bench.average({"a": torch.ones(3)}, {"a": torch.ones(2)}, 0.5)


def test_a_file_that_is_no_checkpoint_is_one_line(
    bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd
) -> None:
    (tmp_path / "run.ckpt").write_text("x")
    typed = ["003_cracker_box", str(tmp_path / "run.ckpt"), str(tmp_path / "out.ckpt")]
    monkeypatch.setattr("sys.argv", ["average_weights", *typed])
    assert bench.main() == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert "run.ckpt: not readable as a checkpoint" in line
    assert not (tmp_path / "out.ckpt").exists()


@pytest.mark.parametrize("keep", [True, False])
def test_recipe_and_object_are_the_runs_or_the_files(
    bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: bool
) -> None:
    file = read_checkpoint(find_weights("003_cracker_box"))
    state = {name: value + 1 for name, value in unpack(file["state_dict"]).items()}
    run = {**file, "state_dict": state, "object_model": {**file["object_model"], "radius": 2.0}}
    torch.save(run, tmp_path / "run.ckpt")
    typed = ["003_cracker_box", str(tmp_path / "run.ckpt"), str(tmp_path / "out.ckpt")]
    monkeypatch.setattr("sys.argv", ["average_weights", *typed, *["--keep"] * keep])
    assert bench.main() == 0
    out = read_checkpoint(tmp_path / "out.ckpt")
    source = file if keep else run
    assert out["object_model"]["radius"] == source["object_model"]["radius"]
    assert ("calibration" in out) is not keep
    for name, value in out["state_dict"].items():
        if value.is_floating_point():
            torch.testing.assert_close(value, state[name] - 0.5)
