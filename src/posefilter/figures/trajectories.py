"""Draw particles that are pixels on their way over an image, and what they see on it: the paper's
figures 2 and 4; and find the way of particles of any kind.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from posefilter.figures.canvas import TRUTH, Color, View, draw_dots, draw_lines, draw_row, full_view
from posefilter.figures.layout import CAPTION, DETAIL, WIDTH, compose_figure, draw_legend, draw_text
from posefilter.figures.overlay import trace_outline
from posefilter.figures.panels import arrange_row
from posefilter.figures.particles import choose_by_weight, choose_steps, normalize_weights
from posefilter.geometry.lookup import is_off_frame, overlaps_mask
from posefilter.protocols import Encoding, HasImagePatches
from posefilter.types import Particles, Trace

ON: Color = (60, 220, 90)
OFF: Color = (255, 80, 60)
START: Color = (250, 220, 60)
_ENDS = (("on the object", ON), ("off it", OFF))
_NUMBER = 40  # [px] where a row's number stands
_STEPS = 8  # at which a particle's glimpses are shown, at most
_PARTICLES = 100  # whose ways are drawn, at most


def find_hits(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Tell which particles stand on a mask.  (H, W) bool, (*, 2) [px] -> (*) bool."""
    places = torch.from_numpy(np.asarray(pixels, np.float32).reshape(1, -1, 2))
    hits = overlaps_mask(torch.from_numpy(mask)[None, None], places)[0]
    return hits.numpy().reshape(pixels.shape[:-1])


def draw_trajectories(
    rgb: np.ndarray, mask: np.ndarray, states: np.ndarray, title: str
) -> np.ndarray:
    """Draw where particles started (yellow), went (lines) and ended (green: on the object, red: off
    it).

    rgb (H, W, 3) uint8; mask (H, W) bool; states (T, N, 2) [px], of which at most a hundred,
    evenly chosen, are drawn. Half a frame more is shown on each side where a particle has left it.
    """
    H, W = mask.shape
    hits, drawn = find_hits(mask, states[-1]), choose_steps(states.shape[1], _PARTICLES)
    path, on = states[:, drawn], hits[drawn]
    view = full_view(H, W, WIDTH)
    if is_off_frame(torch.from_numpy(path), W, H).any():
        view = View(-0.5 - W / 2, -0.5 - H / 2, WIDTH / (2 * W), WIDTH, round(WIDTH * H / W))
    picture = view.show(rgb)
    view.outline(picture, trace_outline(mask), (255, 255, 255), 1)
    for end, color in ((False, OFF), (True, ON)):
        chosen = view.place(path[:, on == end])
        draw_lines(picture, list(chosen.transpose(1, 0, 2)), color, 1, halo=False)
        draw_dots(picture, chosen[0], START, 2)
        draw_dots(picture, chosen[-1], color, 3.5)
    note = f"{len(states)} steps: {hits.mean():.0%} end on the object"
    return compose_figure(
        title, draw_text(note, CAPTION), picture, draw_legend([("start", START), *_ENDS])
    )


def draw_glimpses(
    rgb: np.ndarray,
    mask: np.ndarray,
    states: np.ndarray,
    patches: np.ndarray,
    title: str,
) -> np.ndarray:
    """Draw what a few particles saw, a row a particle, below their way over the image.

    rgb (H, W, 3) uint8; mask (H, W) bool; states (T, n, 2) [px]; patches (T, n, k, k, 3) uint8.
    Frames are green where the particle stands on the object, and red where not. Of the
    steps eight are shown, the first and the last among them.
    """
    n, k = patches.shape[1:3]
    on = find_hits(mask, states)
    view = full_view(mask.shape[0], mask.shape[1], WIDTH)
    picture = view.show(rgb)
    view.outline(picture, trace_outline(mask), (255, 255, 255), 1)
    for i in range(n):
        way = view.place(states[:, i])
        draw_lines(picture, [way], TRUTH if on[-1, i] else OFF, 2)
        draw_dots(picture, way, np.array([ON if hit else OFF for hit in on[:, i]]), 4)
        draw_dots(picture, way[:1], START, 4)
        draw_label(picture, str(i + 1), way[-1])
    shown = choose_steps(len(states), _STEPS)
    size = min(90, (WIDTH - _NUMBER) // len(shown))
    heads = [draw_text(f"step {t}", DETAIL, size) for t in shown]
    rows = [arrange_row([draw_text("", CAPTION, _NUMBER), *heads])]
    for i in range(n):
        number = draw_text(str(i + 1), CAPTION, _NUMBER)
        cells = [np.pad(number, ((size // 5, 0), (0, 0), (0, 0)), constant_values=255)]
        for t in shown:
            cell = np.full((size, size, 3), 255, np.uint8)
            cell[2:-2, 2:-2] = ON if on[t, i] else OFF
            cell[5:-5, 5:-5] = enlarge(patches[t, i], size - 10)
            cells.append(cell)
        rows.append(arrange_row(cells))
    note = draw_text(f"what each saw: {k} x {k} samples", CAPTION)
    return compose_figure(
        title, picture, draw_legend([("start", START), *_ENDS]), note, np.concatenate(rows)
    )


def enlarge(patch: np.ndarray, size: int) -> np.ndarray:
    """Return a small picture as a square of `size`, sample by sample."""
    rows = np.minimum(np.arange(size) * len(patch) // size, len(patch) - 1)
    return np.asarray(patch[rows][:, rows])


def draw_label(picture: np.ndarray, text: str, at: np.ndarray) -> None:
    """Write a small number beside a place, in place."""
    note = draw_row(14 * len(text) + 10, text, size=20)[7:-7, 4:]
    v = int(np.clip(at[1] - 32, 0, picture.shape[0] - note.shape[0]))
    u = int(np.clip(at[0] + 6, 0, picture.shape[1] - note.shape[1]))
    picture[v : v + note.shape[0], u : u + note.shape[1]] = note


def trace_lineage(history: Sequence[Particles]) -> Tensor:
    """Return where each particle of the last step, and its ancestors before it, stood.  -> (B, T,
    N, *S).
    """
    last = history[-1]
    rows = torch.arange(len(last.state), device=last.state.device)[:, None]
    index = torch.arange(last.state.shape[1], device=last.state.device).expand(len(last.state), -1)
    path = []
    for particles in reversed(history):
        path.append(particles.state[rows, index])
        index = particles.ancestors[rows, index]
    return torch.stack(path[::-1], dim=1)


def follow_particles(trace: Trace, max_particles: int = 8) -> Tensor:
    """Return the ways of a few particles of one image, chosen by their last weight.  -> (T, n, 2)
    [px].
    """
    chosen = choose_by_weight(normalize_weights(trace.particles[-1]), max_particles).unique()
    return trace_lineage(trace.particles)[0][:, chosen]


def extract_glimpses(method: HasImagePatches, encoding: Encoding, states: Tensor) -> np.ndarray:
    """Return what particles see where they stand in one image, its colors.

    (T, n, 2) [px] -> (T, n, k, k, 3) uint8.
    """
    seen = method.image_patches(encoding, states.flatten(0, 1)[None])[0, :, :3]
    colors = ((seen + 1) / 2).clamp(0, 1).mul(255).round().byte().cpu()
    return colors.unflatten(0, states.shape[:2]).permute(0, 1, 3, 4, 2).numpy()
