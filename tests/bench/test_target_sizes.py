"""How large and bright the target is: percentiles over images."""

from collections.abc import Callable
from types import ModuleType

import torch
from tests.models.toy import scenes


def test_sizes_of_a_loader(load_script: Callable[[str], ModuleType]) -> None:
    batch = scenes(4)
    empty = batch._replace(mask=torch.zeros_like(batch.mask))
    found = load_script("bench/target_sizes.py").measure([batch, empty, batch], 8)  # type: ignore[arg-type]
    assert found["images"] == [8]
    assert found["missing"] == [50.0]
    sizes = batch.mask.flatten(1).sum(1).float()
    assert found["pixels"][1] == sizes.quantile(0.5).round().item()
    assert found["distance"][0] <= found["distance"][1] <= found["distance"][2]


def test_brightness_is_of_the_target_alone(load_script: Callable[[str], ModuleType]) -> None:
    batch = scenes(4)
    color = torch.tensor([0.2, 0.6, 0.4])[None, :, None, None]
    painted = batch._replace(rgb=torch.where(batch.mask, color, torch.ones(()))).rgb
    found = load_script("bench/target_sizes.py").measure([batch._replace(rgb=painted)], 4)  # type: ignore[arg-type]
    assert found["brightness"] == [0.6, 0.6, 0.6]
