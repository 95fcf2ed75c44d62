"""Ways to spoil a photograph's inputs, and the table that counts what came of them."""

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
import torch
from scipy.stats import f as f_distribution

from posefilter.belief import Belief
from posefilter.data.frames import Sample
from posefilter.geometry.pose import move_about


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


def test_an_error_is_measured_in_the_units_of_the_belief(bench: ModuleType) -> None:
    # center 1 mm and turn 0.02 rad to either side, on each axis
    steps = np.repeat(np.array([1e-3, 0.02]), 3)
    twists = torch.from_numpy(np.concatenate([np.diag(steps), -np.diag(steps)]))
    center = torch.tensor([0.01, 0.02, 0.03], dtype=torch.float64)
    estimate = torch.eye(4, dtype=torch.float64)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    half_turn[:3, 3] = center - half_turn[:3, :3] @ center
    group = torch.stack([torch.eye(4, dtype=torch.float64), half_turn])
    poses = move_about(estimate, twists, center).numpy()
    belief = Belief(poses, np.full(12, 1 / 12), center.numpy(), 0.1, 0.2, "", group.numpy())
    twist = torch.tensor([2e-3, 0, 0, 0, 0, 0.01], dtype=torch.float64)
    truth = move_about(estimate, twist, center) @ half_turn
    said = bench.measure_error(belief, estimate.numpy(), truth.numpy())
    assert said["off"] == pytest.approx([2e-3, 0.01])
    assert said["says"] == pytest.approx([1e-3, 0.02], rel=1e-3)
    assert said["within"] == [False, True]
    # the covariance is a sixth of the squared steps
    squared = 6 * (2**2 + 0.5**2)
    assert said["level"] == pytest.approx(f_distribution.cdf(squared * 5 / 3 / 6, 6, 5), abs=1e-4)


def test_errors_of_right_answers_alone_are_counted(bench: ModuleType) -> None:
    row = {"object": "box", "right": True, "off": [1e-3, 0.1], "says": [2e-3, 0.05]}
    row |= {"within": [True, False], "level": 0.6}
    rows = [row, row | {"right": False, "off": [9.0, 9.0]}, {"object": "can"}]
    lines = bench.tabulate_errors(rows).splitlines()
    assert lines[2:] == [
        f"| {name} | 1 | 1.0 mm, 5.7 degrees | 2.0 mm, 2.9 degrees | 1 | 0 | 0 and 1 |"
        for name in ("box", "all")
    ]
    assert len(bench.tabulate_errors(rows[1:]).splitlines()) == 2  # none is right
