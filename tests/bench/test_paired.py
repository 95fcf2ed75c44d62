"""The bench of paired differences: which images are compared, and what is resampled."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from posefilter.metrics.image_errors import FILE, ImageError, write_errors


@pytest.fixture
def paired(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/paired.py")


def _write(folder: Path, errors: dict[str, float]) -> Path:
    folder.mkdir()
    rows = [
        ImageError(0, i, 1, "box", image, 1.0, mm, mm / 2, 100.0, 1.0, 0.0, 0.1)
        for i, (image, mm) in enumerate(errors.items())
    ]
    write_errors(folder / FILE, rows)
    return folder


def test_images_are_paired_by_name(paired: ModuleType, tmp_path: Path) -> None:
    first = paired.read_test(_write(tmp_path / "a", {"s0/0": 10.0, "s1/0": 20.0}))
    second = paired.read_test(_write(tmp_path / "b", {"s1/0": 20.0, "s0/0": 30.0}))
    scenes, errors = paired.pair(first, second)
    assert scenes == ["s0", "s1"]
    assert errors[..., 0].tolist() == [[0.01, 0.02], [0.03, 0.02]]
    assert errors[..., 1].tolist() == [[0.005, 0.01], [0.015, 0.01]]
    other = paired.read_test(_write(tmp_path / "c", {"s0/0": 10.0}))
    with pytest.raises(ValueError, match="same images"):
        paired.pair(first, other)


def test_the_difference_is_resampled_by_scenes(paired: ModuleType) -> None:
    # every scene loses all, however many images it has: the interval has no width
    scenes = ["a", "a", "a", "b"]
    errors = torch.tensor([[0.0] * 4, [0.2] * 4], dtype=torch.float64)
    assert paired.bound_difference(scenes, errors) == pytest.approx((-100.0, -100.0))
    # one of two scenes loses: a quarter of the draws have it twice, a quarter never
    errors[1, :3] = 0.0
    assert paired.bound_difference(scenes, errors) == pytest.approx((-100.0, 0.0))
    assert paired.bound_difference(["a"] * 4, errors) is None
