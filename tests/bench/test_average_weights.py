"""The average of weights before and after a training."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch


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
