"""ICP lays a box on its depth: what depth determines is found, what it leaves open stays."""

from types import SimpleNamespace
from typing import NamedTuple

import pytest
import torch
from torch import Generator, Tensor

from posefilter.errors import UserError
from posefilter.filters.icp import PointToPlaneIcp, look_up
from posefilter.geometry.camera import intrinsics, pixel_grid, rays
from posefilter.geometry.pose import make_pose, rotation_of, transform
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import exp_so3
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import BeliefBatch

H, W = 120, 160
K = intrinsics(200.0, 200.0, 79.5, 59.5)
HALF = torch.tensor([0.09, 0.06, 0.04])
MIDDLE = torch.tensor([0.02, -0.01, 0.03])  # the box's, in its own frame
SPACE = PoseSpace(tuple(MIDDLE.tolist()), float(HALF.norm()))


class Seen(NamedTuple):
    measured_depth: Tensor
    intrinsics: Tensor


def surface(count: int = 600) -> Tensor:
    """Return points of the box's faces, (count, 3) [m]."""
    g = Generator().manual_seed(3)
    points = (2 * torch.rand(count, 3, generator=g) - 1) * HALF
    face = torch.arange(count) % 3
    side = torch.where(torch.rand(count, generator=g) < 0.5, -1.0, 1.0)
    points[torch.arange(count), face] = side * HALF[face]
    return points + MIDDLE


def render(pose: Tensor, wall: float = 1.5) -> Tensor:
    """Return the depth of the box before a wall, (H, W) [m], by the slab method."""
    view = rays(pixel_grid(H, W).reshape(-1, 2), K) @ rotation_of(pose)
    eye = -(pose[:3, 3] @ rotation_of(pose)) - MIDDLE
    one, other = (-HALF - eye) / view, (HALF - eye) / view
    enter = torch.minimum(one, other).amax(-1)
    leave = torch.maximum(one, other).amin(-1)
    return torch.where(enter < leave, enter, wall).view(H, W)


def method(points: Tensor | None = None) -> SimpleNamespace:
    own = surface() if points is None else points
    model = SimpleNamespace(points=own, center=MIDDLE, radius=SPACE.radius)
    return SimpleNamespace(object_model=model)


def belief(pose: Tensor) -> BeliefBatch:
    return BeliefBatch(pose[:, None], torch.zeros(len(pose), 1), pose, torch.ones(len(pose)))


def look(*poses: Tensor) -> Seen:
    return Seen(torch.stack([render(pose) for pose in poses]), K.expand(len(poses), 3, 3))


def turned(*angles: float) -> Tensor:
    return make_pose(exp_so3(torch.tensor(angles)), torch.tensor([0.03, 0.02, 0.7]))


CORNER = turned(0.5, 0.6, 0.2)  # three faces are seen
FLAT = make_pose(torch.eye(3), torch.tensor([0.0, 0.0, 0.7]))


def off(found: Tensor, truth: Tensor) -> Tensor:
    """Return shift [mm] and turn [degrees]."""
    twist = twist_between(truth, found, MIDDLE)
    return torch.stack([1000 * twist[..., :3].norm(dim=-1), twist[..., 3:].norm(dim=-1).rad2deg()])


def test_three_faces_determine_a_pose() -> None:
    g = Generator().manual_seed(0)
    truth = torch.stack([CORNER, turned(-0.6, 0.5, 0.2), turned(-0.5, -0.6, 0.3)])
    noise = SPACE.noise_scale(torch.tensor(0.005)) * torch.randn(3, 6, generator=g)
    start = SPACE.move(truth, noise)
    free = PointToPlaneIcp(iterations=10, prior=0.1)
    found = free(belief(start), look(*truth), method(), g).best
    assert (off(start, truth)[0] > 4).all()
    assert (off(found, truth)[0] < 0.6).all()
    assert (off(found, truth)[1] < 0.6).all()
    # each image by itself
    alone = free(belief(start[1:2]), look(truth[1]), method(), g).best
    assert torch.allclose(alone[0], found[1], atol=1e-6)


def test_what_a_plane_leaves_open_stays() -> None:
    tangent = torch.tensor([0.003, -0.002, 0.005, 0.03, -0.02, 0.04])
    start = SPACE.move(FLAT, tangent)
    found = PointToPlaneIcp()(belief(start[None]), look(FLAT), method(), Generator()).best[0]
    rest = twist_between(FLAT, found, MIDDLE)
    # along the normal, and the turns out of the plane
    assert rest[2].abs() < 0.0007
    assert (rest[3:5].abs() < 0.008).all()
    # in the plane
    assert torch.allclose(rest[[0, 1, 5]], tangent[[0, 1, 5]], atol=3e-3, rtol=0.1)


def test_the_prior_holds_what_noise_would_move() -> None:
    start = SPACE.move(CORNER, torch.tensor([0.0, 0.0, 0.004, 0.0, 0.0, 0.0]))
    shifts = []
    for prior in (1e-4, 1e-3, 1e-2):
        icp = PointToPlaneIcp(prior=prior)
        found = icp(belief(start[None]), look(CORNER), method(), Generator()).best
        shifts.append(float(off(found, start[None])[0]))
    assert shifts[0] < 0.1
    assert shifts == sorted(shifts)
    assert shifts[2] > 3


def test_an_occluder_missing_depth_and_a_far_pose_move_nothing() -> None:
    start = SPACE.move(CORNER, torch.full((6,), 0.004))[None]
    encoding = look(CORNER)
    far = SPACE.move(CORNER, torch.tensor([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]))[None]
    for depth, pose in (
        (torch.full((1, H, W), 0.4), start),
        (torch.zeros(1, H, W), start),
        (encoding.measured_depth, far),
    ):
        given = belief(pose)
        seen = encoding._replace(measured_depth=depth)
        found = PointToPlaneIcp()(given, seen, method(), Generator())
        assert torch.equal(found.best, pose)
        assert found.poses is given.poses
        assert found.score is given.score


def test_half_an_object_is_enough() -> None:
    depth = render(CORNER)
    depth[:, W // 2 + 6 :] = 0.5  # something nearer covers the rest
    start = SPACE.move(CORNER, torch.tensor([0.002, -0.002, 0.005, 0.02, 0.0, -0.02]))[None]
    icp = PointToPlaneIcp(iterations=10, prior=0.02)
    found = icp(belief(start), Seen(depth[None], K[None]), method(), Generator()).best
    assert off(found, CORNER[None])[0] < 0.3 * off(start, CORNER[None])[0]


def test_derivatives_agree_with_moves() -> None:
    icp, encoding = PointToPlaneIcp(), look(CORNER)
    rows, along, weights = icp._pair(CORNER[None], surface(), MIDDLE, encoding, 0.015)
    step = 1e-4 * torch.randn(6, generator=Generator().manual_seed(1))
    moved = transform(SPACE.move(CORNER, step), surface())
    seen = look_up(
        encoding.measured_depth, encoding.intrinsics, pixels_of(transform(CORNER, surface()))
    )
    change = ((moved - transform(CORNER, surface())) * seen.normals[0]).sum(-1)
    used = weights[0] > 0
    assert used.sum() > 100
    assert torch.allclose((rows[0] @ step.double())[used], change[used].double(), atol=1e-6)
    assert along[0][used].abs().quantile(0.9) < 0.001  # but for points of hidden faces


def pixels_of(points: Tensor) -> Tensor:
    from posefilter.geometry.camera import project
    from posefilter.geometry.lookup import nearest_pixel

    return nearest_pixel(project(points[None], K[None]))


def test_an_image_of_another_camera_beside_it_changes_nothing() -> None:
    g, seen = Generator().manual_seed(3), look(CORNER)
    rough = seen.measured_depth + 0.001 * torch.randn(seen.measured_depth.shape, generator=g)
    both = Seen(rough.repeat(2, 1, 1), torch.stack([K, torch.diag(torch.tensor([4.0, 4, 1])) @ K]))
    pixels = torch.tensor([[[W // 2, H // 2]]]).repeat(2, 1, 1)
    together = look_up(both.measured_depth, both.intrinsics, pixels)
    for row in range(2):
        alone = look_up(*(x[row : row + 1] for x in (*both, pixels)))
        assert torch.equal(together.normals[row], alone.normals[0])


def test_normals_of_a_slope_and_none_at_edges() -> None:
    normal = torch.nn.functional.normalize(torch.tensor([0.3, -0.2, -1.0]), dim=0)
    view = rays(pixel_grid(H, W).reshape(-1, 2), K)
    depth = (-0.8 / (view @ normal)).view(1, H, W)
    depth[:, :, 80:] = 3.0
    depth[0, 20, 20] = 0
    pixels = torch.tensor([[[40, 40], [79, 40], [20, 20], [0, 40], [-5, 10], [20, 21]]])
    seen = look_up(depth, K[None], pixels)
    assert torch.allclose(seen.normals[0, 0], normal, atol=1e-4)
    assert seen.known[0].tolist() == [True, False, False, False, False, False]
    assert torch.allclose(seen.points[0, 0] @ normal, torch.tensor(-0.8), atol=1e-5)


@pytest.mark.parametrize(
    "wrong", [{"iterations": 0}, {"prior": 0}, {"initial_gate": 0.001}, {"points": 0}]
)
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UserError, match="ICP needs"):
        PointToPlaneIcp(**wrong)
