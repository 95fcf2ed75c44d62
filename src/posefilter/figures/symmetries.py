"""Draw the symmetries that were found: the object as it is, and turned by each of them."""

from collections.abc import Sequence

import numpy as np
import torch

from posefilter.figures.canvas import AXES, arrange_grid, draw_lines, draw_row
from posefilter.geometry.rigid import move, rigid
from posefilter.geometry.symmetries import is_ball
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.meshes.rotational_symmetries import ANY, RotationalSymmetry, measure_angle
from posefilter.meshes.symmetries import SAME_TURN, rotation_about
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.surfaces import Instance, Lights

_TILE = 260  # [px]
_ANY_SHOWN = np.deg2rad(100.0)  # of a continuous symmetry
_SAME_ANGLE = np.deg2rad(8.0)  # a fifth of a turn is no sixth
_DISTANCE = 1.6  # of the camera, in diameters
_WORDS = {
    ANY: "any turn",
    2: "half turn",
    3: "third of a turn",
    4: "quarter turn",
    5: "fifth of a turn",
}
_LIGHTS = Lights(background=(1.0, 1.0, 1.0), specular=0.1)
# seen from above and from the side; the camera's axes in the object's
_VIEW = np.array([[0.8, 0.6, 0.0], [0.24, -0.32, -0.9165], [-0.55, 0.7333, -0.4]])


def draw_symmetries(
    mesh: Mesh, found: Sequence[RotationalSymmetry], symmetries: np.ndarray, source: str
) -> np.ndarray:
    """Draw a row a turn: the object with the turn's axis, and turned.

    Args:
        mesh: The object.
        found: The turns that leave its shape as it is.
        symmetries: (S, 4, 4) those in use [m].
        source: Where these come from, in words.

    Returns:
        The picture (h, w, 3) uint8.
    """
    renderer, size = EmbreeRenderer(), diameter(mesh.vertices)
    camera = _place_camera(mesh, size)
    K = np.array([[1.3 * _TILE, 0, _TILE / 2], [0, 1.3 * _TILE, _TILE / 2], [0, 0, 1.0]])
    width = 2 * _TILE + 18
    rows = [draw_row(width, f"{mesh.name}: symmetries {source}", size=16)]
    for turn in found:
        turned = camera @ _transform_of(turn)
        tiles = [_render(renderer, mesh, pose, K) for pose in (camera, turned)]
        for tile in tiles:
            _draw_axis(tile, turn, camera, K, _DISTANCE * size)
        mark = "in use" if is_in_use(turn, symmetries) else "not in use"
        rows.append(draw_row(width, f"{describe_turn(turn)}: {mark}", size=13))
        rows.append(draw_row(width, _measure(turn), size=11))
        rows.append(arrange_grid(tiles, 2))
    if not found:
        rows.append(draw_row(width, "no turn leaves its shape as it is", size=13))
        rows.append(arrange_grid([_render(renderer, mesh, camera, K)], 1))
    return arrange_grid(rows, 1, gap=0)


def describe_turn(turn: RotationalSymmetry) -> str:
    """Return a turn in words: `half turn about (0.00, 0.00, 1.00)`."""
    axis = ", ".join(f"{x:.2f}" for x in turn.axis + 0.0)
    return f"{_WORDS[turn.fold]} about ({axis})"


def is_in_use(turn: RotationalSymmetry, symmetries: np.ndarray) -> bool:
    """Return whether a turn is one of the symmetries (S, 4, 4), up to the error of a measured axis,
    which changes the angle less.
    """
    if is_ball(torch.from_numpy(symmetries)):  # which stand for all rotations, some way apart
        return True
    transform = _transform_of(turn)
    near = np.abs(symmetries - transform)[:, :3, :3].max((1, 2)) < SAME_TURN
    alike = np.abs(measure_angle(symmetries) - measure_angle(transform)) < _SAME_ANGLE
    return bool((near & alike).any())


def _measure(turn: RotationalSymmetry) -> str:
    texture = "same texture" if turn.texture else "another texture"
    return (
        f"surface {1000 * max(turn.distance, 0):.1f} mm off, farthest "
        f"{1000 * max(turn.far, 0):.1f} mm; color difference {turn.color:.2f}: {texture}"
    )


def _transform_of(turn: RotationalSymmetry) -> np.ndarray:
    """Return the transform (4, 4) [m] by which a turn is shown."""
    angle = _ANY_SHOWN if turn.fold == ANY else 2 * np.pi / turn.fold
    return rotation_about(turn.axis, angle, turn.point)


def _place_camera(mesh: Mesh, size: float) -> np.ndarray:
    """Return camera_from_object (4, 4) [m], the object's center ahead.

    The object is scaled from its size [m] to 1 m: a small one would be nearer than all that is
    drawn.
    """
    U, _, Vt = np.linalg.svd(_VIEW)
    rotation = U @ Vt
    rotation *= np.sign(np.linalg.det(rotation)) / size
    return rigid(rotation, np.array([0, 0, _DISTANCE]) - rotation @ mesh.bounds.mean(0))


def _render(renderer: EmbreeRenderer, mesh: Mesh, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    rgb = renderer.render([Instance(mesh, pose)], K, _TILE, _TILE, _LIGHTS).rgb
    return (rgb.clip(0, 1) * 255).astype(np.uint8)


def _draw_axis(
    tile: np.ndarray, turn: RotationalSymmetry, camera: np.ndarray, K: np.ndarray, length: float
) -> None:
    ends = turn.point + np.array([[-0.4], [0.4]]) * length * turn.axis
    pixels = move(ends, camera) @ K.T
    draw_lines(tile, [pixels[:, :2] / pixels[:, 2:]], AXES[2], 2)
