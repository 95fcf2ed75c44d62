"""Ways to spoil a photograph's inputs, and the table that counts what came of them."""

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest

from posefilter.data.frames import Sample


def sample(seed: int) -> Sample:
    """Return a photograph of noise."""
    rng = np.random.default_rng(seed)
    K = np.array([[600.0, 0.0, 320.0], [0.0, 610.0, 240.0], [0.0, 0.0, 1.0]])
    rgb = rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)
    depth = rng.uniform(0.5, 1.0, (4, 6)).astype(np.float32)
    return Sample(rgb, depth, np.ones((4, 6), bool), K, np.eye(4), 0, 0, 1.0)


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/confidence.py")


def test_each_way_spoils_one_input_and_leaves_the_photograph_as_it_was(bench: ModuleType) -> None:
    for name, spoil in bench.SPOILED.items():
        one, before = sample(0), sample(0)
        true = (one.rgb, one.depth, one.intrinsics)
        pairs = zip(spoil(one, sample(1)), true, strict=True)
        changed = sum(not np.array_equal(a, b) for a, b in pairs)
        assert changed == (name != "as_it_is"), name
        for a, b in zip(true, (before.rgb, before.depth, before.intrinsics), strict=True):
            np.testing.assert_array_equal(a, b)


def test_exchanged_intrinsics_have_the_focal_length_as_principal_point(bench: ModuleType) -> None:
    K = bench.SPOILED["fx_cx_exchanged"](sample(0), sample(1))[2]
    np.testing.assert_array_equal(K, [[320, 0, 600], [0, 240, 610], [0, 0, 1]])


def test_the_table_counts_refused_and_confidently_wrong_answers(bench: ModuleType) -> None:
    row = {"object": "box", "image": "a", "input": "depth_x2", "there": True}
    rows = [
        row | {"verdict": "found", "right": False, "probability": 0.9, "wrong_size": True},
        row | {"verdict": "unsure", "right": True, "probability": 0.95},
        row | {"verdict": "refused", "right": False, "probability": 0.0},
        row | {"there": False, "verdict": "found", "probability": 0.99},
    ]
    lines = [line for line in bench.tabulate_spoiled(rows).splitlines() if "depth_x2" in line]
    assert lines == ["| depth_x2 | 3 | 1 | 1 | 1 | 1 | 0.90 | 1 |"]
