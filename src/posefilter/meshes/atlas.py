"""Merge the materials of a mesh into one texture."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from posefilter.errors import UserError
from posefilter.limits import MOST_SIDE
from posefilter.meshes.obj import MOST_TEXELS, Material, RawMesh

_MARGIN = 8  # [px] round each picture, so that smaller levels of the texture do not mix them
_SLACK = 1e-3  # texture coordinates beyond a picture's edge by less are rounding


class Surface(NamedTuple):
    """What a mesh shows: its texture times its corners' colors."""

    corner_uv: np.ndarray | None  # (F, 3, 2) float32
    texture: np.ndarray  # (h, w, 3) uint8 RGB
    corner_colors: np.ndarray | None  # (F, 3, 3) float32


def merge_materials(raw: RawMesh, path: Path) -> Surface:
    """Put the pictures of all materials into one; those of one color become colors of corners.

    A picture that a face repeats is repeated there, too.

    Args:
        raw: The mesh as its file has it.
        path: The file, for messages.

    Raises:
        UserError: The texture would be too large.
    """
    colors = None if raw.corner_colors is None else raw.corner_colors.astype(np.float32)
    used = np.unique(raw.face_material).tolist()
    pictures = [_picture(raw.materials[i]) for i in used]
    if len(used) == 1:
        if raw.corner_uv is None or pictures[0].shape[:2] == (1, 1):
            return Surface(None, pictures[0][:1, :1], colors)
        return Surface(raw.corner_uv.astype(np.float32), pictures[0], colors)
    plain = [raw.corner_uv is None or bool((p == p[:1, :1]).all()) for p in pictures]
    which = np.searchsorted(used, raw.face_material)
    tints = np.array(
        [p[0, 0] / 255 if one else np.ones(3) for p, one in zip(pictures, plain, strict=True)]
    )
    tint = tints[which][:, None].astype(np.float32)
    colors = np.repeat(tint, 3, axis=1) if colors is None else colors * tint
    white = np.full((1, 1, 3), 255, np.uint8)
    if all(plain):
        return Surface(None, white, colors)
    assert raw.corner_uv is not None
    pictures = [white if one else p for p, one in zip(pictures, plain, strict=True)]
    white_faces = np.array(plain)[which]
    uv = np.where(white_faces[:, None, None], 0.5, raw.corner_uv)
    uv, texture = _stack(uv, which, pictures, path)
    return Surface(uv, texture, None if (colors == 1).all() else colors)


def _picture(material: Material) -> np.ndarray:
    if material.image is None:
        return np.round(material.color * 255).astype(np.uint8).reshape(1, 1, 3)
    if np.allclose(material.color, 1):
        return material.image
    return np.round(material.image * material.color).astype(np.uint8)


def _stack(
    uv: np.ndarray, which: np.ndarray, pictures: list[np.ndarray], path: Path
) -> tuple[np.ndarray, np.ndarray]:
    """Stack pictures above each other, and move texture coordinates to where theirs is.

    Args:
        uv: (F, 3, 2).
        which: (F,) the picture of each face.
        pictures: Of the materials.
        path: The file, for messages.

    Returns:
        (F, 3, 2) float32, and the texture.
    """
    # a stacked picture cannot repeat by itself: each face is folded back to the first copies
    uv = uv - np.floor(uv.min(axis=1, keepdims=True) + _SLACK)
    reach = np.ceil(uv.max(axis=1) - _SLACK).clip(1)  # (F, 2) copies that a face reaches over
    copies = np.stack([reach[which == i].max(axis=0) for i in range(len(pictures))])
    sizes = np.array([p.shape[1::-1] for p in pictures]) * copies  # (M, 2) width and height
    # materials that share a picture share its place
    names = [(id(p), *c) for p, c in zip(pictures, copies.tolist(), strict=True)]
    first = {name: i for i, name in reversed(list(enumerate(names)))}
    kept = sorted(first.values())
    width = int(sizes[kept, 0].max()) + 2 * _MARGIN  # of a column
    heights = sizes[kept, 1].astype(int) + 2 * _MARGIN
    columns = _fill_columns(heights.tolist(), width)
    height, across = max(int(heights[own].sum()) for own in columns), width * len(columns)
    if across * height > MOST_TEXELS or max(across, height) > MOST_SIDE:
        often = f", repeated {int(copies.prod(axis=1).max())} times" if copies.max() > 1 else ""
        raise UserError(
            f"{path}: too large: its {len(kept)} textures together have {across}x{height} "
            f"pixels{often}; scale them down"
        )
    texture = np.zeros((height, across, 3), np.uint8)
    corner = np.zeros((len(pictures), 2))  # left and upper, of what is in the margins
    for column, own in enumerate(columns):
        top = 0
        for i, high in zip(np.array(kept)[own], heights[own], strict=True):
            times, down = copies[i].astype(int)
            tiled = np.tile(pictures[i], (down, times, 1))
            border = (_MARGIN, _MARGIN, _MARGIN, width - tiled.shape[1] - _MARGIN)
            block = cv2.copyMakeBorder(tiled, *border, cv2.BORDER_REPLICATE)
            texture[top : top + high, column * width : (column + 1) * width] = block
            corner[i] = column * width + _MARGIN, top + _MARGIN
            top += high
    corner = corner[[first[name] for name in names]]
    pixels = np.array([p.shape[1::-1] for p in pictures])[which][:, None]  # (F, 1, 2)
    at = (uv * pixels).clip(0, sizes[which][:, None])
    left, top = (corner[which][:, i, None] for i in (0, 1))
    x = (at[..., 0] + left) / across
    # v = 0 is the lower edge of the picture, whose rows are counted from above
    y = 1 - (top + sizes[which][:, None, 1] - at[..., 1]) / height
    return np.stack([x, y], axis=-1).astype(np.float32), texture


def _fill_columns(heights: list[int], width: int) -> list[list[int]]:
    """Divide pictures into columns such that the whole is nearly a square: renderers take the
    texture's resolution to be the same along both axes.

    Args:
        heights: Of the pictures [px].
        width: Of a column [px].

    Returns:
        Which are in each.
    """
    most = max(*heights, round((sum(heights) * width) ** 0.5), 0)
    columns: list[list[int]] = [[]]
    filled = 0
    for i, height in enumerate(heights):
        if filled + height > most:
            columns.append([])
            filled = 0
        columns[-1].append(i)
        filled += height
    return columns
