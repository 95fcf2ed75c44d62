"""The built-in meshes by name: drawn by code, always the same, in the sizes of YCB's objects."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from posefilter.meshes.builtin import boxes as builtin_boxes
from posefilter.meshes.builtin import round as builtin_round
from posefilter.meshes.builtin import vessels as builtin_vessels
from posefilter.meshes.builtin.shapes import Rect, box, weld
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.symmetries import rotation_about, symmetry_group

TEXTURE = 512  # [px] width and height of every texture


def names() -> list[str]:
    """Return the names of the builtin meshes, sorted."""
    return sorted(_BUILDERS)


def build(name: str) -> Mesh:
    """Draw a built-in mesh.

    Raises:
        KeyError: There is none of that name.
    """
    return _BUILDERS[name]()


def make_printed_box(
    name: str, size: tuple[float, float, float], prints: dict[str, np.ndarray]
) -> Mesh:
    """Make a printed box.

    Args:
        name: Of the mesh.
        size: Width, depth, height [m].
        prints: The image (h, w, 3) uint8 of each of the six faces.
    """
    w, d, h = size
    # Front and back side by side, the two narrow sides stacked beside them, lid and base below.
    across = round(TEXTURE * w / (2 * w + d))
    tall = round(TEXTURE * h / (h + d))
    cells = {
        "front": (0, 0, across, tall),
        "back": (across, 0, 2 * across, tall),
        "left": (2 * across, 0, TEXTURE, TEXTURE // 2),
        "right": (2 * across, TEXTURE // 2, TEXTURE, TEXTURE),
        "top": (0, tall, across, TEXTURE),
        "bottom": (across, tall, 2 * across, TEXTURE),
    }
    texture = np.zeros((TEXTURE, TEXTURE, 3), dtype=np.uint8)
    slots: dict[str, Rect] = {}
    for face, (x0, y0, x1, y1) in cells.items():
        size_px = x1 - x0, y1 - y0
        texture[y0:y1, x0:x1] = cv2.resize(prints[face], size_px, interpolation=cv2.INTER_AREA)
        # Half a texel in from the cell's edge, so that bilinear reading never mixes neighbors in.
        left, right = (x0 + 0.5) / TEXTURE, (x1 - 0.5) / TEXTURE
        slots[face] = (left, 1 - (y1 - 0.5) / TEXTURE, right, 1 - (y0 + 0.5) / TEXTURE)
    return weld(name, box(size, slots), texture)


def _brick() -> Mesh:
    """Make the foam brick, which is symmetric under half turns about its three axes."""
    mesh = make_printed_box("brick", builtin_boxes.BRICK_SIZE, builtin_boxes.brick_faces())
    half_turns = [rotation_about(axis, np.pi, mesh.bounds.mean(0)) for axis in np.eye(3)]
    return replace(mesh, symmetries=np.stack([np.eye(4), *half_turns]))


def _bowl() -> Mesh:
    """Make the bowl, which is symmetric under every rotation about z."""
    z_axis = np.array([0, 0, 1.0]), np.zeros(3)
    return replace(builtin_vessels.bowl(), symmetries=symmetry_group(continuous=[z_axis]))


_BUILDERS: dict[str, Callable[[], Mesh]] = {
    "banana": builtin_vessels.banana,
    "bleach_bottle": builtin_round.bleach_bottle,
    "bowl": _bowl,
    "brick": _brick,
    "carton": lambda: make_printed_box(
        "carton", builtin_boxes.CARTON_SIZE, builtin_boxes.carton_faces()
    ),
    "coffee_can": builtin_round.coffee_can,
    "gelatin_carton": lambda: make_printed_box(
        "gelatin_carton", builtin_boxes.GELATIN_SIZE, builtin_boxes.gelatin_faces()
    ),
    "marker": builtin_vessels.marker,
    "mug": builtin_vessels.mug,
    "mustard_bottle": builtin_round.mustard_bottle,
    "pitcher": builtin_vessels.pitcher,
    "soup_can": builtin_round.soup_can,
    "sugar_carton": lambda: make_printed_box(
        "sugar_carton", builtin_boxes.SUGAR_SIZE, builtin_boxes.sugar_faces()
    ),
    "tuna_can": builtin_round.tuna_can,
}
