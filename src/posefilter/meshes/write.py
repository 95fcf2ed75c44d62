"""Write a mesh as Wavefront OBJ with its texture, such that reading it gives the same mesh."""

from pathlib import Path

import cv2
import numpy as np

from posefilter.files import write_whole
from posefilter.meshes.mesh import Mesh


def write_obj(mesh: Mesh, folder: Path) -> Path:
    """Write `textured.obj`, its material and its texture into a folder, in meters.

    Args:
        mesh: The mesh; its symmetries are not written.
        folder: Made where it is missing.

    Returns:
        The OBJ file.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if mesh.corner_colors is not None:  # OBJ keeps colors with vertices: each corner gets its own
        vertices = mesh.vertices[mesh.faces].reshape(-1, 3)
        faces = np.arange(len(vertices)).reshape(-1, 3)
    rows = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    if mesh.corner_colors is not None:
        colors = mesh.corner_colors.reshape(-1, 3).tolist()
        rows = [
            f"{row} {r:.6g} {g:.6g} {b:.6g}" for row, (r, g, b) in zip(rows, colors, strict=True)
        ]
    lines = ["mtllib textured.mtl", "usemtl material", *(f"v {row}" for row in rows)]
    normals, normal = _index(mesh.corner_normals)
    lines += [f"vn {x:.7g} {y:.7g} {z:.7g}" for x, y, z in normals.tolist()]
    if mesh.corner_uv is None:
        corners = [f"{v}//{n}" for v, n in zip(faces.ravel() + 1, normal, strict=True)]
    else:
        places, place = _index(mesh.corner_uv)
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in places.tolist()]
        corners = [f"{v}/{t}/{n}" for v, t, n in zip(faces.ravel() + 1, place, normal, strict=True)]
    lines += [f"f {a} {b} {c}" for a, b, c in np.array(corners).reshape(-1, 3).tolist()]
    file = folder / "textured.obj"
    done, texture = cv2.imencode(".png", cv2.cvtColor(mesh.texture, cv2.COLOR_RGB2BGR))
    assert done
    write_whole(folder / "texture.png", texture.tobytes())
    material = "newmtl material\nKd 1 1 1\nmap_Kd texture.png\n"
    write_whole(folder / "textured.mtl", material)
    write_whole(file, "\n".join(lines) + "\n")
    return file


def _index(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct rows of corner values (F, 3, D), and each corner's, numbered from 1."""
    rows, index = np.unique(values.reshape(-1, values.shape[-1]), axis=0, return_inverse=True)
    return rows, index.reshape(-1) + 1
