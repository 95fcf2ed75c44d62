"""Lay out scenes: a target among distractors and look-alikes, on a table or afloat, with something in front of it when asked.

A scene set (one folder of the dataset) fixes the surroundings, the distractors to choose from and the look-alikes; every frame of it
has a camera, a layout and lights of its own.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from posefilter.data.lookalikes import make_lookalike
from posefilter.data.mesh import Mesh
from posefilter.data.meshes import MeshStore
from posefilter.data.render import Instance, Lights, Plane
from posefilter.data.solids import Solid, make_solid, outline_mask, separated
from posefilter.data.textures import random_color, random_texture

_STRIDE = 8  # [px] of the masks that foresee who hides whom
_NEAREST = 0.2  # [m] no object comes nearer to the camera
_TABLE = (0.3, 0.08, 0.1, 0.22, 0.12, 0.04, 0.14)  # plain, checker, marble, wood, carpet, stripes, label
_FLOOR = (0.15, 0.15, 0.1, 0.2, 0.3, 0.05, 0.05)


@dataclass(frozen=True)
class SceneSettings:
    """What scenes are like."""

    distractors: tuple[int, int] = (2, 8)  # least and most beside the target
    occlusion: float = 0.75  # largest share of the target that may be hidden
    occluded_share: float = 0.35  # share of frames in which something is put right in front of the target
    tabletop_share: float = 0.65
    lookalike_share: float = 0.25  # chance that a distractor is a look-alike
    lookalikes: int = 4  # different ones a scene set
    classes: int = 14  # distractor classes a scene set
    distance: tuple[float, float] = (0.45, 1.4)  # [m] camera to target
    elevation_deg: tuple[float, float] = (10.0, 85.0)
    largest_truncation: float = 0.4  # share of the target's outline that may leave the frame
    shadow_share: float = 0.7


@dataclass(frozen=True, eq=False)
class SceneSet:
    """What the frames of one folder share."""

    target: Solid
    distractors: tuple[Solid, ...]
    lookalikes: tuple[Solid, ...]
    textures: tuple[np.ndarray, np.ndarray, np.ndarray]  # table, floor, wall
    tiles: tuple[float, float, float]  # [m]
    table_half_extent: tuple[float, float]
    table_height: float


@dataclass(frozen=True, eq=False)
class Placed:
    """A solid somewhere."""

    solid: Solid
    camera_from_object: np.ndarray  # (4, 4) [m]

    @cached_property
    def hull(self) -> np.ndarray:
        """Return the hull's vertices in the camera.  -> (V, 3) [m]."""
        return self.solid.hull @ self.camera_from_object[:3, :3].T + self.camera_from_object[:3, 3]

    @cached_property
    def center(self) -> np.ndarray:
        """Return the box's centre in the camera.  -> (3,) [m]."""
        return self.camera_from_object[:3, :3] @ self.solid.center + self.camera_from_object[:3, 3]


@dataclass(frozen=True, eq=False)
class Layout:
    """One frame, ready to render.  The target comes first."""

    placed: tuple[Placed, ...]
    planes: tuple[Plane, ...]
    lights: Lights
    tabletop: bool

    def instances(self) -> list[Instance]:
        """Return the objects as the renderer takes them."""
        return [Instance(p.solid.mesh, p.camera_from_object) for p in self.placed]


class Library:
    """The solids of a mesh store, each measured once."""

    def __init__(self, store: MeshStore) -> None:
        self.store = store
        self._solids: dict[str, Solid] = {}

    def solid(self, name: str) -> Solid:
        """Return a mesh as a solid."""
        if name not in self._solids:
            self._solids[name] = make_solid(self.store.load(name))
        return self._solids[name]


def draw_set(library: Library, target: str, settings: SceneSettings, rng: np.random.Generator) -> SceneSet:
    """Draw what the frames of one folder share."""
    others = [name for name in library.store.names() if name != target]
    chosen = [others[i] for i in rng.permutation(len(others))[: settings.classes]]
    goal = library.solid(target)
    distractors = tuple(library.solid(name) for name in chosen)
    photos = [s.mesh.texture for s in distractors if min(s.mesh.texture.shape[:2]) >= 64]
    lookalikes = tuple(make_solid(make_lookalike(goal.mesh, f"lookalike_{k:02d}", photos, rng)) for k in range(settings.lookalikes))
    textures = [random_texture(rng, 256, photos, w) for w in (_TABLE, _FLOOR, _FLOOR)]
    tiles = (float(rng.uniform(0.2, 1.2)), float(rng.uniform(0.2, 1.5)), float(rng.uniform(0.4, 2.0)))
    half = (float(rng.uniform(0.3, 1.2)), float(rng.uniform(0.3, 1.2)))
    return SceneSet(goal, distractors, lookalikes, (textures[0], textures[1], textures[2]), tiles, half, float(rng.uniform(0.3, 0.9)))


def draw_layout(
    scene: SceneSet, settings: SceneSettings, K: np.ndarray, height: int, width: int, rng: np.random.Generator
) -> Layout | None:
    """Draw one frame, or None where this draw does not work out (the caller draws again)."""
    view = _View(K, height, width)
    occluded = bool(rng.random() < settings.occluded_share)
    least = 1 - settings.occlusion
    wanted = rng.uniform(min(max(0.28, least), 0.6), 0.6) if occluded else rng.uniform(max(0.6, least), 1.0)
    tabletop = bool(rng.random() < settings.tabletop_share)
    for _ in range(8 if occluded else 1):  # not every corner of a table has room in front of the target
        placed, camera_from_table = _draw_objects(scene, settings, view, tabletop, occluded, wanted, rng)
        if placed and (not occluded or view.visible(placed) < wanted + 0.1):
            break
    if len(placed) <= min(settings.distractors[0], 1):
        return None
    up = camera_from_table[:3, 2] if tabletop else np.array([0.0, -0.8, -0.6])
    planes = _surroundings(scene, placed[0], camera_from_table, tabletop, rng)
    return Layout(tuple(placed), planes, _draw_lights(up, settings, rng), tabletop)


def _draw_objects(
    scene: SceneSet, settings: SceneSettings, view: "_View", tabletop: bool, occluded: bool, wanted: float, rng: np.random.Generator
) -> tuple[list[Placed], np.ndarray]:
    """Place the target and what stands round it, none where the target leaves the frame.  -> objects, camera_from_table."""
    if tabletop:
        target, frame = _start_on_table(scene, settings, view, occluded, rng)
    else:
        target, frame = _start_afloat(scene, settings, view, rng)
    if not view.holds(target, settings.largest_truncation):
        return [], frame
    placed = [target]
    solids = _draw_solids(scene, settings, rng)
    if occluded:  # whatever can hide most is tried in front first
        solids.sort(key=lambda solid: -_face(solid))
    for solid in solids:
        in_front = occluded and view.visible(placed) > wanted + 0.06
        one = _place(solid, placed, view, frame, wanted, in_front, rng)
        if one is not None:
            placed.append(one)
    return placed, frame


@dataclass(frozen=True, eq=False)
class _View:
    """A camera, and what it would roughly see of hulls."""

    K: np.ndarray
    height: int
    width: int

    def ray(self, u: float, v: float) -> np.ndarray:
        """Return the ray through a point of the frame given in shares of its sides."""
        return np.array([(u * self.width - self.K[0, 2]) / self.K[0, 0], (v * self.height - self.K[1, 2]) / self.K[1, 1], 1.0])

    def holds(self, one: Placed, largest_truncation: float) -> bool:
        """Tell whether enough of an object's outline lies in the frame."""
        if one.hull[:, 2].min() < _NEAREST:
            return False
        pixels = one.hull[:, :2] / one.hull[:, 2:] * [self.K[0, 0], self.K[1, 1]] + [self.K[0, 2], self.K[1, 2]]
        inside = ((pixels >= 0) & (pixels < [self.width, self.height])).all(1)
        return bool(inside.mean() >= 1 - largest_truncation)

    def mask(self, one: Placed) -> np.ndarray:
        """Return an object's outline, coarsely."""
        return outline_mask(one.hull, self.K, self.height, self.width, _STRIDE)

    def free(self, placed: list[Placed]) -> tuple[np.ndarray, int]:
        """Return the coarse mask of the first object that no nearer one covers, and how large it would be alone."""
        whole = self.mask(placed[0])
        free = whole.copy()
        for one in placed[1:]:
            if one.center[2] < placed[0].center[2]:
                free &= ~self.mask(one)
        return free, max(int(whole.sum()), 1)

    def visible(self, placed: list[Placed]) -> float:
        """Return the share of the first object's outline in the frame that no nearer one covers."""
        free, whole = self.free(placed)
        return float(free.sum() / whole)


def _start_on_table(
    scene: SceneSet, settings: SceneSettings, view: _View, occluded: bool, rng: np.random.Generator
) -> tuple[Placed, np.ndarray]:
    """Put the target on a table before the camera.  -> the target and camera_from_table, whose origin lies under it."""
    low, high = settings.elevation_deg
    elevation = np.deg2rad(rng.uniform(low, min(high, max(45.0, low)) if occluded else high))
    roll = Rotation.from_euler("z", rng.normal(0, 6), degrees=True).as_matrix()
    up = roll @ np.array([0, -np.cos(elevation), -np.sin(elevation)])
    right = roll @ np.array([1.0, 0, 0])
    camera_from_table = np.eye(4)
    camera_from_table[:3, :3] = np.stack([right, np.cross(up, right), up], 1)
    rest = _draw_rest(scene.target, rng, 0.5)
    bottom = (scene.target.hull @ rest.T).min(0)[2]
    middle = float((rest @ scene.target.center)[2] - bottom)
    center = view.ray(rng.uniform(0.15, 0.85), rng.uniform(0.18, 0.85)) * rng.uniform(*settings.distance)
    camera_from_table[:3, 3] = center - up * middle
    return _stand(scene.target, rest, np.zeros(2), camera_from_table), camera_from_table


def _start_afloat(
    scene: SceneSet, settings: SceneSettings, view: _View, rng: np.random.Generator
) -> tuple[Placed, np.ndarray]:
    """Put the target anywhere in the view, turned anyhow."""
    rotation = Rotation.random(rng=rng).as_matrix()
    center = view.ray(rng.uniform(0.12, 0.88), rng.uniform(0.12, 0.88)) * rng.uniform(*settings.distance)
    return _hang(scene.target, rotation, center), np.eye(4)


def _draw_solids(scene: SceneSet, settings: SceneSettings, rng: np.random.Generator) -> list[Solid]:
    """Choose a frame's distractors, no class twice."""
    low, high = settings.distractors
    count = int(rng.integers(low, high + 1))
    usual = [scene.distractors[i] for i in rng.permutation(len(scene.distractors))]
    alike = [scene.lookalikes[i] for i in rng.permutation(len(scene.lookalikes))]
    out = []
    while len(out) < count and (usual or alike):
        pool = alike if alike and (not usual or rng.random() < settings.lookalike_share) else usual
        out.append(pool.pop())
    return out


def _apart(a: Placed, b: Placed) -> bool:
    """Tell whether two objects stand apart, by their spheres or else by their hulls."""
    far = np.linalg.norm(a.center - b.center) > a.solid.radius + b.solid.radius + 0.001
    return bool(far) or separated(a.hull, b.hull, 0.001)


def _face(solid: Solid) -> float:
    """Return the second largest side of a solid's box [m]: how much it hides at best."""
    low, high = solid.mesh.bounds
    return float(np.sort(high - low)[1])


def _place(
    solid: Solid, placed: list[Placed], view: _View, frame: np.ndarray, wanted: float, in_front: bool, rng: np.random.Generator
) -> Placed | None:
    """Find a free place for a distractor: right in front of the target if asked, else anywhere that hides not too much of it."""
    tabletop = not np.array_equal(frame, np.eye(4))
    best, best_error = None, np.inf
    free, whole = view.free(placed)
    for _ in range(48 if in_front else 16):
        draw = _draw_on_table if tabletop else _draw_afloat
        one = draw(solid, placed[0], frame, in_front, rng)
        if one.hull[:, 2].min() < _NEAREST or not all(_apart(one, other) for other in placed):
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


def _draw_on_table(solid: Solid, target: Placed, frame: np.ndarray, in_front: bool, rng: np.random.Generator) -> Placed:
    """Stand a solid somewhere on the table."""
    rest = _draw_rest(solid, rng, 0.6)
    reach = target.solid.radius + solid.radius
    if in_front:
        towards = -(frame[:3, :2].T @ frame[:3, 3])
        towards /= np.linalg.norm(towards) + 1e-9
        across = np.array([-towards[1], towards[0]])
        spot = towards * reach * rng.uniform(0.25, 1.4) + across * reach * rng.uniform(-0.6, 0.6)
    else:
        spot = rng.uniform(-1, 1, 2) * (rng.uniform(0.15, 0.4) + 0.5 * reach)
    return _stand(solid, rest, spot, frame)


def _draw_afloat(solid: Solid, target: Placed, frame: np.ndarray, in_front: bool, rng: np.random.Generator) -> Placed:
    """Hang a solid somewhere near the target, or before it."""
    rotation = Rotation.random(rng=rng).as_matrix()
    z = target.center[2] * rng.uniform(0.6, 0.95 if in_front else 1.3)
    spread = 0.5 * target.solid.radius + 0.5 * solid.radius if in_front else 0.16
    where = target.center + rng.normal(0, 1, 3) * [spread, spread, 0]
    return _hang(solid, rotation, where * (z / where[2]))


def _draw_rest(solid: Solid, rng: np.random.Generator, upright: float) -> np.ndarray:
    """Draw how a solid lies: as its mesh stands, or one of its rests (rare ones more often than chance), turned about the vertical."""
    if rng.random() < upright:
        down = -solid.rests[:, 2, :]  # the object's direction that each rest turns down
        near = int((down @ np.array([0, 0, -1.0])).argmax())
        rest = solid.rests[near]
    else:
        weights = np.sqrt(solid.rest_weights)
        rest = solid.rests[int(rng.choice(len(weights), p=weights / weights.sum()))]
    return Rotation.from_euler("z", rng.uniform(0, 360), degrees=True).as_matrix() @ rest


def _stand(solid: Solid, rest: np.ndarray, spot: np.ndarray, camera_from_table: np.ndarray) -> Placed:
    """Return a solid in a resting rotation with its centre over a spot of the table."""
    center = rest @ solid.center
    table_from_object = np.eye(4)
    table_from_object[:3, :3] = rest
    table_from_object[:3, 3] = [spot[0] - center[0], spot[1] - center[1], -(solid.hull @ rest.T)[:, 2].min()]
    return Placed(solid, camera_from_table @ table_from_object)


def _hang(solid: Solid, rotation: np.ndarray, center: np.ndarray) -> Placed:
    """Return a solid with its centre somewhere in the camera's frame."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, center - rotation @ solid.center
    return Placed(solid, pose)


def _surroundings(scene: SceneSet, target: Placed, frame: np.ndarray, tabletop: bool, rng: np.random.Generator) -> tuple[Plane, ...]:
    """Return table, floor and wall, or the one surface behind floating clutter."""
    if not tabletop:
        back = np.eye(4)
        back[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.45, 3)).as_matrix()
        back[2, 3] = target.center[2] + target.solid.radius + rng.uniform(0.1, 1.2)
        kind = int(rng.integers(3))
        return (Plane(back, (9.0, 9.0), scene.textures[kind], scene.tiles[kind]),)
    spin = np.eye(4)
    spin[:3, :3] = Rotation.from_euler("z", rng.uniform(-45, 45), degrees=True).as_matrix()
    room = 0.75 * np.array(scene.table_half_extent) - 0.1
    spin[:2, 3] = spin[:2, :2] @ (rng.uniform(-1, 1, 2) * np.maximum(room, 0.05))
    table = frame @ spin
    drop = np.eye(4)
    drop[2, 3] = -scene.table_height
    floor = table @ drop
    wall_turn = np.eye(4)
    wall_turn[:3, :3] = Rotation.from_euler("zx", [rng.uniform(-30, 30), 90], degrees=True).as_matrix()
    wall_turn[:3, 3] = wall_turn[:3, 2] * -rng.uniform(0.6, 2.5)
    return (
        Plane(table, scene.table_half_extent, scene.textures[0], scene.tiles[0]),
        Plane(floor, (9.0, 9.0), scene.textures[1], scene.tiles[1]),
        Plane(frame @ wall_turn, (9.0, 9.0), scene.textures[2], scene.tiles[2]),
    )


def _draw_lights(up: np.ndarray, settings: SceneSettings, rng: np.random.Generator) -> Lights:
    """Draw ambient light and two lamps, the first from above."""
    first = up * rng.uniform(0.5, 1.2) + rng.normal(0, 0.45, 3)
    second = np.array([0, 0, -0.6]) + 0.4 * up + rng.normal(0, 0.7, 3)
    directions = tuple((float(d[0]), float(d[1]), float(d[2])) for d in (first, second))
    strengths = (float(rng.uniform(0.2, 0.75)), float(rng.uniform(0.05, 0.4)))
    return Lights(
        ambient=float(rng.uniform(0.3, 0.65)),
        directions=directions,
        strengths=strengths,
        specular=float(rng.uniform(0, 0.35) * (rng.random() < 0.5)),
        shininess=float(rng.uniform(5, 40)),
        shadows=bool(rng.random() < settings.shadow_share),
        shadow_blur=float(rng.uniform(0.5, 3)),
        background=tuple(float(c) for c in random_color(rng)),  # type: ignore[arg-type]
    )


def shift_camera(layout: Layout, offset: float) -> Layout:
    """Return the layout as a second camera sees it that stands `offset` [m] to the right."""
    move = np.eye(4)
    move[0, 3] = -offset
    placed = tuple(Placed(p.solid, move @ p.camera_from_object) for p in layout.placed)
    planes = tuple(replace(p, camera_from_plane=move @ p.camera_from_plane) for p in layout.planes)
    return replace(layout, placed=placed, planes=planes)


__all__ = ["Layout", "Library", "Mesh", "Placed", "SceneSet", "SceneSettings", "draw_layout", "draw_set", "shift_camera"]
