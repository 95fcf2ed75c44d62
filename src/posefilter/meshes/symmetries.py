"""Symmetries of objects: declared transforms that change nothing one can see."""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from posefilter.errors import UserError
from posefilter.geometry.pose import is_rigid
from posefilter.geometry.rigid import rigid
from posefilter.geometry.rotation import exp_so3, spread_rotations
from posefilter.limits import read_json

MOST = 10_000  # symmetries of an object
_MOST_BYTES = 1 << 24  # of a file of them
_MOST_PRODUCTS = 120  # the rotations of an icosahedron are 60
SAME_TURN = 0.2  # of rotation matrices' entries: less is the error of a measured axis
_PARALLEL = np.cos(np.deg2rad(10.0))


def symmetry_group(
    discrete: list[np.ndarray] | None = None,
    continuous: list[tuple[np.ndarray, np.ndarray]] | None = None,
    steps: int = 36,
) -> np.ndarray:
    """Return every product of discrete symmetries and steps about continuous axes.  -> (S, 4, 4),
    the identity first.

    Turns about two axes that cross make all rotations: then it is `steps` squared of these, evenly
    spread, about the point where the axes meet.

    `discrete`: (4, 4) each, as BOP lists them (all but the identity), or some of which the others
    are products. `continuous`: (axis, a point on it [m]) each, cut into `steps` equal turns.

    Raises:
        ValueError: They are more than `MOST`, the products of discrete ones have no end, or an
            axis has no direction.
    """
    group, lines = close_group(discrete or []), []
    for axis, offset in continuous or []:
        length = float(np.linalg.norm(axis))
        if not (np.isfinite(length) and length > 0):
            raise ValueError(f"an axis of length {length:g}")
        lines.append((np.asarray(axis, dtype=np.float64) / length, offset))
    crossing = any(not are_parallel(a, b) for (a, _), (b, _) in pairwise(lines))
    if (steps**2 if crossing else len(group) * steps ** len(lines)) > MOST:
        raise ValueError(f"more than {MOST:,} symmetries")
    if crossing:
        center = _meet(lines)
        turns = [np.eye(3), *spread_rotations(steps**2 - 1).numpy()]
        return np.stack([rigid(turn, center - turn @ center) for turn in turns])
    for axis, offset in lines:
        about = [rotation_about(axis, 2 * np.pi * k / steps, offset) for k in range(steps)]
        group = [a @ b for a in group for b in about]
    return np.stack(group)


def close_group(discrete: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the identity, symmetries (4, 4) as they are, and all products of them that turn the
    object otherwise: a quarter turn has a half turn and three quarters with it.

    Of an object, no two symmetries have one rotation: where turns are within the errors of measured
    axes of each other they count as one.

    Raises:
        ValueError: The products have no end.
    """
    group = [np.eye(4), *discrete]
    if len(group) > _MOST_PRODUCTS:  # a continuous one in steps, listed whole
        return group
    turns = np.stack(group)[:, :3, :3]
    for element in group:  # grows meanwhile
        for generator in discrete:
            product = element @ generator
            if np.abs(turns - product[:3, :3]).max(axis=(1, 2)).min() > SAME_TURN:
                group.append(product)
                turns = np.concatenate([turns, product[None, :3, :3]])
        if len(group) > _MOST_PRODUCTS:
            raise ValueError("the products of its discrete symmetries have no end")
    return group


def are_parallel(a: np.ndarray, b: np.ndarray) -> bool:
    """Tell whether two unit vectors are parallel, within 10 degrees."""
    return bool(abs(a @ b) > _PARALLEL)


def _meet(lines: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Return the point that is nearest to all lines (unit axis, point), least squares.  -> (3,)."""
    across = [np.eye(3) - np.outer(axis, axis) for axis, _ in lines]
    right = [P @ point for P, (_, point) in zip(across, lines, strict=True)]
    return np.linalg.solve(np.sum(across, axis=0), np.sum(right, axis=0))


def rotation_about(axis: np.ndarray, angle: float, point: np.ndarray) -> np.ndarray:
    """Return the turn by an angle [rad] about a line.

    Unit axis (3,), a point on it (3,) [m] -> (4, 4).
    """
    turn = exp_so3(torch.as_tensor(np.asarray(axis, dtype=np.float64) * angle)).numpy()
    return rigid(turn, point - turn @ point)


_floats = partial(np.array, dtype=np.float64)
_ALONE = {"symmetries_discrete", "symmetries_continuous"}  # keys of a file for one object


def declares(info: Path, name: str) -> bool:
    """Return whether a file in the format of `read_symmetries` says something of an object; one
    that cannot be read counts as such, since reading it tells why.
    """
    try:
        table = read_json(info, _MOST_BYTES)
    except UserError:
        return True
    plain = isinstance(table, dict)
    return not plain or bool({*_list_keys(name)} & set(table) or _ALONE & set(table))


def has_one_group(info: Path) -> bool:
    """Return whether a file in the format of `read_symmetries` holds the entry of one object alone,
    and does not say of which.
    """
    table = read_json(info, _MOST_BYTES)
    return isinstance(table, dict) and bool(_ALONE & set(table))


def _list_keys(name: str) -> list[str]:
    """Return what an object may be called in a file."""
    digits = "".join(c for c in name if c.isdigit())
    return [name, digits.lstrip("0")] if name.startswith("obj_") else [name]


def read_symmetries(info: Path, name: str, scale: float, steps: int) -> np.ndarray:
    """Read an entry of BOP's models_info.json (or a symmetries.json of the same kind), lengths in
    the mesh file's unit.
    """
    try:
        table = read_json(info, _MOST_BYTES)
        if not isinstance(table, dict):
            raise ValueError("no mapping of names")
        alone = table if _ALONE & set(table) else {}
        entry = next((table[k] for k in _list_keys(name) if k in table), alone)
        discrete = [_floats(m).reshape(4, 4) for m in entry.get("symmetries_discrete", [])]
        for matrix in discrete:
            matrix[:3, 3] *= scale
        continuous = [
            (_floats(c["axis"]), _floats(c.get("offset", [0, 0, 0])) * scale)
            for c in entry.get("symmetries_continuous", [])
        ]
        return identity_first(symmetry_group(discrete, continuous, steps), str(info))
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise UserError(
            f"{info}: cannot read the symmetries of '{name}' ({error}); the format is BOP's "
            f"models_info"
        ) from error


def identity_first(symmetries: np.ndarray, source: str) -> np.ndarray:
    """Return the symmetries with the identity first and once; UserError, naming their source,
    unless rigid.  (S, 4, 4).
    """
    if symmetries.ndim != 3 or symmetries.shape[1:] != (4, 4):
        raise UserError(f"{source}: symmetries must be of shape (S, 4, 4), not {symmetries.shape}")
    if not is_rigid(torch.from_numpy(symmetries)):
        raise UserError(
            f"{source}: a symmetry is not a rigid transform (rotation and translation, no mirror)"
        )
    is_identity = np.abs(symmetries - np.eye(4)).max(axis=(1, 2)) < 1e-9
    return np.concatenate([np.eye(4)[None], symmetries[~is_identity]])
