"""The axioms of SO(3) and SE(3), for every batch shape and precision."""

import math

import pytest
import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import (
    fit_rigid,
    invert,
    is_rigid,
    make_pose,
    move_about,
    origin_of,
    pose_about,
    rotation_of,
    transform,
)
from posefilter.geometry.rotation import (
    angle_between,
    exp_so3,
    log_so3,
    project_to_so3,
    random_rotation,
)

shapes = pytest.mark.parametrize("shape", [(), (7,), (3, 5), (2, 1, 4), (0,)], ids=str)
dtypes = pytest.mark.parametrize(
    ("dtype", "atol"), [(torch.float32, 2e-5), (torch.float64, 1e-12)], ids=["f32", "f64"]
)


def poses(shape: tuple[int, ...], dtype: torch.dtype, seed: int) -> Tensor:
    g = Generator().manual_seed(seed)
    return make_pose(random_rotation(*shape, generator=g), torch.randn(*shape, 3, generator=g)).to(
        dtype
    )


def polished(T: Tensor) -> Tensor:
    """Make rotations orthonormal to the precision of their type."""
    return make_pose(project_to_so3(rotation_of(T)), T[..., :3, 3])


@shapes
@dtypes
def test_poses_are_a_group(shape: tuple[int, ...], dtype: torch.dtype, atol: float) -> None:
    a, b, c = (polished(poses(shape, dtype, seed)) for seed in range(3))
    eye = torch.eye(4, dtype=dtype).expand(*shape, 4, 4)
    close = lambda x, y: torch.testing.assert_close(x, y, atol=atol, rtol=0)  # noqa: E731
    assert is_rigid(a @ b, 10 * atol)
    close((a @ b) @ c, a @ (b @ c))
    close(a @ eye, a)
    close(a @ invert(a), eye)
    close(invert(a) @ a, eye)
    close(invert(a @ b), invert(b) @ invert(a))
    assert invert(a).dtype == a.dtype
    assert invert(a).shape == a.shape


@shapes
@dtypes
def test_transforms_compose_and_keep_distances(
    shape: tuple[int, ...], dtype: torch.dtype, atol: float
) -> None:
    a, b = (polished(poses(shape, dtype, seed)) for seed in range(2))
    points = torch.randn(*shape, 6, 3, dtype=dtype, generator=Generator().manual_seed(3))
    torch.testing.assert_close(
        transform(a @ b, points), transform(a, transform(b, points)), atol=5 * atol, rtol=0
    )
    torch.testing.assert_close(
        transform(invert(a), transform(a, points)), points, atol=5 * atol, rtol=0
    )
    gaps = lambda p: (p[..., :1, :] - p).norm(dim=-1)  # noqa: E731
    torch.testing.assert_close(gaps(transform(a, points)), gaps(points), atol=5 * atol, rtol=0)


def test_the_axioms_catch_a_planted_defect() -> None:
    a = poses((5,), torch.float64, 0)
    # an inverse that forgets to turn the shift
    transposed = make_pose(rotation_of(a).transpose(-1, -2), -a[..., :3, 3])
    assert (transposed @ a - torch.eye(4, dtype=a.dtype)).abs().max() > 0.1
    reflected = a * torch.tensor([-1.0, 1, 1, 1], dtype=a.dtype)
    assert not is_rigid(reflected)


@shapes
@dtypes
def test_exp_and_log_invert_each_other(
    shape: tuple[int, ...], dtype: torch.dtype, atol: float
) -> None:
    g = Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=g, dtype=dtype), dim=-1)
    for angle in (0.0, 1e-9, 1e-5, 0.9e-4, 1.1e-4, 0.1, 1.0, 3.0, math.pi - 1e-3):
        v = angle * axis
        torch.testing.assert_close(log_so3(exp_so3(v)), v, atol=10 * atol, rtol=0)
        torch.testing.assert_close(exp_so3(-v), exp_so3(v).transpose(-1, -2), atol=atol, rtol=0)
        torch.testing.assert_close(exp_so3(v / 2) @ exp_so3(v / 2), exp_so3(v), atol=atol, rtol=0)


@shapes
@dtypes
def test_angles_are_a_metric(shape: tuple[int, ...], dtype: torch.dtype, atol: float) -> None:
    a, b, c = (rotation_of(polished(poses(shape, dtype, seed))) for seed in range(3))
    assert (angle_between(a, b) <= angle_between(a, c) + angle_between(c, b) + 1e-3).all()
    torch.testing.assert_close(angle_between(a, b), angle_between(b, a), atol=1e-3, rtol=0)
    torch.testing.assert_close(angle_between(c @ a, c @ b), angle_between(a, b), atol=1e-3, rtol=0)
    torch.testing.assert_close(
        angle_between(a, a), torch.zeros(shape, dtype=dtype), atol=1e-5, rtol=0
    )
    by_log = log_so3(a.transpose(-1, -2) @ b).norm(dim=-1)
    torch.testing.assert_close(angle_between(a, b), by_log, atol=2e-3, rtol=0)


@shapes
@dtypes
def test_moves_about_the_center_separate_rotation_and_translation(
    shape: tuple[int, ...], dtype: torch.dtype, atol: float
) -> None:
    T = polished(poses(shape, dtype, 0))
    center = torch.tensor([0.3, -0.2, 0.1], dtype=dtype)
    tangent = torch.randn(*shape, 6, dtype=dtype, generator=Generator().manual_seed(1))
    moved = move_about(T, tangent, center)
    shift = origin_of(moved, center) - origin_of(T, center)
    torch.testing.assert_close(shift, tangent[..., :3], atol=10 * atol, rtol=0)
    turn = rotation_of(T).transpose(-1, -2) @ rotation_of(moved)
    torch.testing.assert_close(turn, exp_so3(tangent[..., 3:]), atol=10 * atol, rtol=0)
    again = pose_about(rotation_of(T), origin_of(T, center), center)
    torch.testing.assert_close(again, T, atol=10 * atol, rtol=0)


@shapes
@dtypes
def test_fitting_finds_the_transform_that_made_the_points(
    shape: tuple[int, ...], dtype: torch.dtype, atol: float
) -> None:
    g = Generator().manual_seed(2)
    T = polished(poses(shape, dtype, 0))
    source = torch.randn(*shape, 9, 3, generator=g, dtype=dtype)
    target = transform(T, source)
    target[..., -1, :] += 5.0  # an outlier of no weight
    weights = torch.rand(*shape, 9, generator=g, dtype=dtype) + 0.1
    weights[..., -1] = 0
    torch.testing.assert_close(fit_rigid(source, target, weights), T, atol=50 * atol, rtol=0)
