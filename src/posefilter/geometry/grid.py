"""A uniform, nested grid on SO(3): HEALPix on the sphere times the circle.

Yershova et al.: Generating uniform incremental grids on SO(3) using the Hopf fibration (2010).
"""

import math

import torch
from torch import Tensor

from posefilter.geometry.rotation import matrix_from_quat_xyzw

# each base face's southern corner, in rings of nside (Gorski et al. 2005)
_FACE_RING = (2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 4)
_FACE_MERIDIAN = (1, 3, 5, 7, 0, 2, 4, 6, 1, 3, 5, 7)  # each base face's center, in units of pi / 4


def healpix_directions(face: Tensor, x: Tensor, y: Tensor, nside: int) -> tuple[Tensor, Tensor]:
    """Return the centers of HEALPix cells (Gorski et al. 2005).

    Args:
        face: (*) int64, base face, 0 to 11.
        x: (*) int64, the cell's index towards the north-east, 0 to nside - 1.
        y: (*) int64, the cell's index towards the north-west.
        nside: Cells along the side of a base face.

    Returns:
        Cosines of the polar angles (*), azimuths (*) [rad].
    """
    ring = torch.tensor(_FACE_RING)[face] * nside - x - y - 1
    north, south = ring < nside, ring > 3 * nside
    # a quarter of the cells in this ring
    cap = torch.where(north, ring, torch.where(south, 4 * nside - ring, nside))
    polar = cap.double().square() / (3 * nside**2)
    z = torch.where(
        north, 1 - polar, torch.where(south, polar - 1, (2 * nside - ring) * 2 / (3 * nside))
    )
    azimuth = (torch.tensor(_FACE_MERIDIAN)[face] * cap + x - y) * math.pi / (4 * cap.double())
    return z, azimuth


def so3_grid(level: int) -> Tensor:
    """Return 72 x 8^level uniformly spread rotations.  -> (72 * 8**level, 3, 3) float32.

    The mean distance of a random rotation to the nearest one is 28, 14, 7 and 3.5 degrees at levels
    0 to 3, the largest at most twice that. Cells 8 i to 8 i + 7 of a level subdivide cell i of the
    level before. Cells at the south pole are narrow; their parts lie up to 50 degrees apart.
    """
    cells = torch.cartesian_prod(
        torch.arange(12), torch.arange(1), torch.arange(1), torch.arange(6)
    )  # face, x, y, turn
    halves = torch.tensor([[0, a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    for _ in range(level):
        cells = (cells * torch.tensor([1, 2, 2, 2])).repeat_interleave(8, 0) + halves.repeat(
            len(cells), 1
        )
    face, x, y, turn = cells.unbind(-1)
    z, azimuth = healpix_directions(face, x, y, 2**level)
    half_polar = torch.acos(z) / 2
    half_turn = (turn + 0.5) * math.pi / (6 * 2**level)
    quat_xyzw = [
        half_polar.cos() * half_turn.sin(),
        half_polar.sin() * (azimuth + half_turn).cos(),
        half_polar.sin() * (azimuth + half_turn).sin(),
        half_polar.cos() * half_turn.cos(),
    ]
    return matrix_from_quat_xyzw(torch.stack(quat_xyzw, dim=-1)).float()
