"""Draw particles that are pixels on their way over an image, and what they see on it: the paper's figures 2 and 4."""

import numpy as np
import torch

from posefilter.geometry.lookup import touches
from posefilter.pictures.canvas import TRUTH, Colour, View, draw_dots, draw_lines, strip, whole
from posefilter.pictures.cloud import steps_shown
from posefilter.pictures.overlay import outline
from posefilter.pictures.panels import beside
from posefilter.pictures.sheet import CAPTION, DETAIL, WIDTH, legend, lettered, sheet

ON: Colour = (60, 220, 90)
OFF: Colour = (255, 80, 60)
START: Colour = (250, 220, 60)
_ENDS = (("on the object", ON), ("off it", OFF))
_NUMBER = 40  # [px] where a row's number stands


def hits(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Tell which particles stand on a mask.  (H, W) bool, (*, 2) [px] -> (*) bool."""
    places = torch.from_numpy(np.asarray(pixels, np.float32).reshape(1, -1, 2))
    return touches(torch.from_numpy(mask)[None, None], places)[0].numpy().reshape(pixels.shape[:-1])


def draw_journeys(rgb: np.ndarray, mask: np.ndarray, states: np.ndarray, title: str, most: int = 100) -> np.ndarray:
    """Draw where particles started (yellow), went (lines) and ended (green: on the object, red: off it).

    rgb (H, W, 3) uint8; mask (H, W) bool; states (T, N, 2) [px], `most` of which are drawn. Half a frame more is shown on
    each side where a particle has left it.
    """
    H, W = mask.shape
    path = states[:, :most]
    on = hits(mask, path[-1])
    left = bool(((path < -0.5) | (path > [W - 0.5, H - 0.5])).any())
    view = View(-0.5 - W / 2, -0.5 - H / 2, WIDTH / (2 * W), WIDTH, round(WIDTH * H / W)) if left else whole(H, W, WIDTH)
    picture = view.show(rgb)
    draw_lines(picture, [view.place(line) for line in outline(mask)], (255, 255, 255), 1, closed=True)
    for end, colour in ((False, OFF), (True, ON)):
        chosen = view.place(path[:, on == end])
        draw_lines(picture, list(chosen.transpose(1, 0, 2)), colour, 1, halo=False)
        draw_dots(picture, chosen[0], np.tile(np.array([START]), (chosen.shape[1], 1)), 2)
        draw_dots(picture, chosen[-1], np.tile(np.array([colour]), (chosen.shape[1], 1)), 3.5)
    said = f"{len(states)} steps: {on.mean():.0%} end on the object"
    return sheet(title, lettered(said, CAPTION), picture, legend([("start", START), *_ENDS]))


def draw_glimpses(
    rgb: np.ndarray, mask: np.ndarray, states: np.ndarray, patches: np.ndarray, title: str, most: int = 8
) -> np.ndarray:
    """Draw what a few particles saw, a row a particle, below their way over the image.

    rgb (H, W, 3) uint8; mask (H, W) bool; states (T, n, 2) [px]; patches (T, n, k, k, 3) uint8. Frames are green where the
    particle stands on the object, and red where not. most: steps that are shown, the first and the last among them.
    """
    n, k = patches.shape[1:3]
    on = hits(mask, states)
    view = whole(mask.shape[0], mask.shape[1], WIDTH)
    picture = view.show(rgb)
    draw_lines(picture, [view.place(line) for line in outline(mask)], (255, 255, 255), 1, closed=True)
    for i in range(n):
        way = view.place(states[:, i])
        draw_lines(picture, [way], TRUTH if on[-1, i] else OFF, 2)
        draw_dots(picture, way, np.array([ON if hit else OFF for hit in on[:, i]]), 4)
        draw_dots(picture, way[:1], np.array([START]), 4)
        label(picture, str(i + 1), way[-1])
    shown = steps_shown(len(states), most)
    size = min(90, (WIDTH - _NUMBER) // len(shown))
    rows = [beside([lettered("", CAPTION, _NUMBER), *(lettered(f"step {t}", DETAIL, size) for t in shown)])]
    for i in range(n):
        cells = [np.pad(lettered(str(i + 1), CAPTION, _NUMBER), ((size // 5, 0), (0, 0), (0, 0)), constant_values=255)]
        for t in shown:
            cell = np.full((size, size, 3), 255, np.uint8)
            cell[2:-2, 2:-2] = ON if on[t, i] else OFF
            cell[5:-5, 5:-5] = enlarged(patches[t, i], size - 10)
            cells.append(cell)
        rows.append(beside(cells))
    said = lettered(f"what each saw: {k} x {k} samples", CAPTION)
    return sheet(title, picture, legend([("start", START), *_ENDS]), said, np.concatenate(rows))


def enlarged(patch: np.ndarray, size: int) -> np.ndarray:
    """Return a small picture as a square of `size`, sample by sample."""
    rows = np.minimum(np.arange(size) * len(patch) // size, len(patch) - 1)
    return np.asarray(patch[rows][:, rows])


def label(picture: np.ndarray, text: str, at: np.ndarray) -> None:
    """Write a small number beside a place, in place."""
    note = strip(14 * len(text) + 10, text, size=20)[7:-7, 4:]
    v = int(np.clip(at[1] - 32, 0, picture.shape[0] - note.shape[0]))
    u = int(np.clip(at[0] + 6, 0, picture.shape[1] - note.shape[1]))
    picture[v : v + note.shape[0], u : u + note.shape[1]] = note
