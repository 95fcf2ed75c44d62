"""Rotations as matrices (*, 3, 3), and conversions from and to other parametrizations.

Conventions: active rotations, column vectors (x' = R x), radians, unit quaternions (x, y, z, w).
"""

import math
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

_SMALL = 1e-4  # below this angle [rad] the Taylor forms are exact to float32


def hat(v: Tensor) -> Tensor:
    """Return the skew matrix of v, so that hat(v) @ x = v x x.  (*, 3) -> (*, 3, 3)."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def exp_so3(rotvec: Tensor) -> Tensor:
    """Map a rotation vector to its matrix (Rodrigues), differentiable at zero.

    (*, 3) [rad] -> (*, 3, 3).
    """
    square = (rotvec * rotvec).sum(-1)[..., None, None]
    small = square < _SMALL**2
    safe = torch.where(small, torch.ones_like(square), square)
    angle = safe.sqrt()
    a = torch.where(small, 1 - square / 6, angle.sin() / angle)
    b = torch.where(small, 0.5 - square / 24, (1 - angle.cos()) / safe)
    K = hat(rotvec)
    return torch.eye(3, dtype=rotvec.dtype, device=rotvec.device) + a * K + b * (K @ K)


def log_so3(R: Tensor) -> Tensor:
    """Map a rotation matrix to its rotation vector with angle in [0, pi].

    (*, 3, 3) -> (*, 3) [rad].
    """
    quat = quat_xyzw_from_matrix(R)
    quat = torch.where(quat[..., 3:] < 0, -quat, quat)
    vector, w = quat[..., :3], quat[..., 3:]
    square = (vector * vector).sum(-1, keepdim=True)
    small = square < _SMALL**2
    sine = torch.where(small, torch.ones_like(square), square).sqrt()
    return vector * torch.where(small, 2 / w.clamp_min(0.5), 2 * torch.atan2(sine, w) / sine)


def matrix_from_quat_xyzw(quat_xyzw: Tensor) -> Tensor:
    """Convert quaternions (normalized here) to matrices.  (*, 4) -> (*, 3, 3)."""
    x, y, z, w = F.normalize(quat_xyzw, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def quat_xyzw_from_matrix(R: Tensor) -> Tensor:
    """Convert matrices to unit quaternions by the best conditioned of the four formulas.

    (*, 3, 3) -> (*, 4).
    """
    m = R.flatten(-2).unbind(-1)
    trace = m[0] + m[4] + m[8]
    choices = torch.stack(
        [
            torch.stack([1 + m[0] - m[4] - m[8], m[3] + m[1], m[6] + m[2], m[7] - m[5]], -1),
            torch.stack([m[3] + m[1], 1 - m[0] + m[4] - m[8], m[7] + m[5], m[2] - m[6]], -1),
            torch.stack([m[6] + m[2], m[7] + m[5], 1 - m[0] - m[4] + m[8], m[3] - m[1]], -1),
            torch.stack([m[7] - m[5], m[2] - m[6], m[3] - m[1], 1 + trace], -1),
        ],
        dim=-2,
    )
    best = torch.stack([m[0], m[4], m[8], trace], -1).argmax(-1)
    index = best[..., None, None].expand(*best.shape, 1, 4)
    return F.normalize(choices.gather(-2, index).squeeze(-2), dim=-1)


def matrix_from_6d(six: Tensor) -> Tensor:
    """Orthonormalize two columns by Gram-Schmidt (Zhou et al. 2019, eq. 15).

    (*, 6) -> (*, 3, 3).
    """
    a, b = six[..., :3], six[..., 3:]
    x = F.normalize(a, dim=-1)
    y = F.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], dim=-1)


def random_rotation(
    *shape: int, generator: torch.Generator | None = None, device: torch.device | None = None
) -> Tensor:
    """Draw rotations uniformly (Haar) from SO(3).  -> (*shape, 3, 3)."""
    return matrix_from_quat_xyzw(torch.randn(*shape, 4, generator=generator, device=device))


def spread_rotations(count: int) -> Tensor:
    """Return rotations that cover SO(3) evenly: super-Fibonacci spirals (Alexa 2022).

    -> (count, 3, 3).
    """
    psi = 1.533751168755204288118041  # the real root of x^4 = x + 4 above 1
    index = torch.arange(count, dtype=torch.float64) + 0.5
    share, turn = index / count, 2 * math.pi * index
    a, b = turn / math.sqrt(2), turn / psi
    r, s = share.sqrt(), (1 - share).sqrt()
    quat = torch.stack([r * a.sin(), r * a.cos(), s * b.sin(), s * b.cos()], dim=-1)
    return matrix_from_quat_xyzw(quat).float()


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return evenly spread unit directions.  -> (count, 3)."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], 1)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Return the geodesic angle between rotations.  (*, 3, 3) x 2 -> (*), 0 to pi [rad].

    Computed from the chord |a - b|_F = 2 sqrt(2) sin(angle / 2), which is accurate at small angles
    where the arc cosine of the trace is not.
    """
    return angle_of_chord(torch.linalg.matrix_norm(a - b))


def angle_of_chord(chord: Tensor) -> Tensor:
    """Return the angle [rad] between rotations by the Frobenius norm of their difference, (*).

    What rounds to half a turn, a thousandth of a radian from it in float32, is half a turn, with a
    gradient of zero in place of an infinite one.
    """
    sine = chord / (2 * math.sqrt(2))
    limit = 1 - torch.finfo(sine.dtype).eps
    angle = 2 * torch.asin(sine.clamp(max=limit))
    return torch.where(sine < limit, angle, angle.new_tensor(math.pi))


class _Procrustes(torch.autograd.Function):
    """The nearest rotation, with its own derivative.

    Autograd's derivative of the SVD is NaN at equal singular values.
    """

    @staticmethod
    def forward(ctx: Any, M: Tensor) -> Tensor:
        """M = U diag(s) Vh -> U diag(1, 1, +-1) Vh."""
        U, s, Vh = torch.linalg.svd(M)
        flip = torch.ones_like(s)
        flip[..., 2] = torch.det(U @ Vh).sign()
        U, s = U * flip[..., None, :], s * flip
        ctx.save_for_backward(U, s, Vh)
        return U @ Vh

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        """With W = U^T dR V skew: W_ij = (U^T dM V - its transpose)_ij / (s_i + s_j)."""
        U, s, Vh = ctx.saved_tensors
        A = U.mT @ grad @ Vh.mT
        total = s[..., :, None] + s[..., None, :]
        return U @ ((A - A.mT) / total.clamp_min(torch.finfo(s.dtype).eps)) @ Vh


def project_to_so3(M: Tensor) -> Tensor:
    """Return the rotation nearest to M in the Frobenius norm (orthogonal Procrustes).

    (*, 3, 3) -> (*, 3, 3).
    """
    return _Procrustes.apply(M)
