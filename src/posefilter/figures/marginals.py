"""Draw the marginals of a belief over one pose: three translations and three rotations."""

import math
from typing import NamedTuple

import numpy as np
import torch

from posefilter.figures.canvas import Color, arrange_grid, load_font
from posefilter.figures.curves import choose_ticks
from posefilter.figures.layout import CAPTION, DETAIL, add_caption, draw_text, tile_width
from posefilter.figures.panels import LEFT, RIGHT, Axis, draw_histogram_panel
from posefilter.geometry.pose import origin_of, rotation_of
from posefilter.geometry.rotation import log_so3
from posefilter.types import ObjectModel

TRUTH: Color = (21, 153, 71)  # darker than on photographs: these are read on white
ESTIMATE: Color = (214, 33, 156)
OBJECT_AXES = "xyz"
CAMERA_AXES = ("right [mm]", "down [mm]", "away [mm]")
_BINS = 25  # of a histogram
_GAP = 4  # [px] between labels of an axis, at least
_ABOUT = tuple(f"about {name} [degrees]" for name in OBJECT_AXES)


def compute_offsets(
    poses: torch.Tensor, reference: torch.Tensor, mean: torch.Tensor, center: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return centers less `mean`, camera axes (*, 3) [m], and rotations from the reference, object
    axes (*, 3) [rad].
    """
    rotation = log_so3(rotation_of(reference).mT @ rotation_of(poses))
    return origin_of(poses, center) - mean, rotation


class Marginal(NamedTuple):
    """One axis of the belief."""

    mass: np.ndarray  # (M,) shares of the belief
    edges: np.ndarray  # (M + 1,)
    marks: tuple[float, ...]  # the estimate's value, and the truth's where it is known
    beyond: float  # share of the belief outside the edges


def compute_marginals(
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    center: torch.Tensor,
) -> tuple[list[Marginal], list[Marginal]]:
    """Return three translations from the mean, camera axes [mm], and three rotations from the
    estimate, object axes [degrees].
    """
    mean = (weights[:, None] * origin_of(poses, center)).sum(0)
    parts = [compute_offsets(p, best, mean, center) for p in (poses, best, true) if p is not None]
    out: tuple[list[Marginal], list[Marginal]] = ([], [])
    for kind, unit in enumerate((1000.0, 180 / math.pi)):
        for i in range(3):
            marks = [float(part[kind][i]) * unit for part in parts[1:]]
            values = parts[0][kind][:, i].numpy() * unit
            out[kind].append(compute_histogram(values, weights.numpy(), marks))
    return out


def draw_marginals(
    poses: torch.Tensor,
    weights: torch.Tensor,
    best: torch.Tensor,
    true: torch.Tensor | None,
    object_model: ObjectModel,
) -> list[np.ndarray]:
    """Draw six weighted histograms, in two rows with what they are above them."""
    translations, rotations = compute_marginals(
        poses, weights, best, true, object_model.center.cpu().double()
    )
    moved = [draw_marginal(*one) for one in zip(translations, CAMERA_AXES, strict=True)]
    turned = [draw_marginal(*one) for one in zip(rotations, _ABOUT, strict=True)]
    heads = ("translation of the center", "rotation about the object's axes")
    above, between = (draw_text(text, CAPTION) for text in heads)
    return [above, arrange_grid(moved, 3), between, arrange_grid(turned, 3)]


def draw_marginal(one: Marginal, label: str) -> np.ndarray:
    """Draw one histogram."""
    low, high = float(one.edges[0]), float(one.edges[-1])
    top = 1.1 * max(float(one.mass.max()), 1e-6)
    x = Axis(label, low, high, choose_few_ticks(low, high, tile_width(3) - LEFT - RIGHT))
    y = Axis("share", 0, top, choose_ticks(0, top, 2))
    marks = list(zip(one.marks, (ESTIMATE, TRUTH), strict=False))[::-1]
    note = f"{one.beyond:.1%} lies beyond" if one.beyond >= 5e-4 else ""
    return add_caption(
        draw_histogram_panel(one.mass, one.edges, marks, x, y, tile_width(3), 160), note, DETAIL
    )


def choose_few_ticks(low: float, high: float, width: int) -> tuple[float, ...]:
    """Return as many ticks as have labels that do not touch each other, three or four at most.

    Args:
        low: Left end of the axis.
        high: Its right end.
        width: Its length [px].
    """
    letters, ticks = load_font(DETAIL), tuple[float, ...]()
    for most, least in ((3, 3), (3, 2), (2, 2), (1, 1)):
        ticks = choose_ticks(low, high, most, least)
        places = [(tick - low) / (high - low) * width for tick in ticks]
        room = np.array([letters.getlength(f"{tick:g}") / 2 for tick in ticks])
        gaps = np.diff(places) - room[:-1] - room[1:]
        if ticks and (gaps >= _GAP).all():
            break
    return ticks


def compute_histogram(values: np.ndarray, weights: np.ndarray, marks: list[float]) -> Marginal:
    """Return a weighted histogram of the middle 95 % and a margin, wide enough for the marks."""
    order = np.argsort(values)
    ends = np.searchsorted(np.cumsum(weights[order]), (0.025, 0.975)).clip(max=len(values) - 1)
    low, high = (float(values[order][end]) for end in ends)
    margin = max(0.3 * (high - low), 1e-2)
    low, high = min(low - margin, *marks), max(high + margin, *marks)
    pad = 0.02 * (high - low)
    places = np.linspace(low - pad, high + pad, _BINS + 1)
    mass, edges = np.histogram(values, places, weights=weights)
    beyond = float(weights[(values < low - pad) | (values > high + pad)].sum())
    return Marginal(mass, edges, (*marks,), beyond)
