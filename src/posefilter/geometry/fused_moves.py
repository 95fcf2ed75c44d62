"""Moves of poses without gradient, several times faster than `move_about` itself.

`move_about` is the reference; here the same numbers are computed up to rounding. Poses are turned
into rows, one an entry of the matrix, so that each operation runs over whole rows, in parts that
fit into a processor's cache. Products of 3 x 3 matrices are three operations on all nine entries.
"""

import torch
from torch import Tensor

PART = 8192  # poses that are moved at once
_LEAST = 1e-18  # [rad]; an angle is divided by


def applies(*tensors: Tensor) -> bool:
    """Return whether poses can be moved here: no gradient is asked for, on a CPU, not traced."""
    asked = torch.is_grad_enabled() and any(x.requires_grad for x in tensors)
    plain = all(x.device.type == "cpu" and x.dtype in _TYPES for x in tensors)
    return plain and not asked and not torch.compiler.is_compiling()


def move(pose: Tensor, tangent: Tensor, center: tuple[float, ...]) -> Tensor:
    """Return moved poses, as `move_about` does.

    Args:
        pose: (*, 4, 4) camera_from_object [m].
        tangent: (*, 6), translation [m] in the camera's axes, then rotation vector [rad] in the
            object's axes; leading shapes broadcast.
        center: The object's center [m].

    Returns:
        Moved poses (*, 4, 4).
    """
    lead = pose.shape[:-2]
    if tangent.shape[:-1] != lead:
        # not torch.broadcast_shapes, which imports sympy
        lead = torch.broadcast_tensors(pose[..., 0, 0], tangent[..., 0])[0].shape
        pose, tangent = pose.expand(*lead, 4, 4), tangent.expand(*lead, 6)
    dtype = torch.promote_types(pose.dtype, tangent.dtype)
    rows, steps = pose.reshape(-1, 16).to(dtype), tangent.reshape(-1, 6).to(dtype)
    out = torch.empty_like(rows, memory_format=torch.contiguous_format)
    for start in range(0, len(rows), PART):
        part = slice(start, start + PART)
        _move(rows[part], steps[part], center, out[part])
    return out.view(*lead, 4, 4)


def _move(rows: Tensor, steps: Tensor, center: tuple[float, ...], out: Tensor) -> None:
    """Write moved poses.  (n, 16), (n, 6), -> (n, 16)."""
    n = len(rows)
    entries = rows.t().contiguous().view(4, 4, n)
    step = steps.t().contiguous()
    w = step[3:]
    turn = _exponential(w, rows.new_empty(3, 3, n))
    moved = rows.new_empty(4, 4, n)
    R, after, at = entries[:3, :3], moved[:3, :3], moved[:3, 3]
    torch.mul(R[:, 0, None], turn[0], out=after)
    after.addcmul_(R[:, 1, None], turn[1]).addcmul_(R[:, 2, None], turn[2])
    torch.add(entries[:3, 3], step[:3], out=at)
    for axis, c in enumerate(center):
        if c:
            at.add_(R[:, axis] - after[:, axis], alpha=c)
    moved[3, :3] = 0
    moved[3, 3] = 1
    out.copy_(moved.view(16, n).t())


def _exponential(w: Tensor, out: Tensor) -> Tensor:
    """Return the rotations of vectors, by Rodrigues' formula in terms of the half angle.

    (3, n) [rad], a buffer (3, 3, n) -> (3, 3, n).
    """
    x, y, z = w
    angle = (x * x).addcmul_(y, y).addcmul_(z, z).sqrt_().clamp_min_(_LEAST)
    half = angle * 0.5
    sine, cosine = half.sin(), half.cos_()
    scaled = w * (sine / angle)  # w sin(angle / 2) / angle
    turned = scaled * (2 * cosine)  # w sin(angle) / angle
    torch.mul((2 * scaled)[:, None], scaled, out=out)
    out.view(9, -1)[::4].add_((sine * sine).mul_(-2).add_(1))
    a, b, c = turned
    out[0, 1].sub_(c)
    out[1, 0].add_(c)
    out[0, 2].add_(b)
    out[2, 0].sub_(b)
    out[1, 2].sub_(a)
    out[2, 1].add_(a)
    return out


_TYPES = (torch.float32, torch.float64)
