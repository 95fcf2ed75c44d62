"""Filter health against clouds made by hand."""

import math

import numpy as np
import pytest
import torch

from posefilter.callbacks.health import measure_health, name_scalars
from posefilter.figures.curves import choose_bounds, choose_ticks, draw_health
from posefilter.geometry.pose import move_about
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.metrics.registry import find_metric
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace


def trace_of(
    states: list[torch.Tensor], weights: list[torch.Tensor], sigmas: list[torch.Tensor]
) -> Trace:
    history, outputs, steps = [], [], []
    for t, (state, w, sigma) in enumerate(zip(states, weights, sigmas, strict=True)):
        B, N = w.shape
        history.append(Particles(state, torch.zeros(B, N, 0), w.log(), torch.zeros(B, N).long()))
        likely = torch.arange(N).float().expand(B, N) * (t + 1)
        # what particles that are poses predict
        predicted = state if state.dim() == 4 else torch.eye(4).expand(B, N, 4, 4)
        outputs.append(
            ParticleOutput(likely, torch.zeros(B, N, 2), predicted, torch.zeros(B, N, 0))
        )
        steps.append(Step(t, len(states), sigma))
    poses = torch.eye(4).expand(len(weights[0]), 1, 4, 4)
    belief = BeliefBatch(
        poses, torch.zeros(len(weights[0]), 1), poses[:, 0], torch.zeros(len(weights[0]))
    )
    return Trace(tuple(history), tuple(outputs), tuple(steps), belief)


def test_pixels_by_hand() -> None:
    states = [torch.tensor([[[0.0, 0.0], [4.0, 0.0]], [[0.0, 0.0], [0.0, 6.0]]])] * 2
    even, one = torch.full((2, 2), 0.5), torch.tensor([[1.0, 0.0], [0.75, 0.25]])
    found = measure_health(
        trace_of(states, [even, one], [torch.tensor(8.0), torch.tensor([4.0, 2.0])]), PixelSpace()
    )
    assert list(found) == ["ess", "spread_px", "sigma_px", "best_log_likelihood"]
    assert found["ess"].tolist() == [[1.0, 0.5], [1.0, pytest.approx(1 / 0.625 / 2)]]
    # weights 3/4 and 1/4 six apart: the variance is 3/16 x 36
    assert found["spread_px"][0].tolist() == [2.0, 0.0]
    assert found["spread_px"][1].tolist() == [3.0, pytest.approx(math.sqrt(6.75))]
    assert found["sigma_px"].tolist() == [[8.0, 4.0], [8.0, 2.0]]
    assert found["best_log_likelihood"].tolist() == [[1.0, 2.0], [1.0, 2.0]]


def test_poses_by_hand() -> None:
    center = torch.tensor([0.1, 0.0, 0.0])
    tangent = torch.tensor([[0.03, 0, 0, 0, 0, 0.2], [-0.03, 0, 0, 0, 0, -0.2]])
    state = move_about(torch.eye(4).expand(2, 4, 4), tangent, center)[None]
    found = measure_health(
        trace_of([state], [torch.full((1, 2), 0.5)], [torch.tensor(0.04)]),
        PoseSpace((0.1, 0.0, 0.0), 0.12),
    )
    # about the object's center, whatever the turn
    assert found["spread_m"].item() == pytest.approx(0.03, rel=1e-4)
    assert found["spread_rad"].item() == pytest.approx(0.2, rel=1e-4)
    assert found["sigma_m"].item() == pytest.approx(0.04)


def test_scalars_are_named_by_step() -> None:
    found = name_scalars(
        {"ess": [0.1 * i for i in range(101)], "sigma_m": [1.0, 0.5]}, max_steps=11
    )
    assert [name for name in found if "ess" in name][:3] == [
        "filter/ess/step_00",
        "filter/ess/step_10",
        "filter/ess/step_20",
    ]
    assert found["filter/ess/step_100"] == pytest.approx(10.0)
    assert found["filter/sigma_m/step_01"] == 0.5
    assert len(found) == 13
    assert list(name_scalars({"ess": [0.0] * 5}, max_steps=1)) == ["filter/ess/step_04"]


def test_figure_shows_the_numbers_where_its_axes_say() -> None:
    picture = draw_health({"spread_m": [0.1, 0.02], "ess": [0.25, 0.5]}, images=3)
    blue = (picture == (43, 108, 176)).all(-1)
    # of the panels, which have ticks and labels below
    half, high = picture.shape[1] // 2, 190 - 8 - 48
    for columns, first, last in (
        (slice(0, half), 100 / 108, 20 / 108),
        (slice(half, None), 0.25, 0.5),
    ):
        rows, places = np.nonzero(blue[:, columns])
        top = len(picture) - 6 - 48 - high
        assert 1 - (rows[places == places.min()].mean() - top) / (high - 1) == pytest.approx(
            first, abs=0.03
        )
        assert 1 - (rows[places == places.max()].mean() - top) / (high - 1) == pytest.approx(
            last, abs=0.03
        )
    assert find_metric("filter/spread_m").convert(0.1) == 100.0
    assert find_metric("filter/spread_rad").convert(math.pi) == 180.0


def test_axes_hold_the_numbers_and_have_round_ticks() -> None:
    assert choose_bounds(find_metric("filter/ess"), np.array([20.0, 30.0])) == (0.0, 100.0)
    assert choose_bounds(find_metric("filter/spread_m"), np.array([2.0, 10.0])) == pytest.approx(
        (0.0, 10.8)
    )
    low, high = choose_bounds(find_metric("filter/best_log_likelihood"), np.array([-3.0, 5.0]))
    assert low < -3 < 5 < high
    assert choose_bounds(find_metric("filter/sigma_m"), np.array([np.nan])) == (0.0, 1.0)
    assert choose_ticks(0.0, 10.8) == (0.0, 5.0, 10.0)
    assert choose_ticks(-3.6, 5.6) == (-2.5, 0.0, 2.5, 5.0)
