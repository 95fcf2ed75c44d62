"""The carton: the default object to train on.

A box of crackers of a brand that does not exist, no two faces alike.
"""

import numpy as np

from posefilter.meshes.builtin.printing import (
    BLACK,
    BLUE,
    BROWN,
    CREAM,
    GREEN,
    KRAFT,
    NAVY,
    ORANGE,
    RED,
    SKY,
    WHITE,
    YELLOW,
    Canvas,
)  # fmt: skip

SIZE = (0.164, 0.072, 0.213)  # width, depth, height [m]: the YCB cracker box as scanned
BRAND = "KRISPO"


def faces() -> dict[str, np.ndarray]:
    """Return each face's print, upright, 3 px a millimeter.  face -> (h, w, 3) uint8 RGB."""
    return {
        "front": _front(),
        "back": _back(),
        "left": _left(),
        "right": _right(),
        "top": _top(),
        "bottom": _bottom(),
    }


def _front() -> np.ndarray:
    page = Canvas(164, 213, RED)
    page.fade((0, 0, 164, 213), (218, 34, 36), (150, 8, 26))
    page.burst(106, 140, 70, 56, (232, 80, 30), 24).burst(106, 140, 54, 44, YELLOW, 24)
    page.polygon([(0, 16), (164, 4), (164, 56), (0, 68)], NAVY)
    page.polygon([(0, 19), (164, 7), (164, 9), (0, 21)], YELLOW).polygon(
        [(0, 63), (164, 51), (164, 53), (0, 65)], YELLOW
    )
    page.text(BRAND, (10, 14, 154, 60), WHITE, 0.17)
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
    page.text("WHOLE", (12, 101, 40, 110), WHITE, 0.14).text(
        "GRAIN", (12, 112, 40, 121), WHITE, 0.14
    )
    page.text("NET 350 g", (6, 200, 44, 210), WHITE, 0.1)
    return page.image


def _back() -> np.ndarray:
    page = Canvas(164, 213, CREAM)
    page.rect((0, 0, 164, 34), BLUE).text(BRAND, (8, 5, 78, 30), WHITE, 0.17).text(
        "SNACK IDEAS", (84, 9, 158, 26), YELLOW, 0.12
    )
    page.ellipse(52, 84, 42, 36, SKY).ellipse(52, 84, 34, 28, WHITE).ellipse(
        52, 84, 28, 22, (212, 70, 40)
    )
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
    page.text("INGREDIENTS", (11, 140, 73, 150), GREEN, 0.12).lines(
        (12, 152, 73, 203), BLACK, 3.6, 2
    )
    page.lines((84, 138, 158, 168), BLUE, 3.8, 3)
    page.barcode((96, 174, 156, 207), 4)
    return page.image


def _left() -> np.ndarray:
    page = Canvas(72, 213, GREEN)
    page.fade((0, 0, 72, 213), (30, 138, 72), (12, 84, 46))
    page.text(BRAND, (6, 6, 66, 30), WHITE, 0.17)
    page.nutrition((7, 36, 65, 150), 5)
    page.lines((8, 158, 64, 178), WHITE, 3.4, 6)
    page.ellipse(36, 194, 15, 13, YELLOW).text("BAKED", (23, 187, 49, 201), RED, 0.14)
    return page.image


def _right() -> np.ndarray:
    page = Canvas(72, 213, ORANGE)
    page.fade((0, 0, 72, 213), (255, 214, 56), (246, 166, 24))
    page.rect((0, 150, 72, 156), NAVY)
    page.text(BRAND, (10, 8, 62, 146), NAVY, 0.16, turned=True)
    page.cracker(24, 180, 32, 15).cracker(52, 194, 26, -22)
    return page.image


def _top() -> np.ndarray:
    page = Canvas(164, 72, NAVY)
    page.rect((0, 0, 164, 6), YELLOW).rect((0, 66, 164, 72), YELLOW)
    page.text(BRAND, (8, 14, 92, 58), WHITE, 0.17)
    page.rect((104, 16, 154, 56), WHITE).text("OPEN HERE", (107, 18, 151, 32), RED, 0.12)
    page.polygon([(120, 36), (138, 36), (129, 52)], RED)
    return page.image


def _bottom() -> np.ndarray:
    page = Canvas(164, 72, KRAFT)
    page.rect((0, 34.5, 164, 37.5), (132, 98, 62))
    page.text("BEST BEFORE 0427", (8, 8, 88, 20), BLACK, 0.1).lines(
        (8, 44, 70, 66), (92, 62, 36), 4, 7
    )
    page.barcode((100, 6, 154, 30), 8)
    page.polygon([(122, 66), (136, 42), (150, 66)], (60, 96, 50)).polygon(
        [(130, 62), (136, 51), (142, 62)], KRAFT
    )
    return page.image
