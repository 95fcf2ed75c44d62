"""The YCB objects of YCB-Video and FAT: names, order, ids, frames, symmetries.

Numbers were measured on the public files (YCB's google_16k meshes, YCB-Video's model points).
"""

import re
from collections.abc import Sequence
from itertools import count

import numpy as np

from posefilter.geometry.rigid import rigid
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.symmetries import rotation_about, symmetry_group

# In YCB-Video's order (label images and cls_indexes count from 1, FAT's segmentation ids in steps
# of 12), each class with two translations [m].
# The first is ycbvideo_from_original: rotations fitted freely are below 0.22 degrees and
# nearest-neighbor residuals below 0.5 mm, for all classes but 036_wood_block (12 degrees, 3 mm),
# whose public google_16k mesh is another scan than YCB-Video's and FAT's.
# The second is the center of the bounding box of YCB-Video's models: the origin of BOP's YCB-V
# models, which are not turned.
_FRAMES = {
    "002_master_chef_can": ((0.01567, 0.010218, -0.073504), (-0.00134, 0.0005, -0.00351)),
    "003_cracker_box": ((0.012323, 0.012463, -0.108328), (-0.00056, -0.0017, -0.0048)),
    "004_sugar_box": ((0.008344, 0.01523, -0.092397), (0.00095, -0.00147, -0.00436)),
    "005_tomato_soup_can": ((0.008911, -0.082406, -0.059366), (2e-05, 0.00153, -0.0084)),
    "006_mustard_bottle": ((0.014056, 0.021051, -0.080656), (-0.0013, -0.00249, 0.01183)),
    "007_tuna_fish_can": ((0.026091, 0.021939, -0.017692), (0.00016, -0.00012, -0.00426)),
    "008_pudding_box": ((-0.001824, -0.015297, -0.022003), (-0.00116, 0.0042, -0.00312)),
    "009_gelatin_box": ((0.021334, 0.008739, -0.018102), (-0.00145, 0.00059, -0.00361)),
    "010_potted_meat_can": ((0.030441, 0.025891, -0.046519), (-0.00242, -0.00031, -0.00807)),
    "011_banana": ((0.007241, -0.004849, -0.01655), (0.01867, -0.01219, 0.00146)),
    "019_pitcher_base": ((0.000464, -0.046305, -0.144018), (-0.00534, -0.00589, -0.02561)),
    "021_bleach_cleanser": ((0.016661, -0.009272, -0.11157), (-0.00493, 0.00248, 0.01329)),
    "024_bowl": ((0.015, 0.042514, -0.023979), (0.00023, -0.00079, 0.00297)),
    "025_mug": ((0.017112, -0.016645, -0.038484), (0.00847, 0.0007, 0.00161)),
    "035_power_drill": ((0.036932, -0.031553, -0.023304), (-0.00907, -0.02094, 0.00212)),
    "036_wood_block": None,
    "037_scissors": ((-0.017069, -0.007727, -0.007391), (-0.00705, 0.02813, -4e-05)),
    "040_large_marker": ((0.035649, 0.007239, -0.00951), (-5e-05, 0.0021, -0.00035)),
    "051_large_clamp": ((0.004176, 0.010065, -0.018803), (-0.01052, 0.00196, 0.00047)),
    "052_extra_large_clamp": ((0.020011, 0.035515, -0.017913), (0.00039, 0.01041, -0.00016)),
    "061_foam_brick": ((0.018448, -0.017271, -0.016884), (8e-05, -8e-05, 0.00824)),
}
CLASSES = tuple(_FRAMES)
# [m], between the center of a mesh's bounding box and the class's: google_16k's are within 0.5 mm,
# and no two frames of a class are closer than 18 mm.
_NEAR = 0.009
WITHOUT_GEOMETRY = frozenset(name for name, frames in _FRAMES.items() if frames is None)

# Declared symmetries, for training and labels only: ADD and ADD-S as published ignore them.
# YCB-Video (Xiang et al. 2018) and BOP list bowl, wood block, both clamps and foam brick. Which
# rotations hold was measured by registering each google_16k mesh with itself: mean nearest-neighbor
# distance, and in brackets that of two samplings of the mesh. Bowl 0.82 mm (0.79), wood block 1.06
# (0.94), large clamp 0.95 (0.64), extra large clamp 1.01 (0.75), foam brick 0.70 (0.47). The brick
# has holes on one face only, so its other two half turns (1.1 and 1.2 mm mean, 12 mm at the holes)
# are left out; so is the block's quarter turn, whose grain differs.
# name -> half turns about (axis, point [m]), turns by any angle about (axis, point [m]); in the
# original frame.
_HALF_TURNS = {
    "036_wood_block": ((-0.0059, -0.0037, 1.0), (0.0237, -0.0106, 0.1029)),
    "051_large_clamp": ((0.1474, -0.9875, -0.0565), (-0.0052, -0.0068, 0.0184)),
    "052_extra_large_clamp": ((-0.9930, -0.1183, 0.0022), (-0.0185, -0.0348, 0.0178)),
    "061_foam_brick": ((-0.0047, 0.0029, -1.0), (-0.0184, 0.0169, 0.0253)),
}
_ANY_TURN = {"024_bowl": ((0.0010, 0.0070, 1.0), (-0.0148, -0.0436, 0.0270))}


# Parts of YCB's tools, each a slice of the google_16k mesh along an axis of its frame: (axis, from
# [m], to [m]). Where one ends and the next begins was read from the mesh's profile along the axis.
_PARTS = {
    "035_power_drill": {
        "battery": (1, -1.0, -0.048),
        "grip": (1, -0.048, 0.046),
        "body": (1, 0.046, 1.0),
    },
    "037_scissors": {"handles": (1, -1.0, 0.055), "blades": (1, 0.055, 1.0)},
    "042_adjustable_wrench": {"head": (1, -1.0, -0.035), "handle": (1, -0.035, 1.0)},
    "043_phillips_screwdriver": {"shaft": (0, -1.0, -0.055), "handle": (0, -0.055, 1.0)},
    "044_flat_screwdriver": {"shaft": (0, -1.0, -0.033), "handle": (0, -0.033, 1.0)},
    "048_hammer": {"handle": (1, -1.0, 0.04), "head": (1, 0.04, 1.0)},
    "051_large_clamp": {"jaws": (1, -1.0, -0.013), "handles": (1, -0.013, 1.0)},
    "052_extra_large_clamp": {"jaws": (0, -1.0, -0.027), "handles": (0, -0.027, 1.0)},
}
TOOLS = tuple(_PARTS)


def parts(name: str, mesh: Mesh) -> dict[str, np.ndarray]:
    """Return the parts of a tool.

    Args:
        name: The class.
        mesh: Its google_16k mesh [m].

    Returns:
        (F,) bool by part, disjoint; empty for what is no tool.
    """
    out = {}
    for part, (axis, low, high) in _PARTS.get(name, {}).items():
        along = mesh.vertices[mesh.faces][..., axis].mean(axis=1)
        out[part] = (along >= low) & (along < high)
    return {part: faces for part, faces in out.items() if faces.any()}


def number_objects(names: Sequence[str]) -> dict[str, int]:
    """Return the number of each object in results: of one of YCB-Video's its number there, of
    `obj_000012` 12, of any other, and of one whose number another has, the first that is free.
    """
    numbers: dict[str, int] = {}
    for name in names:
        numbered = re.fullmatch(r"obj_(\d{1,9})", name)
        own = ycbvideo_index(name) if name in CLASSES else int(numbered[1]) if numbered else 0
        if own and own not in numbers.values():
            numbers[name] = own
    for name in names:
        free = (n for n in count(1) if n not in numbers.values())
        numbers.setdefault(name, next(free))
    return numbers


def ycbvideo_index(name: str) -> int:
    """Return a class's index in YCB-Video's files, from 1."""
    return CLASSES.index(name) + 1


def ycbvideo_from_original(name: str) -> np.ndarray:
    """Return the transform (4, 4) [m] from the frame of the google_16k mesh to YCB-Video's.

    Raises:
        KeyError: No rigid transform fits that class.
    """
    return rigid(np.eye(3), _find_frames(name)[0])


def bop_from_original(name: str) -> np.ndarray:
    """Return the transform (4, 4) [m] from the frame of the google_16k mesh to BOP's of YCB-V.

    Raises:
        KeyError: No rigid transform fits that class.
    """
    to_ycbvideo, center = _find_frames(name)
    return rigid(np.eye(3), np.subtract(to_ycbvideo, center))


def _find_frames(name: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    frames = _FRAMES[name]
    if frames is None:
        raise KeyError(name)
    return frames


def mesh_from_original(name: str, mesh: Mesh) -> np.ndarray | None:
    """Return the transform (4, 4) [m] from the frame of the google_16k mesh to that of a mesh of
    the same class: the identity, or that of YCB-Video's or BOP's models, by where the bounding box
    lies; None if it is neither, or the relation of the frames is not known.
    """
    center = mesh.bounds.mean(axis=0)
    frames = _FRAMES.get(name)
    if frames is None:  # symmetries leave the center of their own mesh where it is
        turns = symmetries(name)
        moved = 0.0 if turns is None else turns[:, :3, :3] @ center + turns[:, :3, 3] - center
        return np.eye(4) if np.abs(moved).max() < _NEAR else None
    shift, middle = map(np.array, frames)
    places = (np.zeros(3), shift, shift - middle)
    off = [float(np.linalg.norm(center - (middle - shift + place))) for place in places]
    best = int(np.argmin(off))
    return rigid(np.eye(3), places[best]) if off[best] < _NEAR else None


def symmetries(name: str, steps: int = 36) -> np.ndarray | None:
    """Return a class's declared symmetries.

    Args:
        name: The class.
        steps: Steps in which a turn of any angle is sampled.

    Returns:
        (S, 4, 4) in the frame of the google_16k mesh, the identity first; None without symmetries.
    """
    if name in _HALF_TURNS:
        axis, point = (np.array(v) for v in _HALF_TURNS[name])
        return symmetry_group(discrete=[rotation_about(axis / np.linalg.norm(axis), np.pi, point)])
    if name in _ANY_TURN:
        axis, point = (np.array(v) for v in _ANY_TURN[name])
        return symmetry_group(continuous=[(axis, point)], steps=steps)
    return None
