"""Animations and silhouettes: outlines lie on the object, and frames go from one cloud to the
next.
"""

from io import BytesIO

import numpy as np
import torch
from PIL import Image

from posefilter.figures.animation import Animation, encode_gif
from posefilter.figures.canvas import TRUTH, full_view
from posefilter.figures.layout import WIDTH
from posefilter.figures.particles import color_by_weight, draw_iterations
from posefilter.figures.silhouettes import (
    compute_coverage,
    draw_silhouettes,
    outline_hulls,
    project_hulls,
)
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace

H, W = 60, 80
K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])
RGB = np.full((H, W, 3), 128, np.uint8)
HULL = torch.tensor(
    [[x, y, z] for x in (-0.1, 0.1) for y in (-0.06, 0.06) for z in (-0.05, 0.05)],
    dtype=torch.float64,
)


def pose(x: float = 0.0, z: float = 0.8) -> torch.Tensor:
    return make_pose(exp_so3(torch.tensor([0.2, 0.3, 0.4])), torch.tensor([x, 0.0, z])).double()


def trace_of(states: list[torch.Tensor], ancestors: list[list[int]]) -> Trace:
    """States (N, *S) of each step, of one image, evenly weighted."""
    history, outputs = [], []
    for state, own in zip(states, ancestors, strict=True):
        N = len(state)
        # what particles that are poses predict
        predicted = state if state.dim() == 3 else torch.eye(4).expand(N, 4, 4)
        history.append(
            Particles(
                state[None],
                torch.zeros(1, N, 0),
                torch.full((1, N), -np.log(N)),
                torch.tensor([own]),
            )
        )
        outputs.append(
            ParticleOutput(
                torch.zeros(1, N),
                torch.zeros(1, N, 2),
                predicted[None],
                torch.zeros(1, N, 0),
            )
        )
    steps = tuple(Step(t, len(states), torch.tensor(0.04 / (t + 1))) for t in range(len(states)))
    belief = BeliefBatch(
        torch.eye(4)[None, None], torch.zeros(1, 1), torch.eye(4)[None], torch.zeros(1)
    )
    return Trace(tuple(history), tuple(outputs), steps, belief)


def shown_truth() -> tuple[np.ndarray, np.ndarray]:
    """Return which pixels of a 320-pixel view the object covers, from its faces' points, and how
    far each lies inside.
    """
    view = full_view(H, W, 320)
    line = np.linspace(0, 1, 60)
    a, b, c = np.meshgrid(line, line, line)
    corners = HULL.numpy()
    low, high = corners.min(0), corners.max(0)
    solid = low + np.stack([a, b, c], -1).reshape(-1, 3) * (high - low)
    camera = solid @ pose()[:3, :3].numpy().T + pose()[:3, 3].numpy()
    pixels = view.place(camera[:, :2] / camera[:, 2:] * 80 + [39.5, 29.5]).round().astype(int)
    mask = np.zeros((view.height, view.width), bool)
    mask[pixels[:, 1], pixels[:, 0]] = True
    return mask, mask.sum()


def test_silhouettes_cover_the_object_and_nothing_else() -> None:
    mask, count = shown_truth()
    poses = torch.stack([pose(), pose(), pose(0.3), pose(z=-1.0)])
    share = compute_coverage(
        project_hulls(poses, HULL, K), np.array([0.4, 0.2, 0.3, 0.1]), full_view(H, W, 320)
    )
    assert share.max() < 0.91  # the one behind the camera covers nothing
    covered = np.abs(share - 0.6) < 1e-6
    assert (covered & mask).sum() > 0.98 * count
    assert (covered & ~mask).sum() < 0.05 * count


def test_figure_of_silhouettes_shows_the_true_outline_in_every_tile() -> None:
    trace = trace_of([pose(0.01 * t).expand(30, 4, 4) for t in range(6)], [list(range(30))] * 6)
    figure = draw_silhouettes(RGB, K, trace, HULL, pose().numpy(), "silhouettes")
    green = (figure == TRUTH).all(-1)
    rows = np.nonzero(green[:, :290].any(1))[0]
    steps = np.split(rows, np.nonzero(np.diff(rows) > 60)[0] + 1)[:4]
    assert len(steps) == 4
    for step in steps:
        assert green[step[0] : step[-1], 300:].any()  # the close-up, beside it
    yellow = np.array([240, 240, 60])
    # where every particle agrees
    assert (np.abs(figure.astype(int) - yellow).max(-1) < 70).sum() > 2000


def test_close_ups_are_beside_their_frames_however_few_steps_there_are() -> None:
    truth, hull = pose().numpy(), HULL
    for count in (2, 3):
        trace = trace_of([pose().expand(5, 4, 4)] * count, [[0] * 5] * count)
        figures = [
            draw_silhouettes(RGB, K, trace, hull, truth, "silhouettes"),
            draw_iterations(RGB, K, trace, PoseSpace((0.0, 0.0, 0.0), 0.14), "particles"),
        ]
        for figure in figures:
            assert figure.shape[1] == WIDTH
            # rows of the close-ups, beside their frames
            filled = (figure[:, 300:590] != 255).any(-1).mean(1) > 0.98
            assert abs(filled.sum() - count * 218) < 10


def test_pixels_move_from_their_ancestors_to_their_own_positions() -> None:
    first, second = (
        torch.tensor([[10.0, 10.0], [60.0, 40.0]]),
        torch.tensor([[70.0, 40.0], [70.0, 50.0]]),
    )
    trace = trace_of([first, second], [[0, 1], [1, 1]])
    triangle = [np.array([[5.0, 5.0], [9.0, 5.0], [9.0, 9.0]])]
    frames = list(Animation(RGB, K, trace, PixelSpace(), HULL, triangle).frames(between=2))
    assert len(frames) == 3
    view, color = full_view(H, W, 480), color_by_weight(np.full(2, 0.5))[0].astype(int)
    top = (
        int(np.nonzero((frames[0] == TRUTH).all(-1))[0].min())
        - int(view.place(np.array([5.0, 5.0]))[1])
        + 1
    )
    left = (WIDTH - view.width) // 2

    def is_at(frame: np.ndarray, u: float, v: float) -> bool:
        column, row = (view.place(np.array([u, v])) + np.array([left, 0])).round().astype(int)
        return bool(
            np.abs(
                frame[top + row - 1 : top + row + 2, column - 1 : column + 2].astype(int) - color
            )
            .min(-1)
            .min()
            < 12
        )

    assert is_at(frames[0], 10, 10)
    assert is_at(frames[1], 65, 40)  # half-way from (60, 40), whose child it is
    assert not is_at(frames[1], 10, 10)  # that one died out
    assert is_at(frames[2], 70, 50)


def test_animation_of_poses_shows_frame_and_close_up() -> None:
    trace = trace_of([pose(0.02).expand(5, 4, 4), pose().expand(5, 4, 4)], [[0] * 5] * 2)
    target = outline_hulls(project_hulls(pose()[None], HULL, K))
    frames = list(
        Animation(RGB, K, trace, PoseSpace((0.0, 0.0, 0.0), 0.14), HULL, target).frames(between=1)
    )
    green = (frames[-1] == TRUTH).all(-1)
    assert frames[-1].shape[1] == WIDTH
    green = green[: len(green) * 2 // 3]  # the legend is below
    left, right = green[:, :300].any(0), green[:, 300:].any(0)
    assert right.sum() > 1.3 * left.sum()


def test_gif_keeps_frames_their_colors_and_the_last_longest() -> None:
    frames = [np.full((40, 60, 3), 90, np.uint8) for _ in range(4)]
    for i, frame in enumerate(frames):
        frame[10:20, 10 * i : 10 * i + 10] = TRUTH
    with Image.open(BytesIO(encode_gif(frames, milliseconds=100, hold=900))) as animation:
        assert animation.format == "GIF"
        assert animation.n_frames == 4
        for i, frame in enumerate(frames):
            animation.seek(i)
            assert animation.info["duration"] == (900 if i == 3 else 100)
            assert np.abs(np.asarray(animation.convert("RGB")).astype(int) - frame).max() < 16
