"""Printed boxes and the foam brick.

The carton is the default object to train on: a box of crackers of a brand that does not exist, no
two faces alike.
"""

import cv2
import numpy as np

from posefilter.meshes.builtin.printing import (
    BLACK,
    BLUE,
    BROWN,
    CREAM,
    GREEN,
    GREY,
    KRAFT,
    LIME,
    NAVY,
    ORANGE,
    RED,
    SKY,
    WHITE,
    YELLOW,
    Canvas,
)

# width, depth, height [m], as scanned
CARTON_SIZE = (0.164, 0.072, 0.213)  # YCB's cracker box
SUGAR_SIZE = (0.0927, 0.0451, 0.1763)  # YCB's sugar box
GELATIN_SIZE = (0.0892, 0.0300, 0.0731)  # YCB's gelatin box, standing
BRICK_SIZE = (0.0779, 0.0526, 0.0512)  # YCB's foam brick
_BRAND = "KRISPO"  # of the carton
_FACES = ("front", "back", "left", "right", "top", "bottom")


def carton_faces() -> dict[str, np.ndarray]:
    """Return the carton's prints, upright, 3 px a millimeter.  face -> (h, w, 3) uint8 RGB."""
    return _six(_front(), _back(), _left(), _right(), _top(), _bottom())


def _front() -> Canvas:
    page = Canvas(164, 213, RED)
    page.fade((0, 0, 164, 213), (218, 34, 36), (150, 8, 26))
    page.burst(106, 140, 70, 56, (232, 80, 30), 24).burst(106, 140, 54, 44, YELLOW, 24)
    page.polygon([(0, 16), (164, 4), (164, 56), (0, 68)], NAVY)
    page.polygon([(0, 19), (164, 7), (164, 9), (0, 21)], YELLOW)
    page.polygon([(0, 63), (164, 51), (164, 53), (0, 65)], YELLOW)
    page.text(_BRAND, (10, 14, 154, 60), WHITE, 0.17)
    page.text("WHEAT CRACKERS", (10, 70, 110, 84), WHITE, 0.12)
    for x, y, size, turn in (
        (84, 172, 50, 12),
        (132, 160, 48, -20),
        (98, 128, 50, 34),
        (140, 112, 42, 5),
        (44, 190, 40, -30),
    ):
        page.cracker(x, y, size, turn)
    page.ellipse(26, 112, 19, 19, GREEN).ellipse(26, 112, 16.5, 16.5, WHITE, line_mm=0.8)
    page.text("WHOLE", (12, 101, 40, 110), WHITE, 0.14)
    page.text("GRAIN", (12, 112, 40, 121), WHITE, 0.14)
    page.text("NET 350 g", (6, 200, 44, 210), WHITE, 0.1)
    return page


def _back() -> Canvas:
    page = Canvas(164, 213, CREAM)
    page.rect((0, 0, 164, 34), BLUE).text(_BRAND, (8, 5, 78, 30), WHITE, 0.17)
    page.text("SNACK IDEAS", (84, 9, 158, 26), YELLOW, 0.12)
    page.ellipse(52, 84, 42, 36, SKY).ellipse(52, 84, 34, 28, WHITE)
    page.ellipse(52, 84, 28, 22, (212, 70, 40))
    for x, y, color in (
        (42, 78, GREEN),
        (60, 92, YELLOW),
        (64, 76, (240, 240, 220)),
        (46, 94, (90, 150, 50)),
        (54, 84, ORANGE),
    ):
        page.ellipse(x, y, 6, 4.5, color, 30)
    page.cracker(92, 62, 24, 20).cracker(20, 112, 26, -25)
    page.text("TOMATO DIP", (104, 44, 160, 56), RED, 0.12).lines((106, 60, 160, 120), BROWN, 4.2, 1)
    page.rect((0, 128, 164, 132), BLUE)
    page.rect((8, 138, 76, 206), WHITE).rect((8, 138, 76, 206), GREEN, 1.2)
    page.text("INGREDIENTS", (11, 140, 73, 150), GREEN, 0.12)
    page.lines((12, 152, 73, 203), BLACK, 3.6, 2)
    page.lines((84, 138, 158, 168), BLUE, 3.8, 3)
    page.barcode((96, 174, 156, 207), 4)
    return page


def _left() -> Canvas:
    page = Canvas(72, 213, GREEN)
    page.fade((0, 0, 72, 213), (30, 138, 72), (12, 84, 46))
    page.text(_BRAND, (6, 6, 66, 30), WHITE, 0.17)
    page.nutrition((7, 36, 65, 150), 5)
    page.lines((8, 158, 64, 178), WHITE, 3.4, 6)
    page.ellipse(36, 194, 15, 13, YELLOW).text("BAKED", (23, 187, 49, 201), RED, 0.14)
    return page


def _right() -> Canvas:
    page = Canvas(72, 213, ORANGE)
    page.fade((0, 0, 72, 213), (255, 214, 56), (246, 166, 24))
    page.rect((0, 150, 72, 156), NAVY)
    page.text(_BRAND, (10, 8, 62, 146), NAVY, 0.16, turned=True)
    page.cracker(24, 180, 32, 15).cracker(52, 194, 26, -22)
    return page


def _top() -> Canvas:
    page = Canvas(164, 72, NAVY)
    page.rect((0, 0, 164, 6), YELLOW).rect((0, 66, 164, 72), YELLOW)
    page.text(_BRAND, (8, 14, 92, 58), WHITE, 0.17)
    page.rect((104, 16, 154, 56), WHITE).text("OPEN HERE", (107, 18, 151, 32), RED, 0.12)
    page.polygon([(120, 36), (138, 36), (129, 52)], RED)
    return page


def _bottom() -> Canvas:
    page = Canvas(164, 72, KRAFT)
    page.rect((0, 34.5, 164, 37.5), (132, 98, 62))
    page.text("BEST BEFORE 0427", (8, 8, 88, 20), BLACK, 0.1)
    page.lines((8, 44, 70, 66), (92, 62, 36), 4, 7)
    page.barcode((100, 6, 154, 30), 8)
    page.polygon([(122, 66), (136, 42), (150, 66)], (60, 96, 50))
    page.polygon([(130, 62), (136, 51), (142, 62)], KRAFT)
    return page


def sugar_faces() -> dict[str, np.ndarray]:
    """Return the prints of a yellow and white sugar box.  face -> (h, w, 3) uint8 RGB."""
    width, depth, height = (1000 * s for s in SUGAR_SIZE)
    front = Canvas(width, height, YELLOW)
    front.rect((0, 0, width, 22), NAVY).text("PURE CANE", (10, 4, width - 10, 19), WHITE, 0.12)
    front.ellipse(width / 2, 62, 42, 30, WHITE).ellipse(width / 2, 62, 38, 26, BLUE)
    front.text("DULSA", (13, 46, width - 13, 78), WHITE, 0.18)
    front.text("SUGAR", (16, 98, width - 16, 122), NAVY, 0.16)
    for x, y in ((30, 148), (48, 152), (40, 138), (62, 146), (54, 136)):
        front.rect((x - 7, y - 7, x + 7, y + 7), (214, 214, 206))
        front.rect((x - 6, y - 6, x + 5, y + 5), WHITE)
    front.text("1 kg", (66, 158, 90, 172), NAVY, 0.12)
    back = Canvas(width, height, WHITE)
    back.rect((0, 0, width, 22), YELLOW).text("BAKE WITH DULSA", (6, 4, width - 6, 18), NAVY, 0.12)
    back.ellipse(46, 62, 30, 12, ORANGE).ellipse(46, 54, 26, 14, (150, 92, 44))
    back.ellipse(46, 46, 20, 7, CREAM)
    back.lines((8, 86, width - 8, 128), NAVY, 4, 11).barcode((40, 136, 86, 168), 12)
    back.ellipse(20, 152, 12, 12, GREEN)
    left = Canvas(depth, height, NAVY)
    left.nutrition((4, 14, depth - 4, 112), 13)
    left.text("DULSA", (4, 122, depth - 4, 140), YELLOW, 0.16)
    left.lines((6, 146, depth - 6, 170), WHITE, 3.6, 14)
    right = Canvas(depth, height, YELLOW)
    right.text("DULSA", (8, 8, depth - 8, 120), BLUE, 0.18, turned=True)
    right.ellipse(depth / 2, 146, 16, 16, RED)
    right.text("NEW", (depth / 2 - 13, 138, depth / 2 + 13, 154), WHITE, 0.16)
    top = Canvas(width, depth, YELLOW)
    top.rect((0, 0, width, 8), NAVY).text("SUGAR", (8, 12, 60, 40), NAVY, 0.16)
    top.ellipse(76, 26, 11, 11, GREY)
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
        front.ellipse(x, y, 9, 10, RED).ellipse(x - 3, y - 3, 1.4, 1.8, YELLOW)
        front.ellipse(x + 3, y + 2, 1.4, 1.8, YELLOW)
        front.polygon([(x - 6, y - 8), (x + 6, y - 8), (x, y - 13)], GREEN)
    front.polygon([(54, 66), (60, 40), (78, 40), (84, 66)], pink)
    front.ellipse(69, 40, 9, 3, (250, 170, 196))
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
