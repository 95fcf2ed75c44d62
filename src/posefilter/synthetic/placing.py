"""Place objects: the target before the camera, distractors around it, occluders in front of it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from posefilter.geometry.rigid import move, rigid
from posefilter.meshes.mesh import Mesh
from posefilter.rendering.surfaces import project
from posefilter.synthetic.solids import Solid, outline_mask, separated

_ATTEMPTS = 8  # places that are tried for a further instance
_STRIDE = 8  # [px] of the masks by which occlusion is predicted
_NEAREST = 0.2  # [m] no object comes nearer to the camera
_GAP = 0.001  # [m] between objects
_RIM = 0.03  # [m] how far inside the table's edge the centers of objects stay


@dataclass(frozen=True, eq=False)
class Placed:
    """A solid at a pose."""

    solid: Solid
    camera_from_object: np.ndarray  # (4, 4) [m]

    @cached_property
    def hull(self) -> np.ndarray:
        """The hull's vertices in the camera, (V, 3) [m]."""
        return move(self.solid.hull, self.camera_from_object)

    @cached_property
    def center(self) -> np.ndarray:
        """The bounding box's center in the camera, (3,) [m]."""
        return self.camera_from_object[:3, :3] @ self.solid.center + self.camera_from_object[:3, 3]


@dataclass(frozen=True, eq=False)
class View:
    """A camera, and the approximate masks of hulls in it."""

    K: np.ndarray
    height: int
    width: int

    def ray(self, u: float, v: float) -> np.ndarray:
        """Return the ray (3,) through a point of the frame, in fractions of width and height."""
        x, y = u * self.width - self.K[0, 2], v * self.height - self.K[1, 2]
        return np.array([x / self.K[0, 0], y / self.K[1, 1], 1.0])

    def holds(self, one: Placed, largest_truncation: float) -> bool:
        """Return whether at most `largest_truncation` of an object's outline is out of the
        frame.
        """
        if one.hull[:, 2].min() < _NEAREST:
            return False
        pixels = project(one.hull, self.K)
        inside = ((pixels >= 0) & (pixels < [self.width, self.height])).all(1)
        return bool(inside.mean() >= 1 - largest_truncation)

    def most_pixels(self, mesh: Mesh, nearest: float) -> float:
        """Return how many pixels an object covers at most whose points are all at a depth of at
        least `nearest` [m].

        It is the bound of a parallel projection's area, or half of the surface where the object is
        so near that it is seen from several sides. A convex region of area A and perimeter P has at
        most A + P / 2 + 1 pixels' centers.
        """
        if nearest <= 0:
            return np.inf
        # by which a length in the frame's corner is longer than in its middle
        stretch = max(float(np.linalg.norm(self.ray(u, v))) for u in (0, 1) for v in (0, 1))
        x, y = float(self.K[0, 0]), float(self.K[1, 1])
        size = 2 * mesh.reach
        surface, shadow = mesh.hull_areas
        seen = min(surface / 2, shadow + surface / 2 * size / nearest)
        area = seen * x * y * stretch / nearest**2
        return area + np.pi / 2 * size * max(x, y) * stretch / nearest + 1

    def mask(self, one: Placed) -> np.ndarray:
        """Return the coarse mask of an object."""
        return outline_mask(one.hull, self.K, self.height, self.width, _STRIDE)

    def free(self, placed: list[Placed]) -> tuple[np.ndarray, int]:
        """Return the visible part of the first object.

        Returns:
            Its coarse mask without the pixels that nearer objects cover, and the number of pixels
            that it would have alone.
        """
        whole = self.mask(placed[0])
        free = whole.copy()
        for one in placed[1:]:
            if one.center[2] < placed[0].center[2]:
                free &= ~self.mask(one)
        return free, max(int(whole.sum()), 1)

    def visible(self, placed: list[Placed]) -> float:
        """Return the visible fraction of the first object, of its part in the frame."""
        free, whole = self.free(placed)
        return float(free.sum() / whole)


@dataclass(frozen=True, eq=False)
class Table:
    """A table top, and the point of it that the target stands on."""

    camera_from_spot: np.ndarray  # (4, 4) [m], z up, the origin under the target
    camera_from_top: np.ndarray  # (4, 4) [m], z up, the origin in the middle, axes along the sides
    half_extent: tuple[float, float]  # [m]

    def carries(self, one: Placed) -> bool:
        """Return whether an object's center is over the table."""
        x, y, _ = self.camera_from_top[:3, :3].T @ (one.center - self.camera_from_top[:3, 3])
        return bool(abs(x) < self.half_extent[0] - _RIM and abs(y) < self.half_extent[1] - _RIM)


def set_table(
    camera_from_spot: np.ndarray, half_extent: tuple[float, float], rng: np.random.Generator
) -> Table:
    """Place a table under a point, rotated by up to 45 degrees.

    Args:
        camera_from_spot: (4, 4) [m], z up, the origin under the target and not near the edge.
        half_extent: Half of the table's sides [m].
        rng: Source of randomness.
    """
    turn = Rotation.from_euler("z", rng.uniform(-45, 45), degrees=True).as_matrix()
    room = np.maximum(0.75 * np.array(half_extent) - 0.1, 0.05)
    shift = turn[:2, :2] @ (rng.uniform(-1, 1, 2) * room)
    return Table(camera_from_spot, camera_from_spot @ rigid(turn, [*shift, 0]), half_extent)


def place_target_on_table(
    solid: Solid, view: View, distance: float, elevation_deg: float, rng: np.random.Generator
) -> tuple[Placed, np.ndarray]:
    """Place the target on a table.

    Args:
        solid: The target.
        view: The camera.
        distance: From the camera to the target's center [m].
        elevation_deg: Of the camera over the table [degrees].
        rng: Source of randomness.

    Returns:
        The target, and camera_from_spot (4, 4) [m] of the point under it.
    """
    elevation = np.deg2rad(elevation_deg)
    roll = Rotation.from_euler("z", rng.normal(0, 6), degrees=True).as_matrix()
    up = roll @ np.array([0, -np.cos(elevation), -np.sin(elevation)])
    right = roll @ np.array([1.0, 0, 0])
    rest = _draw_stable_rotation(solid, rng, 0.5)
    bottom = (solid.hull @ rest.T).min(0)[2]
    middle = float((rest @ solid.center)[2] - bottom)
    center = view.ray(rng.uniform(0.15, 0.85), rng.uniform(0.18, 0.85)) * distance
    axes = np.stack([right, np.cross(up, right), up], 1)
    camera_from_spot = rigid(axes, center - up * middle)
    return _place_on_table(solid, rest, np.zeros(2), camera_from_spot), camera_from_spot


def place_floating_target(
    solid: Solid, view: View, distance: float, rng: np.random.Generator
) -> Placed:
    """Place the target in the air, at a random position in the view and a random rotation."""
    rotation = Rotation.random(rng=rng).as_matrix()
    center = view.ray(rng.uniform(0.12, 0.88), rng.uniform(0.12, 0.88)) * distance
    return _place_floating(solid, rotation, center)


def are_separate(a: Placed, b: Placed) -> bool:
    """Return whether two objects do not touch, by their bounding spheres or else by their hulls."""
    far = np.linalg.norm(a.center - b.center) > a.solid.radius + b.solid.radius + _GAP
    return bool(far) or separated(a.hull, b.hull, _GAP)


def compute_hiding_size(solid: Solid) -> float:
    """Return the second largest side of a solid's box [m]: at best it hides that much."""
    return float(np.sort(np.ptp(solid.mesh.bounds, axis=0))[1])


def place_distractor(
    solid: Solid,
    placed: list[Placed],
    view: View,
    table: Table | None,
    wanted: float,
    in_front: bool,
    rng: np.random.Generator,
) -> Placed | None:
    """Find a pose for a distractor, in the air where there is no table.

    Args:
        solid: The distractor.
        placed: The objects so far, the target first.
        view: The camera.
        table: The table, if there is one.
        wanted: Fraction of the target that should stay visible.
        in_front: Place it in front of the target, so that about `wanted` stays visible; else
            anywhere that leaves no less.
        rng: Source of randomness.

    Returns:
        The distractor, or None where no pose was found.
    """
    best, best_error = None, np.inf
    free, whole = view.free(placed)
    for _ in range(48 if in_front else 16):
        if table is None:
            one = _draw_floating(solid, placed[0], in_front, rng)
        else:
            one = _draw_on_table(solid, placed[0], table.camera_from_spot, in_front, rng)
            if not table.carries(one):
                continue
        if one.hull[:, 2].min() < _NEAREST or not all(are_separate(one, other) for other in placed):
            continue
        nearer = one.center[2] < placed[0].center[2]
        share = float((free & ~view.mask(one)).sum() / whole) if nearer else free.sum() / whole
        if share < wanted - 0.08:
            continue
        error = abs(share - wanted)
        if not in_front or error < 0.04:
            return one
        if error < best_error:
            best, best_error = one, error
    return best


def place_copies(
    target: Placed,
    count: int,
    view: View,
    table: Table | None,
    wanted: float,
    largest_truncation: float,
    rng: np.random.Generator,
) -> list[Placed] | None:
    """Find poses for `count` further instances of the target, so that the fraction `wanted` of the
    first stays visible; return all, the first in front, or None where one finds no place.

    At most `largest_truncation` of an instance's outline may be out of the frame.
    """
    placed = [target]
    for _ in range(count):
        for _ in range(_ATTEMPTS):
            one = place_distractor(target.solid, placed, view, table, wanted, False, rng)
            if one is not None and view.holds(one, largest_truncation):
                placed.append(one)
                break
        else:
            return None
    return placed


def _draw_on_table(
    solid: Solid, target: Placed, frame: np.ndarray, in_front: bool, rng: np.random.Generator
) -> Placed:
    """Draw a pose on the table."""
    rest = _draw_stable_rotation(solid, rng, 0.6)
    reach = target.solid.radius + solid.radius
    if in_front:
        towards = -(frame[:3, :2].T @ frame[:3, 3])
        towards /= np.linalg.norm(towards) + 1e-9
        across = np.array([-towards[1], towards[0]])
        spot = towards * reach * rng.uniform(0.25, 1.4) + across * reach * rng.uniform(-0.6, 0.6)
    else:
        spot = rng.uniform(-1, 1, 2) * (rng.uniform(0.08, 0.3) + 0.5 * reach)
    return _place_on_table(solid, rest, spot, frame)


def _draw_floating(
    solid: Solid, target: Placed, in_front: bool, rng: np.random.Generator
) -> Placed:
    """Draw a pose in the air near the target, or in front of it."""
    rotation = Rotation.random(rng=rng).as_matrix()
    z = target.center[2] * rng.uniform(0.6, 0.95 if in_front else 1.3)
    spread = 0.5 * target.solid.radius + 0.5 * solid.radius if in_front else 0.16
    where = target.center + rng.normal(0, 1, 3) * [spread, spread, 0]
    return _place_floating(solid, rotation, where * (z / where[2]))


def _draw_stable_rotation(solid: Solid, rng: np.random.Generator, upright: float) -> np.ndarray:
    """Draw a stable rotation: with probability `upright` the mesh's own, else any; then a yaw.

    Improbable ones are drawn more often than by their probability.
    """
    if rng.random() < upright:
        down = -solid.stable_rotations[:, 2, :]  # the object's direction that each rest turns down
        near = int((down @ np.array([0, 0, -1.0])).argmax())
        rest = solid.stable_rotations[near]
    else:
        weights = np.sqrt(solid.stable_weights)
        rest = solid.stable_rotations[int(rng.choice(len(weights), p=weights / weights.sum()))]
    return Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix() @ rest


def _place_on_table(
    solid: Solid, rest: np.ndarray, spot: np.ndarray, camera_from_spot: np.ndarray
) -> Placed:
    """Return a solid in a stable rotation with its center over a point of the table."""
    center = rest @ solid.center
    lowest = (solid.hull @ rest.T)[:, 2].min()
    table_from_object = rigid(rest, [spot[0] - center[0], spot[1] - center[1], -lowest])
    return Placed(solid, camera_from_spot @ table_from_object)


def _place_floating(solid: Solid, rotation: np.ndarray, center: np.ndarray) -> Placed:
    """Return a solid of this rotation with its center at a point in the camera."""
    return Placed(solid, rigid(rotation, center - rotation @ solid.center))
