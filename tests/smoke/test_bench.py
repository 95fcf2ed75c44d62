"""The measuring programs measure what they say."""

import importlib.util
import time
from pathlib import Path
from types import ModuleType

import pytest

from posefilter.data.module import PoseDataModule

HOME = Path(__file__).parents[2]


def program(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, HOME / "bench" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_waiting_for_data_is_measured(tiny_job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    """A loader that sleeps is waited for; the share grows by what it sleeps."""
    measure = program("loader").measure
    settings = ("model=cnn_patch", f"trainer.default_root_dir={tmp_path}")
    quick = measure(tiny_job(tmp_path / "a", *settings), "memory", 0, 4)
    loaded = PoseDataModule.train_dataloader

    def slowly(self: PoseDataModule):  # type: ignore[no-untyped-def]
        loader = loaded(self)
        collate = loader.collate_fn
        loader.collate_fn = lambda samples: (time.sleep(0.5), collate(samples))[1]
        return loader

    monkeypatch.setattr(PoseDataModule, "train_dataloader", slowly)
    slow = measure(tiny_job(tmp_path / "b", *settings), "memory", 0, 4)
    assert 0 <= quick[2] < slow[2] < 1
    took = 4 / slow[1]  # seconds; the first batch is waited for before the clock starts
    assert slow[2] * took >= 3 * 0.5
