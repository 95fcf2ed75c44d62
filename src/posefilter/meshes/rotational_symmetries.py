"""Turns of an object onto itself: which of those found generate its symmetries, and the group that
they make.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from posefilter.meshes.symmetries import SAME_TURN, are_parallel, rotation_about, symmetry_group

ANY = 0  # the fold of a turn by any angle
_MOST_ELEMENTS = 60  # of a finite group of turns that is not of one axis
_SMALLEST = np.deg2rad(25.0)  # turn in a group of turns by a quarter and more


class RotationalSymmetry(NamedTuple):
    """A turn that was tried, and how well it fits."""

    axis: np.ndarray  # (3,) unit vector
    point: np.ndarray  # (3,) on the axis [m]
    fold: int  # 2, 3, 4 or 5 for turns by that part of a circle, 0 for any
    # mean distance of the turned surface to the surface, less that of two samplings [m]
    distance: float
    far: float  # the same of the distance that a fiftieth of the samples exceed [m]
    color: float  # difference that a twentieth of the samples exceed, in [0, 1]
    shape: bool  # whether the shape is the same
    texture: bool  # whether shape and texture are


def select(turns: Sequence[RotationalSymmetry], texture: bool = True) -> list[RotationalSymmetry]:
    """Return the turns that generate a mesh's symmetries.

    Args:
        turns: What `find_symmetries` has found.
        texture: Leave out those that change what one sees; False: all that keep the shape.

    Returns:
        Two continuous ones at most, since those of two axes make all turns; beside a continuous
        one a half turn across it at most; else all discrete ones.
    """
    good = [turn for turn in turns if turn.texture or not texture]
    continuous = [turn for turn in good if turn.fold == ANY][:2]
    if not continuous:  # a half turn about an axis of quarter turns is two of them
        quarters = [turn.axis for turn in good if turn.fold == 4]
        return [
            turn
            for turn in good
            if turn.fold != 2 or not any(are_parallel(axis, turn.axis) for axis in quarters)
        ]
    across = [
        turn
        for turn in good
        if turn.fold == 2 and all(abs(turn.axis @ c.axis) < 0.1 for c in continuous)
    ]
    return [*continuous, *(across[:1] if len(continuous) == 1 else [])]


def make_group(turns: Sequence[RotationalSymmetry], size: float, steps: int = 36) -> np.ndarray:
    """Return every product of turns.

    Args:
        turns: What `select` returns.
        size: The object's diameter [m].
        steps: Turns that a continuous symmetry is cut into; of two, `steps` squared rotations are
            returned, evenly spread.

    Returns:
        (S, 4, 4) object_from_object [m], the identity first.
    """
    continuous = [(turn.axis, turn.point) for turn in turns if turn.fold == ANY]
    return symmetry_group(list_discrete(turns, size), continuous, steps)


def list_discrete(turns: Sequence[RotationalSymmetry], size: float) -> list[np.ndarray]:
    """Return every product of the discrete turns but the identity, (4, 4) each.

    A turn that is a product of those before it, which fit better, adds nothing. One whose products
    with them do not close, as they do in a group, is left out: its axis is measured too badly.
    """
    kept: list[np.ndarray] = []
    # a far origin moves by more than the object does
    middle = (
        np.append(np.mean([turn.point for turn in turns], axis=0), 1) if turns else np.eye(4)[3]
    )
    group = _close(kept, size, middle)
    for turn in turns:
        if turn.fold == ANY:
            continue
        own = rotation_about(turn.axis, 2 * np.pi / turn.fold, turn.point)
        if not all(_differ(own, one, size, middle) for one in group):
            continue  # a product of turns that fit better: its own error would add to theirs
        more = [*kept, own]
        products = _close(more, size, middle)
        if len(products) <= _MOST_ELEMENTS and min(map(measure_angle, products[1:])) > _SMALLEST:
            kept, group = more, products
    return group[1:]


def describe_symmetries(turns: Sequence[RotationalSymmetry], size: float) -> dict[str, Any]:
    """Return what `select` returns in the BOP challenge's format, in meters.

    `size`: the object's diameter [m].
    """
    discrete = list_discrete(turns, size)
    return {
        "symmetries_discrete": [matrix.reshape(-1).tolist() for matrix in discrete],
        "symmetries_continuous": [
            {"axis": turn.axis.tolist(), "offset": turn.point.tolist()}
            for turn in turns
            if turn.fold == ANY
        ],
    }


def _close(generators: Sequence[np.ndarray], size: float, middle: np.ndarray) -> list[np.ndarray]:
    """Return the products of transforms, the identity first; more than `_MOST_ELEMENTS` of them
    where they do not close.
    """
    group = [np.eye(4)]
    for element in group:  # grows meanwhile
        for generator in generators:
            product = element @ generator
            if all(_differ(product, one, size, middle) for one in group):
                group.append(product)
        if len(group) > _MOST_ELEMENTS:
            break
    return group


def measure_angle(transforms: np.ndarray) -> np.ndarray:
    """Return the angles of turns.  (..., 4, 4) -> (...) [rad]."""
    trace = np.trace(transforms[..., :3, :3], axis1=-2, axis2=-1)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _differ(a: np.ndarray, b: np.ndarray, size: float, middle: np.ndarray) -> bool:
    """Tell whether two transforms differ by more than the errors of measured axes, in what they do
    to the object about its middle (4,), homogeneous.
    """
    turned = np.abs(a[:3, :3] - b[:3, :3]).max() > SAME_TURN
    return bool(turned or np.abs((a - b) @ middle).max() > 0.1 * size)
