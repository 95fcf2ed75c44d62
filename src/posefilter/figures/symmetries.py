"""Draw the symmetries that were found: the object as it is, and turned by each of them."""

from collections.abc import Sequence

import numpy as np

from posefilter.figures.canvas import AXES, arrange_grid, draw_lines, draw_row
from posefilter.geometry.rigid import move, rigid
from posefilter.meshes.mesh import Mesh, diameter
from posefilter.meshes.rotational_symmetries import ANY, RotationalSymmetry
from posefilter.meshes.symmetries import rotation_about
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.surfaces import Instance, Lights

_TILE = 260  # [px]
_ANY_SHOWN = np.deg2rad(100.0)  # of a continuous symmetry
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
    renderer, near = EmbreeRenderer(), 1.6 * diameter(mesh.vertices)
    camera = _place_camera(mesh, near)
    K = np.array([[1.3 * _TILE, 0, _TILE / 2], [0, 1.3 * _TILE, _TILE / 2], [0, 0, 1.0]])
    width = 2 * _TILE + 18
    rows = [draw_row(width, f"{mesh.name}: symmetries {source}", size=16)]
    for turn in found:
        angle = _ANY_SHOWN if turn.fold == ANY else 2 * np.pi / turn.fold
        transform = rotation_about(turn.axis, angle, turn.point)
        turned = camera @ transform
        tiles = [_render(renderer, mesh, pose, K) for pose in (camera, turned)]
        for tile in tiles:
            _draw_axis(tile, turn, camera, K, near)
        mark = "in use" if _contains(symmetries, transform) else "not in use"
        rows.append(draw_row(width, f"{describe_turn(turn)}: {mark}", size=13))
        rows.append(draw_row(width, _measure(turn), size=11))
        rows.append(arrange_grid(tiles, 2))
    if not found:
        rows.append(draw_row(width, "no turn leaves its shape as it is", size=13))
        rows.append(arrange_grid([_render(renderer, mesh, camera, K)], 1))
    return arrange_grid(rows, 1, gap=0)


def describe_turn(turn: RotationalSymmetry) -> str:
    """Return a turn in words: `half turn about (0.00, 0.00, 1.00)`."""
    kind = {ANY: "any turn", 2: "half turn", 3: "third of a turn", 4: "quarter turn"}[turn.fold]
    axis = ", ".join(f"{x:.2f}" for x in turn.axis + 0.0)
    return f"{kind} about ({axis})"


def _measure(turn: RotationalSymmetry) -> str:
    texture = "same texture" if turn.texture else "another texture"
    return (
        f"surface {1000 * max(turn.distance, 0):.1f} mm off, farthest "
        f"{1000 * max(turn.far, 0):.1f} mm; color difference {turn.color:.2f}: {texture}"
    )


def _contains(symmetries: np.ndarray, transform: np.ndarray) -> bool:
    """Tell whether a turn is one of the symmetries, up to the error of a measured axis."""
    return bool((np.abs(symmetries - transform)[:, :3, :3].max((1, 2)) < 0.2).any())


def _place_camera(mesh: Mesh, distance: float) -> np.ndarray:
    """Return camera_from_object (4, 4) [m]: the object's center that far ahead."""
    U, _, Vt = np.linalg.svd(_VIEW)
    rotation = U @ Vt
    rotation *= np.sign(np.linalg.det(rotation))
    return rigid(rotation, np.array([0, 0, distance]) - rotation @ mesh.bounds.mean(0))


def _render(renderer: EmbreeRenderer, mesh: Mesh, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    rgb = renderer.render([Instance(mesh, pose)], K, _TILE, _TILE, _LIGHTS).rgb
    return (rgb.clip(0, 1) * 255).astype(np.uint8)


def _draw_axis(
    tile: np.ndarray, turn: RotationalSymmetry, camera: np.ndarray, K: np.ndarray, length: float
) -> None:
    ends = turn.point + np.array([[-0.4], [0.4]]) * length * turn.axis
    pixels = move(ends, camera) @ K.T
    draw_lines(tile, [pixels[:, :2] / pixels[:, 2:]], AXES[2], 2)
