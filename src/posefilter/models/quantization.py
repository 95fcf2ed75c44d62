"""Compact weight files: 8-bit kernels with one scale for each channel, the rest in half precision,
of the object its surface points, and 8 bits of its normals and colors.

The error is about 1 % of a typical weight, far below the variation between trainings; of a point on
an object of 20 cm, 0.03 mm; of a normal, a quarter of a degree. A file is a quarter of its size in
full precision.
"""

from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from posefilter.errors import UserError
from posefilter.types import ObjectModel

_LEAST = 4096  # smaller tensors are not worth a scale
_SUFFIX = "#scale"
OFFSET = "points_from"  # the point that packed points are relative to, where there is one
_FAR = 0.25  # [m] of the object's center from its origin, where half precision is 0.1 mm


def pack(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Quantize a state dict: large kernels (3 or more dimensions) in 8 bits, other floats in half.

    Args:
        state: Tensors by name.

    Returns:
        The packed tensors, and the scale of each kernel under its name with the suffix `#scale`.
    """
    out: dict[str, Tensor] = {}
    for name, value in state.items():
        if value.is_floating_point() and value.dim() >= 3 and value.numel() >= _LEAST:
            largest = value.abs().amax(dim=tuple(range(1, value.dim())), keepdim=True)
            scale = largest.clamp_min(1e-12) / 127
            out[name] = (value / scale).round().to(torch.int8)
            out[name + _SUFFIX] = scale.float()
        else:
            out[name] = value.half() if value.is_floating_point() else value.clone()
    return out


def unpack(packed: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return a state dict in full precision; one that was not packed is returned unchanged.

    Raises:
        UserError: A scale is not one number a channel: it would spread its kernel out.
    """
    out: dict[str, Tensor] = {}
    for name, value in packed.items():
        if name.endswith(_SUFFIX):
            continue
        scale = packed.get(name + _SUFFIX)
        if scale is not None and scale.shape != (*value.shape[:1], *[1] * (value.dim() - 1)):
            raise UserError(
                f"checkpoint: the scale of its weights {name[:60]!r} is not one number a channel"
            )
        whole = value.float() if value.is_floating_point() or scale is not None else value
        out[name] = whole if scale is None else whole * scale
    return out


def pack_object(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return an object, as a checkpoint holds it, with surface points in half precision, and the
    normals and colors of its texture in 8 bits; one that was packed before is as it was.

    Where the origin of the mesh is far from the object, points are relative to its center.
    """
    if OFFSET in plain:
        return dict(plain)
    texture, points = plain.get("texture"), plain["points"]
    out = dict(plain)
    if float(plain["center"].norm()) > _FAR:
        out[OFFSET] = plain["center"]
        points = points - plain["center"].to(points)
        if texture is not None:
            texture = texture.float()
            texture = torch.cat([texture[:, :3] - plain["center"].to(texture), texture[:, 3:]], 1)
            out["texture"] = texture
    out["points"] = points.half()
    if texture is None or plain.get("texture_look") is not None:
        return out
    look = torch.cat([(texture[:, 3:6] + 1) / 2, texture[:, 6:]], dim=1).float()
    packed = (255 * look).round().clamp(0, 255).to(torch.uint8)
    return {**out, "texture": texture[:, :3].half().contiguous(), "texture_look": packed}


def unpack_object(packed: Mapping[str, Any]) -> ObjectModel:
    """Return the object that a checkpoint holds, its surface points in full precision."""
    fields = {**packed, "points": packed["points"].float()}
    look, offset = fields.pop("texture_look", None), fields.pop(OFFSET, None)
    if look is not None:
        normals, colors = (look.float() / 255).chunk(2, dim=1)
        normals = F.normalize(2 * normals - 1, dim=1)
        # as precise as it was before it was packed, so that old files and new ones are alike
        fields["texture"] = torch.cat([fields["texture"].float(), normals, colors], 1).half()
    if offset is not None:
        fields["points"] = fields["points"] + offset.to(fields["points"])
        if fields.get("texture") is not None:  # a file of an earlier version has no such field
            texture = fields["texture"].float()  # in half precision it would be rounded again
            fields["texture"] = torch.cat([texture[:, :3] + offset.to(texture), texture[:, 3:]], 1)
    return ObjectModel(**fields)
