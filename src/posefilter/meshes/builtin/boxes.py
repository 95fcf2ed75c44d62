"""Smaller printed boxes and the foam brick."""

import cv2
import numpy as np

from posefilter.meshes.builtin.printing import (
    BLACK,
    BLUE,
    CREAM,
    GREEN,
    GREY,
    LIME,
    NAVY,
    ORANGE,
    RED,
    WHITE,
    YELLOW,
    Canvas,
)

SUGAR_SIZE = (0.0927, 0.0451, 0.1763)  # width, depth, height [m]: YCB's sugar box as scanned
GELATIN_SIZE = (0.0892, 0.0300, 0.0731)  # YCB's gelatin box, standing
BRICK_SIZE = (0.0779, 0.0526, 0.0512)  # YCB's foam brick
_FACES = ("front", "back", "left", "right", "top", "bottom")


def sugar_faces() -> dict[str, np.ndarray]:
    """Return the prints of a yellow and white sugar box.  face -> (h, w, 3) uint8 RGB."""
    width, depth, height = (1000 * s for s in SUGAR_SIZE)
    front = Canvas(width, height, YELLOW)
    front.rect((0, 0, width, 22), NAVY).text("PURE CANE", (10, 4, width - 10, 19), WHITE, 0.12)
    front.ellipse(width / 2, 62, 42, 30, WHITE).ellipse(width / 2, 62, 38, 26, BLUE)
    front.text("DULSA", (13, 46, width - 13, 78), WHITE, 0.18)
    front.text("SUGAR", (16, 98, width - 16, 122), NAVY, 0.16)
    for x, y in ((30, 148), (48, 152), (40, 138), (62, 146), (54, 136)):
        front.rect((x - 7, y - 7, x + 7, y + 7), (214, 214, 206)).rect(
            (x - 6, y - 6, x + 5, y + 5), WHITE
        )
    front.text("1 kg", (66, 158, 90, 172), NAVY, 0.12)
    back = Canvas(width, height, WHITE)
    back.rect((0, 0, width, 22), YELLOW).text("BAKE WITH DULSA", (6, 4, width - 6, 18), NAVY, 0.12)
    back.ellipse(46, 62, 30, 12, ORANGE).ellipse(46, 54, 26, 14, (150, 92, 44)).ellipse(
        46, 46, 20, 7, CREAM
    )
    back.lines((8, 86, width - 8, 128), NAVY, 4, 11).barcode((40, 136, 86, 168), 12).ellipse(
        20, 152, 12, 12, GREEN
    )
    left = Canvas(depth, height, NAVY)
    left.nutrition((4, 14, depth - 4, 112), 13).text(
        "DULSA", (4, 122, depth - 4, 140), YELLOW, 0.16
    )
    left.lines((6, 146, depth - 6, 170), WHITE, 3.6, 14)
    right = Canvas(depth, height, YELLOW)
    right.text("DULSA", (8, 8, depth - 8, 120), BLUE, 0.18, turned=True).ellipse(
        depth / 2, 146, 16, 16, RED
    )
    right.text("NEW", (depth / 2 - 13, 138, depth / 2 + 13, 154), WHITE, 0.16)
    top = Canvas(width, depth, YELLOW)
    top.rect((0, 0, width, 8), NAVY).text("SUGAR", (8, 12, 60, 40), NAVY, 0.16).ellipse(
        76, 26, 11, 11, GREY
    )
    bottom = Canvas(width, depth, GREY)
    bottom.lines((8, 8, 50, 38), BLACK, 4.2, 15).rect((60, 10, 84, 34), WHITE)
    return _six(front, back, left, right, top, bottom)


def gelatin_faces() -> dict[str, np.ndarray]:
    """Return the prints of a small pink and white dessert box.  face -> (h, w, 3) uint8 RGB."""
    width, depth, height = (1000 * s for s in GELATIN_SIZE)
    pink, berry = (232, 92, 138), (150, 14, 60)
    front = Canvas(width, height, berry)
    front.fade((0, 0, width, height), (236, 60, 110), berry)
    front.text("WOBBLI", (5, 5, 84, 28), WHITE, 0.18)
    for x, y in ((24, 52), (38, 60), (30, 40)):
        front.ellipse(x, y, 9, 10, RED).ellipse(x - 3, y - 3, 1.4, 1.8, YELLOW).ellipse(
            x + 3, y + 2, 1.4, 1.8, YELLOW
        )
        front.polygon([(x - 6, y - 8), (x + 6, y - 8), (x, y - 13)], GREEN)
    front.polygon([(54, 66), (60, 40), (78, 40), (84, 66)], pink).ellipse(
        69, 40, 9, 3, (250, 170, 196)
    )
    back = Canvas(width, height, WHITE)
    back.rect((0, 0, width, 14), pink).text("HOW TO MAKE", (6, 2, 60, 12), WHITE, 0.13)
    back.lines((6, 20, 52, 66), berry, 3.6, 21).barcode((56, 34, 84, 62), 22)
    left = Canvas(depth, height, WHITE).nutrition((3, 4, depth - 3, height - 4), 23)
    right = Canvas(depth, height, pink).text(
        "WOBBLI", (5, 5, depth - 5, height - 5), WHITE, 0.18, turned=True
    )
    top = Canvas(width, depth, berry).text("STRAWBERRY", (5, 6, width - 5, depth - 6), WHITE, 0.14)
    bottom = (
        Canvas(width, depth, LIME)
        .text("85 g", (6, 6, 34, 24), BLACK, 0.12)
        .lines((42, 5, 84, 26), BLACK, 4, 24)
    )
    return _six(front, back, left, right, top, bottom)


def brick_faces() -> dict[str, np.ndarray]:
    """Return six faces of red foam: speckle, alike on all sides.  face -> (h, w, 3) uint8 RGB."""
    width, depth, height = (1000 * s for s in BRICK_SIZE)
    sizes = [(width, height)] * 2 + [(depth, height)] * 2 + [(width, depth)] * 2
    rng = np.random.default_rng(31)
    out = {}
    for face, (w, h) in zip(_FACES, sizes, strict=True):
        foam = Canvas(w, h, (152, 44, 40)).image.astype(np.float32)
        noise = rng.standard_normal(foam.shape[:2]).astype(np.float32)
        fine, coarse = cv2.GaussianBlur(noise, (0, 0), 1.2), cv2.GaussianBlur(noise, (0, 0), 5)
        foam += (8 * fine / fine.std() + 5 * coarse / coarse.std())[..., None]
        out[face] = np.clip(foam, 0, 255).astype(np.uint8)
    return out


def _six(*pages: Canvas) -> dict[str, np.ndarray]:
    return {face: page.image for face, page in zip(_FACES, pages, strict=True)}
