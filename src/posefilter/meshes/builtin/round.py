"""Cans and bottles; and how the texture of round things is laid out."""

import cv2
import numpy as np

from posefilter.meshes.builtin.printing import (
    BLACK,
    BLUE,
    BROWN,
    CREAM,
    GREEN,
    GREY,
    NAVY,
    ORANGE,
    RED,
    SKY,
    WHITE,
    YELLOW,
    Canvas,
    Color,
)
from posefilter.meshes.builtin.shapes import Rect, disc, join, lathe, weld
from posefilter.meshes.mesh import Mesh

# The texture: the side's print above, below it the lid, the base, and a swatch for caps and
# handles.
TEXTURE = 512  # [px]
_STRIP = 172  # [px] height of the lower part
SIDE: Rect = (0.5 / TEXTURE, (_STRIP + 0.5) / TEXTURE, 1 - 0.5 / TEXTURE, 1 - 0.5 / TEXTURE)
_MIDDLE = _STRIP / 2 / TEXTURE
LID, BASE, RADIUS = (_MIDDLE, _MIDDLE), (3 * _MIDDLE, _MIDDLE), _MIDDLE * 0.97
SWATCH: Rect = ((2 * _STRIP + 2) / TEXTURE, 2 / TEXTURE, 1 - 2 / TEXTURE, (_STRIP - 2) / TEXTURE)
METAL = (188, 190, 192)
Profile = list[tuple[float, ...]]


def texture(side: Canvas, lid: Canvas, base: Canvas, swatch: Canvas) -> np.ndarray:
    """Lay out the four prints.  -> (512, 512, 3) uint8 RGB."""
    upper = _fit(side, TEXTURE, TEXTURE - _STRIP)
    flat, rest = [_fit(page, _STRIP, _STRIP) for page in (lid, base)], TEXTURE - 2 * _STRIP
    return np.vstack([upper, np.hstack([*flat, _fit(swatch, rest, _STRIP)])])


def _fit(page: Canvas, width: int, height: int) -> np.ndarray:
    return cv2.resize(page.image, (width, height), interpolation=cv2.INTER_AREA)


def _metal_lid(radius_mm: float) -> Canvas:
    size = 2 * radius_mm
    page = Canvas(size, size, METAL)
    for share, shade in ((0.86, 150), (0.82, 205), (0.62, 168), (0.58, 196)):
        ring = share * radius_mm
        page.ellipse(radius_mm, radius_mm, ring, ring, (shade, shade, shade + 2))
    return page


def _can(name: str, radius: float, height: float, side: Canvas, lid: Canvas) -> Mesh:
    """Make a can: rims, a sunken lid and base."""
    inner = radius - 0.0012
    wall: Profile = [(radius, 0), (radius, 0.002), (inner, 0.0035), (inner, height / 2)]
    wall += [(inner, height - 0.0035), (radius, height - 0.002), (radius, height)]
    sunken = height - 0.0025
    top: Profile = [(radius, height), (radius - 0.002, height), (radius - 0.003, sunken)]
    top += [(0, sunken)]
    low: Profile = [(0, 0.002), (radius - 0.003, 0.002), (radius - 0.002, 0), (radius, 0)]
    soup = join(disc(low, BASE, RADIUS, up=False), lathe(wall, SIDE), disc(top, LID, RADIUS))
    base = _metal_lid(1000 * radius)
    base.text(
        "04 2027 L3", (0.6 * 1000 * radius, 900 * radius, 1400 * radius, 1100 * radius), BLACK, 0.12
    )
    return weld(name, soup, texture(side, lid, base, Canvas(50, 50, METAL)))


def soup_can() -> Mesh:
    """Draw a tomato soup can, as large as YCB's."""
    radius, height = 0.0339, 0.1019
    round_mm, tall = 2000 * np.pi * radius, 1000 * height
    page = Canvas(round_mm, tall, RED)
    page.rect((0, 0.5 * tall, round_mm, tall), WHITE)
    mid = round_mm / 2
    page.text("POMODORA", (mid - 32, 14, mid + 32, 38), WHITE, 0.17)
    page.ellipse(mid, 52, 15, 15, YELLOW).ellipse(mid, 52, 12, 12, ORANGE)
    page.polygon([(mid, 34), (mid - 7, 46), (mid + 7, 46)], GREEN)
    page.text("TOMATO SOUP", (mid - 30, 70, mid + 30, 90), RED, 0.14)
    page.nutrition((8, 54, 42, 97), 41).barcode((round_mm - 46, 60, round_mm - 10, 92), 42)
    page.lines((10, 12, 50, 46), WHITE, 4, 43)
    page.lines((round_mm - 48, 12, round_mm - 8, 46), YELLOW, 4, 44)
    page.rect((0, 0, round_mm, 3.5), METAL).rect((0, tall - 3.5, round_mm, tall), METAL)
    return _can("soup_can", radius, height, page, _metal_lid(1000 * radius))


def coffee_can() -> Mesh:
    """Draw a coffee can with a plastic lid, as large as YCB's master chef can."""
    radius, height = 0.0512, 0.1402
    round_mm, tall = 2000 * np.pi * radius, 1000 * height
    page = Canvas(round_mm, tall, NAVY)
    page.fade((0, 0, round_mm, tall), (30, 66, 150), (10, 22, 66))
    mid = round_mm / 2
    page.text("MONTE NERO", (mid - 47, 24, mid + 47, 56), WHITE, 0.16)
    page.ellipse(mid, 92, 34, 22, CREAM).ellipse(mid, 92, 30, 18, BROWN)
    page.ellipse(mid, 92, 3, 18, CREAM, 18)
    page.text("GROUND COFFEE", (mid - 42, 118, mid + 42, 132), YELLOW, 0.12)
    for x in (30, 62, round_mm - 30, round_mm - 62):
        page.ellipse(x, 30, 11, 8, BROWN, 30).ellipse(x, 30, 1.4, 8, BLACK, 30)
    page.nutrition((14, 50, 60, 128), 51).barcode((round_mm - 62, 90, round_mm - 16, 126), 52)
    page.lines((round_mm - 66, 48, round_mm - 12, 84), SKY, 4.4, 53)
    page.rect((0, 0, round_mm, 8), WHITE).rect((0, tall - 4, round_mm, tall), METAL)
    size = 2000 * radius
    lid = Canvas(size, size, WHITE)
    lid.ellipse(size / 2, size / 2, 0.42 * size, 0.42 * size, (226, 228, 232))
    lid.text("FRESH", (24, 40, 78, 62), GREY, 0.12)
    return _can("coffee_can", radius, height, page, lid)


def tuna_can() -> Mesh:
    """Draw a flat fish can, as large as YCB's."""
    radius, height = 0.0428, 0.0335
    round_mm, tall = 2000 * np.pi * radius, 1000 * height
    page = Canvas(round_mm, tall, BLUE)
    mid = round_mm / 2
    page.rect((0, 22, round_mm, 26), YELLOW)
    page.text("MAREA TUNA", (mid - 38, 6, mid + 38, 21), WHITE, 0.16)
    page.barcode((8, 7, 44, 27), 61).lines((round_mm - 60, 7, round_mm - 8, 21), WHITE, 3.6, 62)
    page.rect((0, 0, round_mm, 3), METAL).rect((0, tall - 3, round_mm, tall), METAL)
    size = 2000 * radius
    lid = _metal_lid(1000 * radius).ellipse(size / 2, size / 2, 33, 33, BLUE)
    lid.ellipse(size / 2 - 3, 50, 18, 8, WHITE).polygon(
        [(54, 50), (66, 41), (66, 59)], WHITE
    ).ellipse(32, 48, 1.6, 1.6, BLACK)
    lid.text("MAREA", (22, 20, 64, 38), YELLOW, 0.16)
    return _can("tuna_can", radius, height, page, lid)


def _bottle(
    name: str, body: Profile, cap: Profile, power: float, side: Canvas, base: Color, caps: Canvas
) -> Mesh:
    """Make a bottle: a body under its print, then a cap in the swatch's colors."""
    low: Profile = [(0, 0, 0.002), (0.8 * body[0][0], 0.8 * body[0][1], 0.002), body[0]]
    soup = join(
        disc(low, BASE, RADIUS, power=power, up=False),
        lathe(body, SIDE, power=power),
        lathe(cap, SWATCH, power=power),
    )
    plate = Canvas(50, 50, base).ellipse(25, 25, 12, 12, GREY, line_mm=1.5)
    return weld(name, soup, texture(side, plate, plate, caps))


def mustard_bottle() -> Mesh:
    """Draw a mustard bottle, as large as YCB's."""
    rx, ry, neck = 0.0480, 0.02913, 0.0165
    body: Profile = [(0.92 * rx, 0.9 * ry, 0), (rx, ry, 0.006), (rx, ry, 0.05)]
    body += [(0.95 * rx, 0.97 * ry, 0.09), (rx, ry, 0.125), (0.9 * rx, 0.95 * ry, 0.140)]
    body += [(0.66 * rx, 0.85 * ry, 0.152), (neck, neck, 0.159)]
    cap: Profile = [(neck, 0.159), (0.0175, 0.160), (0.0165, 0.173), (0.009, 0.177)]
    cap += [(0.0045, 0.1895), (0.0035, 0.1913), (0, 0.1913)]
    page = Canvas(250, 172, YELLOW)  # y = 172 mm less the arc length along the profile
    for x, text in ((125, "MUSTARD"), (250, "SENAPO"), (0, "SENAPO")):
        page.ellipse(x, 102, 40, 46, RED).ellipse(x, 102, 36, 42, WHITE, line_mm=1.2)
        page.text(
            text, (max(x - 32, 0), 84, x + 32, 102) if x < 250 else (218, 84, 250, 102), WHITE, 0.16
        )
    page.rect((0, 56, 32, 148), RED).rect((218, 56, 250, 148), RED)
    page.barcode((4, 70, 30, 110), 71).lines((220, 66, 246, 140), WHITE, 4.5, 72)
    page.text("SENAPO", (93, 72, 157, 84), YELLOW, 0.16)
    page.text("YELLOW", (100, 106, 150, 118), YELLOW, 0.13)
    page.polygon([(112, 124), (138, 124), (125, 142)], YELLOW)
    caps = Canvas(50, 50, RED).rect((0, 44, 50, 50), (150, 10, 20))
    return _bottle("mustard_bottle", body, cap, 2.4, page, YELLOW, caps)


def bleach_bottle() -> Mesh:
    """Draw a bottle of cleaner, as large as YCB's bleach cleanser, without its handle's hole."""
    rx, ry, neck = 0.0512, 0.03385, 0.0175
    body: Profile = [(0.94 * rx, 0.92 * ry, 0), (rx, ry, 0.005), (rx, ry, 0.06), (rx, ry, 0.12)]
    body += [(0.97 * rx, 0.98 * ry, 0.15), (0.8 * rx, 0.9 * ry, 0.185)]
    body += [(0.52 * rx, 0.7 * ry, 0.205), (neck, neck, 0.213), (neck, neck, 0.220)]
    cap: Profile = [(neck, 0.220), (0.0205, 0.2205), (0.0205, 0.246), (0.0185, 0.2506), (0, 0.2506)]
    page = Canvas(274, 234, WHITE)
    page.fade((90, 84, 184, 226), (24, 96, 190), (10, 40, 120))
    page.burst(137, 148, 44, 30, SKY, 12).ellipse(137, 148, 28, 22, WHITE)
    page.text("BLANKA", (93, 90, 181, 116), WHITE, 0.17)
    page.text("PLUS", (117, 138, 157, 158), RED, 0.18)
    page.text("CLEANER", (98, 194, 176, 212), YELLOW, 0.15)
    page.rect((0, 90, 40, 226), GREEN).rect((234, 90, 274, 226), GREEN)
    page.lines((4, 100, 36, 180), WHITE, 4.5, 81).barcode((4, 186, 36, 220), 82)
    page.nutrition((238, 98, 270, 180), 83)
    page.polygon([(254, 190), (240, 216), (268, 216)], YELLOW)
    caps = Canvas(50, 50, BLUE).rect((0, 40, 50, 42), NAVY)
    return _bottle("bleach_bottle", body, cap, 2.6, page, WHITE, caps)
