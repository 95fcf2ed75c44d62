"""Pictures of clouds: dots are where particles are, in the color of their weight."""

import math

import numpy as np
import pytest
import torch

from posefilter.figures.canvas import full_view
from posefilter.figures.layout import CAPTION, DETAIL, TITLE, WIDTH, tile_width
from posefilter.figures.particles import (
    choose_by_weight,
    choose_steps,
    color_by_weight,
    describe_step,
    draw_iterations,
    draw_particles,
    measure_off_frame,
)
from posefilter.geometry.pose import make_pose
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace

RGB = np.full((60, 80, 3), 128, np.uint8)
K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])


def trace_of(states: torch.Tensor, weights: torch.Tensor) -> Trace:
    """States (T, N, *S), weights (T, N): one image."""
    T, N = weights.shape
    history = tuple(
        Particles(
            states[t][None], torch.zeros(1, N, 0), weights[t].log()[None], torch.zeros(1, N).long()
        )
        for t in range(T)
    )
    # what particles that are poses predict
    poses = states[-1][None] if states.dim() == 4 else torch.eye(4).expand(1, N, 4, 4)
    output = ParticleOutput(torch.zeros(1, N), torch.zeros(1, N, 2), poses, torch.zeros(1, N, 0))
    steps = tuple(Step(t, T, torch.tensor(0.04 / (t + 1))) for t in range(T))
    return Trace(
        history,
        (output,) * T,
        steps,
        BeliefBatch(poses, weights[-1].log()[None], poses[:, 0], torch.zeros(1)),
    )


def test_dots_are_where_particles_are_and_the_heaviest_on_top() -> None:
    pixels, weights = (
        np.array([[20.0, 10.0], [60.0, 40.0], [60.4, 40.0]]),
        np.array([0.02, 0.08, 0.9]),
    )
    view = full_view(60, 80, 480)
    picture = draw_particles(RGB, pixels, weights, view).astype(int)
    colors = color_by_weight(weights)
    for place, color in (((20.0, 10.0), colors[0]), ((60.4, 40.0), colors[2])):
        u, v = view.place(np.array(place)).round().astype(int)
        assert np.abs(picture[v, u] - color).max() < 12
    plain = picture[view.height // 2, 30]
    assert (plain == plain[0]).all()  # nobody there: faded gray
    assert plain[0] < 128


def test_colors_span_a_tenth_to_ten_times_the_mean() -> None:
    weights = np.full(1000, 1e-3)
    middle = color_by_weight(weights)[0]
    weights[0], weights[1] = 1e-2, 1e-4
    colors = color_by_weight(weights)
    assert np.abs(colors[2].astype(int) - middle).max() <= 1
    assert colors[0].astype(int).sum() > middle.astype(int).sum() > colors[1].astype(int).sum()
    weights[0] = 0.5
    assert (color_by_weight(weights)[0] == colors[0]).all()  # clipped


def test_rows_of_pixels_count_particles_off_the_frame() -> None:
    states = torch.tensor([[[10.0, 10.0], [30.0, 20.0]], [[12.0, 10.0], [300.0, 20.0]]])
    trace = trace_of(states, torch.full((2, 2), 0.5))
    figure = draw_iterations(RGB, K, trace, PixelSpace())
    assert figure.shape[1] == WIDTH
    title = round(TITLE * 1.25) + round(CAPTION * 1.25)
    # below "step 0" and "step 1"
    said = (figure[title : title + round(DETAIL * 1.25)] < 128).all(-1)
    assert said[:, 300:].sum() > 1.3 * said[:, :300].sum()
    assert measure_off_frame(states[1].numpy(), 60, 80) == 0.5
    assert measure_off_frame(
        np.array([[-0.4, 59.4], [79.6, 0.0], [0.0, -0.6]]), 60, 80
    ) == pytest.approx(2 / 3)
    assert describe_step(trace, 1, "px") == "step 1: noise 0.02 px, 100% effective"


def test_rows_of_poses_puts_dots_on_projected_centers() -> None:
    space = PoseSpace((0.0, 0.0, 0.1), 0.1)
    # its center at (0.1, -0.05, 0.8) -> (49.5, 24.5) px
    pose = make_pose(torch.eye(3), torch.tensor([0.1, -0.05, 0.7]))
    trace = trace_of(pose.expand(3, 50, 4, 4), torch.full((3, 50), 0.02))
    figure = draw_iterations(RGB, K, trace, space)
    color = color_by_weight(np.full(50, 0.02))[0].astype(int)
    found = np.argwhere(np.abs(figure.astype(int) - color).max(-1) < 8)
    u, v = full_view(60, 80, tile_width(2)).place(np.array([49.5, 24.5]))
    frame = found[(found[:, 1] < 290) & (found[:, 0] < 290)]  # the first tile
    top = frame[:, 0].mean() - v
    assert abs(frame[:, 1].mean() - 6 - u) < 2
    assert abs(top - round(TITLE * 1.25) - round(CAPTION * 1.25)) < 3
    assert "noise 40 mm" in describe_step(trace, 0, "mm")


def test_axes_are_drawn_by_weight() -> None:
    weights = torch.tensor([0.1, 0.0, 0.7, 0.2], dtype=torch.float64)
    counts = torch.bincount(choose_by_weight(weights, 20), minlength=4)
    assert counts.tolist() == [2, 0, 14, 4]


def test_steps_shown_include_both_ends() -> None:
    assert choose_steps(14, 4) == [0, 4, 9, 13]
    assert choose_steps(2, 4) == [0, 1]
    assert choose_steps(1, 4) == [0]
    assert math.isclose(len(choose_steps(100, 8)), 8)
