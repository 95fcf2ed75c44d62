"""The measuring programs measure what they say."""

import time
from pathlib import Path

import pytest

from posefilter.data.module import PoseDataModule


@pytest.mark.slow
def test_waiting_for_data_is_measured(
    load_script, tiny_job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # type: ignore[no-untyped-def]
    """A loader that sleeps is waited for; the share grows by what it sleeps."""
    measure = load_script("bench/loader.py").measure
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
