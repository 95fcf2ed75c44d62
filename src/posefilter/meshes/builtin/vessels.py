"""A mug, a bowl and a pitcher; a marker; and a banana, which is nearly round."""

import numpy as np

from posefilter.meshes.builtin.printing import (
    BLACK,
    BLUE,
    BROWN,
    CREAM,
    NAVY,
    ORANGE,
    RED,
    SKY,
    WHITE,
    Canvas,
)
from posefilter.meshes.builtin.round import BASE, LID, RADIUS, SIDE, SWATCH, Profile, texture
from posefilter.meshes.builtin.shapes import Rect, Soup, disc, join, lathe, transform, tube, weld
from posefilter.meshes.mesh import Mesh


def _open(outside: Profile, wall: float, floor: float) -> tuple[Profile, Profile]:
    """Return the rim and inside of an open vessel, and its whole inner floor, from an outside
    profile going up.
    """
    top = outside[-1][1]
    inside: Profile = [(r - wall, max(z, floor)) for r, z in reversed(outside) if r - wall > 0]
    rim: Profile = [(outside[-1][0] - share * wall, top + 0.0008) for share in (0.3, 0.7)]
    inner: Profile = [outside[-1], *rim, *(p for p in inside if p[1] > floor)]
    inner += [(inside[-1][0], floor)]
    return inner, [inner[-1], (0.0, floor)]


def _vessel(outside: Profile, wall: float, floor: float, segments: int) -> Soup:
    """Make an open vessel: print outside, swatch inside, pictures on the floor and below."""
    inner, ground = _open(outside, wall, floor)
    low: Profile = [(0, 0.001), (0.85 * outside[0][0], 0.001), outside[0]]
    return join(
        disc(low, BASE, RADIUS, segments, up=False),
        lathe(outside, SIDE, segments),
        # the rim is the swatch's top
        lathe(inner, (SWATCH[0], SWATCH[3], SWATCH[2], SWATCH[1]), segments),
        disc(ground, LID, RADIUS, segments),
    )


def _handle(
    attach: tuple[float, float], extent: float, z: tuple[float, float], radius: float
) -> Soup:
    """Make a handle in the plane y = 0: from x attach[1] at z[1] out to `extent` and back to
    attach[0] at z[0] [m].
    """
    t = np.linspace(0, np.pi, 13)
    middle, half = (z[0] + z[1]) / 2, (z[1] - z[0]) / 2
    bow = np.sin(t) ** 0.6
    x = np.linspace(attach[1], attach[0], 13) * (1 - bow) + (extent - radius) * bow
    path = np.stack([x, np.zeros_like(t), middle + half * np.cos(t)], -1)
    u0, v0, u1, v1 = SWATCH
    band: Rect = (u0, v0 + 0.9 * (v1 - v0), u1, v1 - 0.02 * (v1 - v0))  # the rim's color
    return tube(path, np.full(13, radius), band, segments=10)


def mug() -> Mesh:
    """Draw a mug with a handle at +x, as large as YCB's."""
    r, height = 0.04655, 0.0805
    outside: Profile = [(r - 0.004, 0), (r - 0.001, 0.003), (r, 0.008), (r, 0.04), (r, 0.072)]
    outside += [(r, height)]
    page = Canvas(292, 84, (176, 30, 36))
    page.ellipse(146, 44, 30, 26, CREAM).text("HELLO", (122, 30, 170, 50), NAVY, 0.17)
    page.text("DAY", (134, 50, 158, 62), ORANGE, 0.17)
    for k, color in enumerate((NAVY, CREAM, ORANGE)):
        page.polygon([(10 + 18 * k, 60), (20 + 18 * k, 24), (30 + 18 * k, 60)], color)
        page.ellipse(232 + 20 * k, 42, 9, 9, color)
    inside = Canvas(50, 50, CREAM).rect((0, 0, 50, 6), (176, 30, 36))
    floor = Canvas(50, 50, CREAM).ellipse(25, 25, 20, 20, (232, 220, 190))
    base = Canvas(50, 50, (150, 24, 30)).text("MADE BY HAND", (8, 20, 42, 30), WHITE, 0.12)
    soup = join(
        _vessel(outside, 0.0035, 0.006, 40),
        _handle((r - 0.002, r - 0.002), 0.117 - r, (0.018, 0.064), 0.0052),
    )
    return weld("mug", soup, texture(page, floor, base, inside))


def bowl() -> Mesh:
    """Draw a bowl with rings only, so that every turn about z is a symmetry; as large as YCB's."""
    t = np.linspace(0, 1, 9)
    r = 0.042 + (0.0795 - 0.042) * np.sin(t * np.pi / 2) ** 0.9
    outside: Profile = [
        *zip(r.tolist(), (0.0535 * t**1.15).tolist(), strict=True),
        (0.0807, 0.0542),
    ]
    page = Canvas(500, 80, (188, 22, 34))
    page.rect((0, 6, 500, 16), CREAM).rect((0, 22, 500, 25), NAVY).rect((0, 60, 500, 66), CREAM)
    inside = (
        Canvas(50, 50, CREAM)
        .rect((0, 10, 50, 14), BLUE)
        .rect((0, 18, 50, 20), BLUE)
        .rect((0, 0, 50, 3), (188, 22, 34))
    )
    floor = (
        Canvas(50, 50, CREAM)
        .ellipse(25, 25, 17, 17, BLUE)
        .ellipse(25, 25, 14, 14, CREAM)
        .ellipse(25, 25, 5, 5, BLUE)
    )
    base = Canvas(50, 50, (120, 16, 26)).ellipse(25, 25, 20, 20, (150, 20, 30))
    return weld("bowl", _vessel(outside, 0.003, 0.004, 36), texture(page, floor, base, inside))


def pitcher() -> Mesh:
    """Draw a jug with a spout at -x and a handle at +x, as large as YCB's pitcher base."""
    r, height = 0.0665, 0.2416
    outside: Profile = [(0.78 * r, 0), (0.8 * r, 0.004), (0.86 * r, 0.06), (0.92 * r, 0.13)]
    outside += [(0.97 * r, 0.195), (r, 0.225), (r, height)]
    page = Canvas(400, 250, BLUE)
    page.fade((0, 0, 400, 250), (60, 120, 210), (24, 66, 158)).rect((0, 0, 400, 12), WHITE)
    for k in range(9):
        page.rect((186, 60 + 18 * k, 206 if k % 2 else 216, 62 + 18 * k), WHITE)
    page.text("AQUA", (166, 22, 234, 50), WHITE, 0.17).ellipse(20, 140, 16, 22, SKY)
    page.polygon([(6, 132), (34, 132), (20, 92)], SKY)
    inside = Canvas(50, 50, (70, 130, 214)).rect((0, 0, 50, 6), WHITE)
    floor = Canvas(50, 50, (44, 98, 186))
    body = _vessel(outside, 0.003, 0.006, 40)
    corners = body.corners.copy()
    ahead, high = np.clip(-corners[..., 0] / r, 0, 1), np.clip((corners[..., 2] - 0.2) / 0.04, 0, 1)
    corners[..., 0] -= 0.0070 * (ahead**6 * high**2)  # pull the rim out into a spout
    soup = join(
        Soup(corners, body.uv), _handle((0.055, 0.0635), 0.1886 - 0.0735, (0.07, 0.215), 0.0085)
    )
    return weld("pitcher", soup, texture(page, floor, floor, inside))


def marker() -> Mesh:
    """Draw a felt pen lying along x, its cap at +x; as large as YCB's large marker."""
    r, length = 0.0094, 0.121
    body: Profile = [(0, 0), (0.8 * r, 0), (0.93 * r, 0.002), (0.93 * r, 0.04), (0.93 * r, 0.078)]
    body += [(r, 0.078), (r, 0.100)]
    body += [(0.9 * r, 0.106), (0.85 * r, 0.1205), (0.8 * r, length), (0, length)]
    page = Canvas(60, 137, WHITE)  # y = 137 mm less the arc length
    page.rect((0, 0, 60, 51), BLACK).rect((0, 126, 60, 137), BLACK).rect((0, 52, 60, 58), RED)
    page.text("SKRIBO", (18, 62, 42, 120), NAVY, 0.18, turned=True).lines(
        (2, 64, 14, 118), BLACK, 5, 91
    ).barcode((46, 70, 58, 110), 92)
    plain = Canvas(50, 50, BLACK)
    upright = lathe(body, SIDE, 28)
    lying = np.array([[0, 0, 1.0], [-1.0, 0, 0], [0, -1.0, 0]])  # z to x, front (-y) to above
    pen = transform(upright, lying, np.array([-length / 2, 0, r]))
    return weld("marker", pen, texture(page, plain, plain, plain))


def banana() -> Mesh:
    """Draw a banana lying on its side, bent in the plane of x and y; as large as YCB's."""
    t = np.linspace(-1, 1, 25)
    bend, radius = 0.92, 0.107
    path = np.stack([radius * np.sin(bend * t), 0 * t, -radius * np.cos(bend * t)], -1)
    thick = 0.0184 * np.clip(1 - np.abs(t) ** 3.2, 0, None) ** 0.6
    stem = np.where(t > 0.78, 0.0052, 0.0042)
    soup = tube(path, np.maximum(thick, stem), SIDE, segments=14, sides=np.full(25, 1.05))
    flat = transform(soup, np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), np.zeros(3))
    low, high = flat.corners.reshape(-1, 3).min(0), flat.corners.reshape(-1, 3).max(0)
    flat = transform(flat, np.diag(np.array([0.197, 0.074, 0.0387]) / (high - low)), np.zeros(3))
    low, high = flat.corners.reshape(-1, 3).min(0), flat.corners.reshape(-1, 3).max(0)
    flat = transform(
        flat, np.eye(3), -np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    )
    page = Canvas(120, 210, (240, 204, 60))
    page.fade((0, 0, 120, 26), (120, 130, 40), (232, 204, 66))
    page.fade((0, 186, 120, 210), (236, 200, 60), (90, 64, 30))
    page.rect((0, 0, 120, 5), BROWN).rect((0, 204, 120, 210), (50, 36, 22))
    rng = np.random.default_rng(101)
    for _ in range(70):
        x, y = rng.uniform(0, 120), rng.uniform(20, 190)
        rx, ry = rng.uniform(0.3, 1.2), rng.uniform(0.6, 4.5)
        page.ellipse(x, y, rx, ry, (176, 128, 44))
    page.ellipse(60, 96, 9, 8, BLUE).text("TROPI", (52, 91, 68, 101), WHITE, 0.14)
    plain = Canvas(50, 50, BROWN)
    return weld("banana", flat, texture(page, plain, plain, plain))
