"""Simulate objects that fall on a table and come to rest, with mujoco (extra `sim`).

They then lean, tip over and touch, as real objects do.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from posefilter.errors import missing_package
from posefilter.geometry.rigid import move, rigid
from posefilter.synthetic.placing import Placed, Table, are_separate
from posefilter.synthetic.solids import Solid

_STEP = 0.004  # [s]
_LONGEST = 2.0  # [s]; round things roll on for ever
_STILL = 0.01  # [m/s, rad/s]
_DENSITY = 300.0  # [kg/m^3] of a box that holds something light


def load_mujoco() -> Any:
    """Import mujoco.

    Raises:
        UserError: It is missing.
    """
    try:
        import mujoco
    except ImportError as error:
        raise missing_package("settle=true", "mujoco", "sim") from error
    return mujoco


def settle(placed: Sequence[Placed], table: Table, rng: np.random.Generator) -> list[Placed]:
    """Simulate objects, the target first, until they rest; leave out those that left the table, but
    for the target.

    Half of the others fall from up to 12 cm in a random rotation.

    Raises:
        UserError: mujoco is missing.
    """
    mujoco = load_mujoco()
    start = [
        placed[0],
        *(_drop(one, placed, table, rng) if rng.random() < 0.5 else one for one in placed[1:]),
    ]
    spot_from_camera = np.linalg.inv(table.camera_from_spot)
    model = mujoco.MjModel.from_xml_string(_world([one.solid for one in start]))
    data = mujoco.MjData(model)
    for k, one in enumerate(start):
        pose = spot_from_camera @ one.camera_from_object
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        data.qpos[7 * k : 7 * k + 7] = [*pose[:3, 3], w, x, y, z]
    mujoco.mj_forward(model, data)
    for step in range(round(_LONGEST / _STEP)):
        mujoco.mj_step(model, data)
        if step > 50 and np.abs(data.qvel).max() < _STILL:
            break
    out = []
    for k, one in enumerate(start):
        w, x, y, z = data.qpos[7 * k + 3 : 7 * k + 7]
        pose = rigid(Rotation.from_quat([x, y, z, w]).as_matrix(), data.qpos[7 * k : 7 * k + 3])
        rested = Placed(one.solid, table.camera_from_spot @ pose)
        if k == 0 or table.carries(rested):
            out.append(rested)
    return out


def _drop(one: Placed, placed: Sequence[Placed], table: Table, rng: np.random.Generator) -> Placed:
    """Return an object in a random rotation, raised by up to 12 cm; unchanged if that touches."""
    turn = Rotation.random(rng=rng).as_matrix()
    pose = rigid(turn, one.center - turn @ one.solid.center)
    up = table.camera_from_spot[:3, 2]
    lowest = ((move(one.solid.hull, pose) - table.camera_from_spot[:3, 3]) @ up).min()
    pose[:3, 3] += up * (rng.uniform(0.01, 0.12) - lowest)
    held = Placed(one.solid, pose)
    return held if all(other is one or are_separate(held, other) for other in placed) else one


def _world(solids: Sequence[Solid]) -> str:
    """Return mujoco's XML of a table plane and free convex bodies, each in its own frame."""
    contact = 'condim="6" friction="0.7 0.01 0.002"'
    meshes = "".join(
        f'<mesh name="m{k}" maxhullvert="64" vertex="{_vertices(solid)}"/>'
        for k, solid in enumerate(solids)
    )
    bodies = "".join(
        f'<body><freejoint/><geom type="mesh" mesh="m{k}" density="{_DENSITY}" {contact}/></body>'
        for k in range(len(solids))
    )
    plane = f'<geom type="plane" size="5 5 0.1" {contact}/>'
    option = f'<option timestep="{_STEP}" integrator="implicitfast"/>'
    return f"<mujoco>{option}<asset>{meshes}</asset><worldbody>{plane}{bodies}</worldbody></mujoco>"


@lru_cache(maxsize=256)
def _vertices(solid: Solid) -> str:
    """Return the vertices of a hull as mujoco's XML has them; cached by identity."""
    return " ".join(f"{x:.6f}" for x in solid.hull.reshape(-1))
