"""Write a toy duck for docs/tour.md, 19 cm long, to a mesh file: python docs/duck.py
outputs/tour/meshes/duck.ply.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh

YELLOW, ORANGE, BLACK, BLUE, RED = (
    (242, 196, 40),
    (228, 92, 28),
    (20, 20, 24),
    (48, 110, 200),
    (196, 44, 70),
)
# half axes and center [m], the duck's beak towards x and its feet at z = 0; its wings tell left
# from right
BALLS = (
    ((0.080, 0.055, 0.050), (0.000, 0.000, 0.050), YELLOW),
    ((0.040, 0.038, 0.038), (0.052, 0.000, 0.116), YELLOW),
    ((0.024, 0.020, 0.008), (0.096, 0.000, 0.110), ORANGE),
    ((0.030, 0.022, 0.016), (-0.072, 0.000, 0.076), ORANGE),
    ((0.046, 0.010, 0.027), (-0.010, 0.051, 0.056), BLUE),
    ((0.046, 0.010, 0.027), (-0.010, -0.051, 0.056), RED),
    ((0.007, 0.007, 0.007), (0.080, 0.020, 0.130), BLACK),
    ((0.007, 0.007, 0.007), (0.080, -0.020, 0.130), BLACK),
)


def duck() -> trimesh.Trimesh:
    """Return the duck, in meters, colored by vertex."""
    parts = []
    for half_axes, center, color in BALLS:
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.apply_transform(np.diag([*half_axes, 1.0]))
        ball.apply_translation(center)
        ball.visual.vertex_colors = np.tile([*color, 255], (len(ball.vertices), 1)).astype(np.uint8)
        parts.append(ball)
    return trimesh.util.concatenate(parts)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("name the file to write: python docs/duck.py outputs/tour/meshes/duck.ply")
    path = Path(sys.argv[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    duck().export(path)
    print(path)
