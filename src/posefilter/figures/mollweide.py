"""A map of the sphere on which areas are true (Mollweide), and colors for the third angle of a
rotation.
"""

import math
from functools import cache

import numpy as np
import torch
from PIL import Image, ImageDraw

from posefilter.figures.canvas import INK, PAPER, Color, draw_lines, load_font
from posefilter.figures.layout import DETAIL, WIDTH, draw_scale
from posefilter.figures.panels import map_colors

_GRID: Color = (205, 209, 214)
_INK: Color = (96, 102, 112)
_WORDS = (  # longitude and latitude [degrees], and what is there
    (-90, 0, "left"), (0, 0, "to the camera"), (90, 0, "right"),
    (0, -60, "60° down"), (0, -30, "30° down"), (0, 30, "30° up"), (0, 60, "60° up"),
)  # fmt: skip
_CLEARANCE = 70.0  # [px] of a mark, within which nothing is written
_RIM = 0.01  # of the width, left free beside the map
# the projection's auxiliary angle, tabled: 2 t + sin 2 t = pi sin(latitude)
# denser at the poles, where it is steep
_ANGLE = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 721)) * np.pi / 2
_LATITUDE = np.arcsin(np.clip((2 * _ANGLE + np.sin(2 * _ANGLE)) / np.pi, -1, 1))


def map_to_sphere(
    rotations: torch.Tensor, axis: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return where an axis of the object points, and the turn about it.  (*, 3, 3)
    camera_from_object -> (*) x 3 [rad].

    Longitude: 0 towards the camera, positive to the image's right; latitude: positive upwards in
    the image; tilt: the angle of the object's next axis from "up" at that point of the sphere,
    clockwise as seen from outside it.
    """
    direction, other = rotations[..., axis], rotations[..., (axis + 1) % 3]
    longitude = torch.atan2(direction[..., 0], -direction[..., 2])
    latitude = torch.asin((-direction[..., 1]).clamp(-1, 1))
    east = torch.stack([longitude.cos(), torch.zeros_like(longitude), longitude.sin()], -1)
    north = torch.linalg.cross(direction, east)
    return longitude, latitude, torch.atan2((other * east).sum(-1), (other * north).sum(-1))


def project_to_map(longitude: np.ndarray, latitude: np.ndarray, width: int) -> np.ndarray:
    """Return where places are on a map of `width` and half as high.

    (P,), (P,) [rad] -> (P, 2) [px].
    """
    angle = np.interp(latitude, _LATITUDE, _ANGLE)
    reach = (0.5 - _RIM) * width
    u = reach * np.asarray(longitude) / np.pi * np.cos(angle)
    return np.stack([width / 2 + u, width / 4 - reach / 2 * np.sin(angle)], -1)


def draw_blank_map(width: int) -> np.ndarray:
    """Return the empty map: its rim, meridians and parallels, and where they lie as the camera sees
    it.  -> picture.
    """
    return _draw_blank(width).copy()


@cache
def _draw_blank(width: int) -> np.ndarray:
    picture = np.full((width // 2, width, 3), PAPER, np.uint8)
    line = np.linspace(-np.pi / 2, np.pi / 2, 91)

    def project_meridian(degrees: float) -> np.ndarray:
        return project_to_map(np.full(91, np.deg2rad(degrees)), line, width)

    grid = [project_meridian(degrees) for degrees in range(-135, 136, 45)]
    levels = (np.full(91, np.deg2rad(degrees)) for degrees in range(-60, 61, 30))
    grid += [project_to_map(2 * line, level, width) for level in levels]
    draw_lines(picture, grid, _GRID, max(1, width // 600), halo=False)
    rim = np.concatenate([project_meridian(180), project_meridian(-180)[::-1]])
    draw_lines(picture, [rim], INK, max(2, width // 400), closed=True, halo=False)
    return picture


def label_map(picture: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Return a map with its directions named: on top of what is drawn there, and away from places
    that are marked.

    Args:
        picture: A map of twice its height.
        taken: Places (M, 2) of marks [px].
    """
    width = picture.shape[1]
    image = Image.fromarray(picture)
    pen, letters = ImageDraw.Draw(image), load_font(DETAIL * width // WIDTH)
    for longitude, latitude, word in _WORDS:
        (at,) = project_to_map(np.deg2rad([longitude]), np.deg2rad([latitude]), width)
        half = letters.getlength(word) / 2
        # below the line, above it, beside it
        for anchor, down in (("mt", 3), ("mb", -3), ("lt", 3), ("rt", 3)):
            middle = at + np.array(
                [{"m": 0, "l": half + 60, "r": -half - 60}[anchor[0]], 14 if down > 0 else -14]
            )
            gap = np.abs(taken.reshape(-1, 2) - middle) - [half, 14]
            if (gap.max(1) > _CLEARANCE / 2).all():
                place, where = (middle[0], at[1] + down), "m" + anchor[1]
                pen.text(place, word, _INK, letters, where, stroke_width=5, stroke_fill=PAPER)
                break
    return np.asarray(image)


def color_by_turn(turn: np.ndarray) -> np.ndarray:
    """Return the colors of turns, which end as they began.  (P,) [rad] -> (P, 3) uint8."""
    return map_colors(np.asarray(turn), -math.pi, math.pi, "hsv")


def draw_turn_scale() -> np.ndarray:
    """Return what the colors mean, as wide as a figure."""
    return draw_scale("rotation: -180°", color_by_turn(np.linspace(-math.pi, math.pi, 256)), "180°")
