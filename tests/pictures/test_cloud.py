"""Pictures of clouds: dots are where particles are, in the colour of their weight."""

import math

import numpy as np
import pytest
import torch

from posefilter.geometry.pose import make_pose
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.pictures.canvas import whole
from posefilter.pictures.cloud import (
    caption_of,
    draw_cloud,
    draw_strip,
    off_frame,
    spread_choice,
    steps_shown,
    weight_colours,
)
from posefilter.pictures.sheet import CAPTION, DETAIL, TITLE, WIDTH, tile_width
from posefilter.types import Belief, Cloud, Reading, Step, Trace

RGB = np.full((60, 80, 3), 128, np.uint8)
K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])


def trace_of(states: torch.Tensor, weights: torch.Tensor) -> Trace:
    """States (T, N, *S), weights (T, N): one image."""
    T, N = weights.shape
    clouds = tuple(
        Cloud(states[t][None], torch.zeros(1, N, 0), weights[t].log()[None], torch.zeros(1, N).long()) for t in range(T)
    )
    poses = torch.eye(4).expand(1, N, 4, 4)
    reading = Reading(torch.zeros(1, N), torch.zeros(1, N, 2), poses, torch.zeros(1, N, 0))
    steps = tuple(Step(t, T, torch.tensor(0.04 / (t + 1))) for t in range(T))
    return Trace(clouds, (reading,) * T, steps, Belief(poses, weights[-1].log()[None], poses[:, 0], torch.zeros(1)))


def test_dots_are_where_particles_are_and_the_heaviest_on_top() -> None:
    pixels, weights = np.array([[20.0, 10.0], [60.0, 40.0], [60.4, 40.0]]), np.array([0.02, 0.08, 0.9])
    view = whole(60, 80, 480)
    picture = draw_cloud(RGB, pixels, weights, view).astype(int)
    colours = weight_colours(weights)
    for place, colour in (((20.0, 10.0), colours[0]), ((60.4, 40.0), colours[2])):
        u, v = view.place(np.array(place)).round().astype(int)
        assert np.abs(picture[v, u] - colour).max() < 12
    plain = picture[view.height // 2, 30]
    assert (plain == plain[0]).all()  # nobody there: faded grey
    assert plain[0] < 128


def test_colours_span_a_tenth_to_ten_times_the_mean() -> None:
    weights = np.full(1000, 1e-3)
    middle = weight_colours(weights)[0]
    weights[0], weights[1] = 1e-2, 1e-4
    colours = weight_colours(weights)
    assert np.abs(colours[2].astype(int) - middle).max() <= 1
    assert colours[0].astype(int).sum() > middle.astype(int).sum() > colours[1].astype(int).sum()
    weights[0] = 0.5
    assert (weight_colours(weights)[0] == colours[0]).all()  # clipped


def test_strip_of_pixels_tells_who_left_the_frame() -> None:
    states = torch.tensor([[[10.0, 10.0], [30.0, 20.0]], [[12.0, 10.0], [300.0, 20.0]]])
    trace = trace_of(states, torch.full((2, 2), 0.5))
    sheet = draw_strip(RGB, K, trace, 0, PixelSpace())
    assert sheet.shape[1] == WIDTH
    title = round(TITLE * 1.25) + round(CAPTION * 1.25)
    said = (sheet[title : title + round(DETAIL * 1.25)] < 128).all(-1)  # below "step 0" and "step 1"
    assert said[:, 300:].sum() > 1.3 * said[:, :300].sum()
    assert off_frame(states[1].numpy(), 60, 80) == 0.5
    assert off_frame(np.array([[-0.4, 59.4], [79.6, 0.0], [0.0, -0.6]]), 60, 80) == pytest.approx(2 / 3)
    assert caption_of(trace, 0, 1, "px") == "step 1: noise 0.02 px, 100% effective"


def test_strip_of_poses_puts_dots_on_projected_centres() -> None:
    space = PoseSpace((0.0, 0.0, 0.1), 0.1)
    pose = make_pose(torch.eye(3), torch.tensor([0.1, -0.05, 0.7]))  # its centre at (0.1, -0.05, 0.8) -> (49.5, 24.5) px
    trace = trace_of(pose.expand(3, 50, 4, 4), torch.full((3, 50), 0.02))
    sheet = draw_strip(RGB, K, trace, 0, space)
    colour = weight_colours(np.full(50, 0.02))[0].astype(int)
    found = np.argwhere(np.abs(sheet.astype(int) - colour).max(-1) < 8)
    u, v = whole(60, 80, tile_width(2)).place(np.array([49.5, 24.5]))
    frame = found[(found[:, 1] < 290) & (found[:, 0] < 290)]  # the first tile
    top = frame[:, 0].mean() - v
    assert abs(frame[:, 1].mean() - 6 - u) < 2
    assert abs(top - round(TITLE * 1.25) - round(CAPTION * 1.25)) < 3
    assert "noise 40 mm" in caption_of(trace, 0, 0, "mm")


def test_axes_are_drawn_by_weight() -> None:
    weights = torch.tensor([0.1, 0.0, 0.7, 0.2], dtype=torch.float64)
    counts = torch.bincount(spread_choice(weights, 20), minlength=4)
    assert counts.tolist() == [2, 0, 14, 4]


def test_steps_shown_include_both_ends() -> None:
    assert steps_shown(14, 4) == [0, 4, 9, 13]
    assert steps_shown(2, 4) == [0, 1]
    assert steps_shown(1, 4) == [0]
    assert math.isclose(len(steps_shown(100, 8)), 8)
