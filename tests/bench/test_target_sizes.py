"""How large the target is: percentiles over images."""

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
