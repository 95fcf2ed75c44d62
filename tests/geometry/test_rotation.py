"""Rotations against roma and scipy, and their gradients."""

import math

import numpy as np
import pytest
import roma
import torch
from scipy.spatial.transform import Rotation
from torch import Generator

from posefilter.geometry.pose import fit_rigid, invert, make_pose, move_about
from posefilter.geometry.rotation import (
    angle_between,
    exp_so3,
    hat,
    log_so3,
    matrix_from_6d,
    matrix_from_quat_xyzw,
    project_to_so3,
    quat_xyzw_from_matrix,
    random_rotation,
    spread_rotations,
)

V = torch.cat(
    [
        torch.randn(60, 3, dtype=torch.float64, generator=Generator().manual_seed(0)),
        torch.zeros(1, 3).double(),
    ]
)
HALF_TURNS = math.pi * torch.nn.functional.normalize(
    torch.cat([torch.eye(3).double(), V[:5]]), dim=-1
)


def test_conversions_are_scipys_and_romas() -> None:
    oracle = Rotation.from_rotvec(V.numpy())
    R = exp_so3(V)
    np.testing.assert_allclose(R, oracle.as_matrix(), atol=1e-12)
    torch.testing.assert_close(R, roma.rotvec_to_rotmat(V))
    quat = torch.from_numpy(oracle.as_quat())
    torch.testing.assert_close(matrix_from_quat_xyzw(3 * quat), R)
    torch.testing.assert_close(matrix_from_quat_xyzw(quat), roma.unitquat_to_rotmat(quat))
    found = quat_xyzw_from_matrix(R)
    torch.testing.assert_close(found * found[:, 3:].sign(), quat * quat[:, 3:].sign())
    torch.testing.assert_close(log_so3(R), roma.rotmat_to_rotvec(R))
    torch.testing.assert_close(
        angle_between(R[:30], R[30:60]), roma.rotmat_geodesic_distance(R[:30], R[30:60])
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_half_a_turn_has_a_finite_gradient(dtype: torch.dtype) -> None:
    turned = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=dtype)).requires_grad_()
    angle = angle_between(turned, torch.eye(3, dtype=dtype))
    angle.backward()
    assert float(angle.detach()) == pytest.approx(math.pi, abs=1e-7)
    assert turned.grad is not None
    assert bool(turned.grad.isfinite().all())
    near = exp_so3(torch.tensor([math.pi - 0.01, 0, 0], dtype=dtype))
    assert float(angle_between(near, torch.eye(3, dtype=dtype))) == pytest.approx(
        math.pi - 0.01, abs=1e-4
    )


def test_a_wrong_quaternion_order_would_be_seen() -> None:
    quat = torch.from_numpy(Rotation.from_rotvec(V.numpy()).as_quat())
    assert (matrix_from_quat_xyzw(quat.roll(1, -1)) - exp_so3(V)).abs().max() > 0.5


def test_half_turns_come_back_as_half_turns() -> None:
    v = log_so3(exp_so3(HALF_TURNS))
    torch.testing.assert_close(v.norm(dim=-1), torch.full((8,), math.pi).double())
    torch.testing.assert_close(exp_so3(v), exp_so3(HALF_TURNS), atol=1e-9, rtol=0)


def test_hat_is_the_cross_product() -> None:
    torch.testing.assert_close(
        (hat(V[:30]) @ V[30:60, :, None])[..., 0], torch.linalg.cross(V[:30], V[30:60])
    )


def test_nearest_rotation_is_romas_and_never_a_reflection() -> None:
    M = torch.randn(200, 3, 3, dtype=torch.float64, generator=Generator().manual_seed(1))
    R = project_to_so3(M)
    torch.testing.assert_close(R, roma.special_procrustes(M))
    torch.testing.assert_close(torch.det(R), torch.ones(200).double())
    assert (torch.det(M) < 0).any()


def test_six_numbers_span_a_rotation() -> None:
    six = torch.randn(50, 6, dtype=torch.float64, generator=Generator().manual_seed(2))
    columns = torch.stack([six[:, :3], six[:, 3:]], dim=-1)
    torch.testing.assert_close(matrix_from_6d(six), roma.special_gramschmidt(columns))


def test_random_rotations_are_haar() -> None:
    R = random_rotation(40000, generator=Generator().manual_seed(0))
    assert R.mean(0).abs().max() < 0.02
    angle = angle_between(R, torch.eye(3))  # density (1 - cos a) / pi
    share = torch.tensor([(angle < a).float().mean() for a in (0.5, 1.0, 2.0, 3.0)])
    exact = torch.tensor([(a - math.sin(a)) / math.pi for a in (0.5, 1.0, 2.0, 3.0)])
    torch.testing.assert_close(share, exact, atol=0.01, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 2.5])
def test_gradients(angle: float) -> None:
    v = (angle * torch.nn.functional.normalize(V[:3], dim=-1)).requires_grad_()
    assert torch.autograd.gradcheck(exp_so3, v)
    assert torch.autograd.gradcheck(lambda x: log_so3(exp_so3(x)), v)
    T = make_pose(exp_so3(V[:3]), V[3:6])
    tangent = torch.cat([V[6:9], v.detach()], -1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: move_about(T, x, V[9]), tangent)
    assert torch.autograd.gradcheck(lambda x: invert(move_about(T, x, V[9])), tangent)


def test_gradients_of_fits_and_projections() -> None:
    M = torch.randn(
        4, 3, 3, dtype=torch.float64, generator=Generator().manual_seed(3), requires_grad=True
    )
    assert torch.autograd.gradcheck(project_to_so3, M)
    # three singular values alike, where the SVD itself has no derivative
    exact = exp_so3(V[:5]).requires_grad_()
    assert torch.autograd.gradcheck(project_to_so3, exact)
    assert torch.autograd.gradcheck(matrix_from_6d, V[:12].reshape(6, 6).clone().requires_grad_())
    assert torch.autograd.gradcheck(
        matrix_from_quat_xyzw, V[:12].reshape(9, 4).clone().requires_grad_()
    )
    source, target = V[:10], V[10:20].clone().requires_grad_()
    weights = V[20:30, 0].abs().clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda t, w: fit_rigid(source, t, w), (target, weights))


def test_spread_rotations_leave_no_gap_and_no_two_are_close() -> None:
    count = 1000
    R = spread_rotations(count)
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(count, 3, 3), atol=1e-5, rtol=0)
    cell = (6 * math.pi / count) ** (1 / 3)  # angle of a ball of a cell's volume
    apart = angle_between(R[:, None], R) + 9 * torch.eye(count)
    assert apart.min() > cell
    gaps = angle_between(random_rotation(2000, generator=Generator().manual_seed(0))[:, None], R)
    assert gaps.amin(1).max() < 1.5 * cell
