"""Draw scenes: a target among distractors and look-alikes, on a table or in the air.

A scene set (one folder of the dataset) fixes the surroundings, the distractors to choose from and
the look-alikes. Each of its frames has its own camera, layout and lights.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from posefilter.errors import UserError
from posefilter.geometry.rigid import rigid
from posefilter.meshes.mesh import LOOKALIKE
from posefilter.meshes.store import MeshStore
from posefilter.rendering.surfaces import Instance, Lights, Plane
from posefilter.synthetic.lookalikes import make_lookalike
from posefilter.synthetic.placing import (
    Placed,
    Table,
    View,
    compute_hiding_size,
    place_copies,
    place_distractor,
    place_floating_target,
    place_target_on_table,
    set_table,
)
from posefilter.synthetic.settle import settle
from posefilter.synthetic.solids import Solid, make_solid
from posefilter.synthetic.textures import random_color, random_texture

# [degrees] highest camera over a table where something has to stand in front
_OCCLUDED_ELEVATION = 45.0
# plain, checker, marble, wood, carpet, stripes, label
_TABLE = (0.3, 0.08, 0.1, 0.22, 0.12, 0.04, 0.14)
_FLOOR = (0.15, 0.15, 0.1, 0.2, 0.3, 0.05, 0.05)


@dataclass(frozen=True)
class SceneSettings:
    """The distributions that scenes are drawn from."""

    distractors: tuple[int, int] = (2, 8)  # least and most beside the target
    max_occlusion: float = 0.75  # largest share of the target that may be hidden
    # share of frames in which something is put right in front of the target
    occluded_fraction: float = 0.4
    tabletop_fraction: float = 0.65
    lookalike_fraction: float = 0.25  # chance that a distractor is a look-alike
    lookalikes: int = 4  # different ones a scene set
    lookalike_texture: str = "different"  # than the target's; or same: some have it
    classes: int = 14  # distractor classes a scene set
    distance: tuple[float, float] = (0.45, 1.4)  # [m] camera to target
    elevation_deg: tuple[float, float] = (10.0, 85.0)
    largest_truncation: float = 0.4  # share of the target's outline that may leave the frame
    shadow_fraction: float = 0.7
    settle: bool = False  # let the objects on a table fall and come to rest (mujoco)
    # share of frames that the target is taken out of, once all is placed
    absent_fraction: float = 0.0
    instances: int = 1  # of the target in a frame


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
class Layout:
    """One frame, ready to render.  The target comes first, all of its instances."""

    placed: tuple[Placed, ...]
    planes: tuple[Plane, ...]
    lights: Lights
    tabletop: bool
    targets: int = 1

    def instances(self) -> list[Instance]:
        """Return the objects as the renderer takes them."""
        return [Instance(p.solid.mesh, p.camera_from_object) for p in self.placed]


class SolidStore:
    """The solids of a mesh store, each computed on first use."""

    def __init__(self, store: MeshStore) -> None:
        self.store = store
        self.solid = cache(lambda name: make_solid(store.load(name)))


def choose_distractors(
    store: MeshStore, target: str, settings: SceneSettings, rng: np.random.Generator
) -> list[str]:
    """Choose the names of a scene set's distractors; the first draw of its generator."""
    others = [name for name in store.names() if name != target]
    return [others[i] for i in rng.permutation(len(others))[: settings.classes]]


def draw_scene_set(
    library: SolidStore, target: str, settings: SceneSettings, rng: np.random.Generator
) -> SceneSet:
    """Draw what the frames of one folder share.

    Args:
        library: The solids.
        target: Name of the target's mesh.
        settings: The distributions.
        rng: Source of randomness.
    """
    chosen = choose_distractors(library.store, target, settings, rng)
    goal = library.solid(target)
    distractors = tuple(library.solid(name) for name in chosen)
    photos = [s.mesh.texture for s in distractors if min(s.mesh.texture.shape[:2]) >= 64]
    least = settings.distractors[0]
    if len(distractors) + settings.lookalikes < least:
        raise UserError(
            f"distractors={least},{settings.distractors[1]}: there are {len(distractors)} other "
            f"meshes and {settings.lookalikes} look-alikes"
        )
    names = [f"{LOOKALIKE}{k:02d}" for k in range(settings.lookalikes)]
    same = settings.lookalike_texture == "same"
    lookalikes = tuple(
        make_solid(make_lookalike(goal.mesh, name, photos, rng, same)) for name in names
    )
    table, floor, wall = (random_texture(rng, 256, photos, w) for w in (_TABLE, _FLOOR, _FLOOR))
    tiles = rng.uniform(0.2, 1.2), rng.uniform(0.2, 1.5), rng.uniform(0.4, 2.0)
    half = rng.uniform(0.3, 1.2), rng.uniform(0.3, 1.2)
    height, textures = rng.uniform(0.3, 0.9), (table, floor, wall)
    return SceneSet(goal, distractors, lookalikes, textures, tiles, half, height)


def draw_layout(
    scene: SceneSet,
    settings: SceneSettings,
    K: np.ndarray,
    height: int,
    width: int,
    rng: np.random.Generator,
) -> Layout | None:
    """Draw the layout of one frame.

    Args:
        scene: What the frames of its folder share.
        settings: The distributions.
        K: (3, 3) camera matrix [px].
        height: Of the image [px].
        width: Of the image [px].
        rng: Source of randomness.

    Returns:
        The layout, or None where this draw is not possible and another has to be made.
    """
    view = View(K, height, width)
    occluded = bool(rng.random() < settings.occluded_fraction)
    least = 1 - settings.max_occlusion
    low, high = max(0.6, least), 1.0
    if occluded:  # at what is allowed; outlines only predict it
        low, high = max(0.28, least), 0.6 if least <= 0.6 else min(1.0, least + 0.08)
    wanted = rng.uniform(low, high)
    tabletop = bool(rng.random() < settings.tabletop_fraction)
    # not every corner of a table has room in front of the target
    for _ in range(8 if occluded else 1):
        placed, table = _draw_objects(scene, settings, view, tabletop, occluded, wanted, rng)
        enough = len(placed) >= settings.distractors[0] + settings.instances
        if enough and (not occluded or view.visible(placed) < wanted + 0.1):
            break
    if not enough:
        return None
    up = np.array([0.0, -0.8, -0.6]) if table is None else table.camera_from_top[:3, 2]
    planes = _surroundings(scene, placed[0], table, rng)
    lights = _draw_lights(up, settings, rng)
    return Layout(tuple(placed), planes, lights, tabletop, settings.instances)


def _draw_objects(
    scene: SceneSet,
    settings: SceneSettings,
    view: View,
    tabletop: bool,
    occluded: bool,
    wanted: float,
    rng: np.random.Generator,
) -> tuple[list[Placed], Table | None]:
    """Place the target and what is around it.

    Returns:
        The objects, none of them where the target leaves the frame, and their table if any.
    """
    distance = rng.uniform(*settings.distance)
    table = None
    if tabletop:
        low, high = settings.elevation_deg
        # from above nothing hides what stands behind it
        elevation = rng.uniform(low, min(high, max(_OCCLUDED_ELEVATION, low)) if occluded else high)
        target, camera_from_spot = place_target_on_table(
            scene.target, view, distance, elevation, rng
        )
        table = set_table(camera_from_spot, scene.table_half_extent, rng)
    else:
        target = place_floating_target(scene.target, view, distance, rng)
    more, largest = settings.instances - 1, settings.largest_truncation
    if not view.holds(target, largest):
        return [], table
    placed = place_copies(target, more, view, table, wanted, largest, rng)
    if placed is None:
        return [], table
    solids = _draw_solids(scene, settings, rng)
    if occluded:  # whatever can hide most is tried in front first
        solids.sort(key=lambda solid: -compute_hiding_size(solid))
    for solid in solids:
        in_front = occluded and view.visible(placed) > wanted + 0.06
        one = place_distractor(solid, placed, view, table, wanted, in_front, rng)
        if one is not None:
            placed.append(one)
    if settings.settle and table is not None:
        placed = settle(placed, table, rng)
        own = placed[: settings.instances]  # a copy may have rolled off the table
        lost = len(own) < settings.instances or any(one.solid is not target.solid for one in own)
        hidden = view.visible(placed) < 1 - settings.max_occlusion
        if lost or hidden or not all(view.holds(one, largest) for one in own):
            return [], table
    return placed, table


def _draw_solids(scene: SceneSet, settings: SceneSettings, rng: np.random.Generator) -> list[Solid]:
    """Choose a frame's distractors, no class twice."""
    low, high = settings.distractors
    count = int(rng.integers(low, high + 1))
    usual = [scene.distractors[i] for i in rng.permutation(len(scene.distractors))]
    alike = [scene.lookalikes[i] for i in rng.permutation(len(scene.lookalikes))]
    out: list[Solid] = []
    while len(out) < count and (usual or alike):
        look = alike and (not usual or rng.random() < settings.lookalike_fraction)
        out.append((alike if look else usual).pop())
    return out


def _surroundings(
    scene: SceneSet, target: Placed, table: Table | None, rng: np.random.Generator
) -> tuple[Plane, ...]:
    """Return table, floor and wall, or the one plane behind objects in the air."""
    if table is None:
        turn = Rotation.from_rotvec(rng.normal(0, 0.45, 3)).as_matrix()
        far = target.center[2] + target.solid.radius + rng.uniform(0.1, 1.2)
        back = rigid(turn, [0, 0, far])
        kind = int(rng.integers(3))
        return (Plane(back, (9.0, 9.0), scene.textures[kind], scene.tiles[kind]),)
    floor = table.camera_from_top @ rigid(np.eye(3), [0, 0, -scene.table_height])
    turn = Rotation.from_euler("zx", [rng.uniform(-30, 30), 90], degrees=True).as_matrix()
    wall_turn = rigid(turn, turn[:, 2] * -rng.uniform(0.6, 2.5))
    return (
        Plane(table.camera_from_top, table.half_extent, scene.textures[0], scene.tiles[0]),
        Plane(floor, (9.0, 9.0), scene.textures[1], scene.tiles[1]),
        Plane(table.camera_from_spot @ wall_turn, (9.0, 9.0), scene.textures[2], scene.tiles[2]),
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
        shadows=bool(rng.random() < settings.shadow_fraction),
        shadow_blur=float(rng.uniform(0.5, 3)),
        background=tuple(float(c) for c in random_color(rng)),  # type: ignore[arg-type]
    )


def remove_target(layout: Layout) -> Layout:
    """Return the layout without its target, all of its instances; all else stays where it is."""
    return replace(layout, placed=layout.placed[layout.targets :], targets=0)


def shift_camera(layout: Layout, offset: float) -> Layout:
    """Return the layout in the frame of a camera that stands `offset` [m] to the right."""
    return move_all(layout, rigid(np.eye(3), [-offset, 0, 0]))


def move_all(layout: Layout, motion: np.ndarray) -> Layout:
    """Return the layout with all in it moved (4, 4) [m] before the camera, lights too."""
    placed = tuple(Placed(p.solid, motion @ p.camera_from_object) for p in layout.placed)
    planes = tuple(
        replace(p, camera_from_plane=motion @ p.camera_from_plane) for p in layout.planes
    )
    ways = [motion[:3, :3] @ np.array(way) for way in layout.lights.directions]
    directions = tuple((float(x), float(y), float(z)) for x, y, z in ways)
    lights = replace(layout.lights, directions=directions)
    return replace(layout, placed=placed, planes=planes, lights=lights)
