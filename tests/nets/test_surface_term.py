"""What the depth says of a hypothesis's surface, on a ball before a wall."""

import pytest
import torch

from posefilter.geometry.camera import intrinsics, pixel_grid, rays
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import fibonacci_sphere
from posefilter.nets.coordinates import Context
from posefilter.nets.likelihood import Pixels, PoseLikelihood, flatten_images
from posefilter.nets.surface_term import SurfaceTerm

H, W, BALL, WALL, RADIUS = 120, 160, 0.8, 1.5, 0.1  # distances [m]
K = intrinsics(200.0, 200.0, 79.5, 59.5)[None]
CENTER = torch.tensor([0.02, -0.01, 0.03])
POINTS = CENTER + RADIUS * torch.as_tensor(fibonacci_sphere(400)).float()
# in the order in which they are returned: the tight tolerance, front then back; the wide one
AGREES, THROUGH, HIDDEN, BACK_AGREES, BACK_THROUGH, BACK_HIDDEN = range(6, 12)
INSIDE, KNOWN = 12, 13


def make_image() -> Pixels:
    """Return a ball of the object's size in the middle of the image, before a wall."""
    ray = rays(pixel_grid(H, W).reshape(1, -1, 2), K)[0]
    along, square = BALL * ray[:, 2], (ray * ray).sum(-1)
    root = along.square() - square * (BALL**2 - RADIUS**2)
    near = (along - root.clamp_min(0).sqrt()) / square
    depth = torch.where(root > 0, near, torch.full_like(near, WALL))
    return flatten_images(torch.rand(1, 3, H, W), depth.view(1, 1, H, W), K)


def at(*middles: tuple[float, float, float]) -> torch.Tensor:
    """Return poses whose object has its center there."""
    return make_pose(torch.eye(3).expand(1, len(middles), 3, 3), torch.tensor([middles]) - CENTER)


def shares(poses: torch.Tensor, sigma: float = 0.004) -> torch.Tensor:
    term, image = SurfaceTerm(), make_image()
    term.set_object(POINTS)
    found = term.measure(image, poses, torch.tensor(sigma), CENTER, RADIUS)
    return (found[0] + 1) / 2


def test_where_the_object_is_its_front_is_seen_and_its_back_is_hidden() -> None:
    (there,) = shares(at((0.0, 0.0, BALL)))
    assert there[AGREES] > 0.95
    assert there[THROUGH] < 0.03
    assert there[BACK_HIDDEN] > 0.95
    assert there[INSIDE] == pytest.approx(1)
    assert there[KNOWN] == pytest.approx(1)


def test_a_surface_that_is_seen_through_is_told_from_one_that_is_hidden() -> None:
    before, behind, beside = shares(at((0, 0, 0.5), (0, 0, 1.1), (0.22, 0, BALL)))
    assert before[THROUGH] > 0.95
    assert before[HIDDEN] < 0.01
    assert behind[HIDDEN] > 0.8  # what shows beside the ball is the wall
    assert behind[AGREES] < 0.1
    assert beside[THROUGH] > 0.95
    assert beside[BACK_THROUGH] > 0.95


def test_a_broader_noise_level_forgives_more() -> None:
    off = at((0.0, 0.0, BALL - 0.03))
    assert shares(off, 0.004)[0, THROUGH] > 0.6
    assert shares(off, 0.04)[0, THROUGH] < 0.1  # of the rim, beside which the wall shows
    assert shares(off, 0.04)[0, AGREES] > 0.85


def test_off_the_frame_and_behind_the_camera_nothing_is_known() -> None:
    for nowhere in shares(at((3.0, 0.0, BALL), (0.0, 0.0, -1.0))):
        assert nowhere[INSIDE] == 0
        assert nowhere[KNOWN] == 0
        assert nowhere[AGREES] + nowhere[THROUGH] + nowhere[HIDDEN] == 0


def test_membership_counts_where_the_surface_is_seen() -> None:
    term, image = SurfaceTerm(), make_image()
    term.set_object(POINTS)
    member = torch.zeros(1, H // 2, W // 2)
    member[:, 17:43, 27:53] = 1  # the ball
    poses = at((0, 0, BALL), (0.22, 0, BALL))
    none = torch.zeros(1, 0)
    logit = torch.logit(member, eps=1e-9).flatten(1)[..., None]
    image = image._replace(context=Context(logit, none, none, none, (H // 8, W // 8), W // 2))
    found = term.measure(image, poses, torch.tensor(0.004), CENTER, RADIUS)
    there, beside = (found[0] + 1) / 2
    assert there[-1] > 0.9
    assert there[-2] > 0.85
    assert beside[-1] == 0


def test_the_term_is_zero_until_it_is_trained_and_then_adds_to_the_score() -> None:
    plain = PoseLikelihood(width=16, blocks=1, octaves=2)
    judged = PoseLikelihood(width=16, blocks=1, octaves=2, surface=SurfaceTerm())
    judged.load_state_dict(plain.state_dict(), strict=False)
    assert judged.surface is not None
    judged.surface.set_object(POINTS)
    image, poses = make_image(), at((0, 0, BALL), (0, 0, 0.5), (0.3, 0, 1.1))

    def score(likelihood: PoseLikelihood, grad: bool = False) -> torch.Tensor:
        with torch.set_grad_enabled(grad):
            drawn = torch.Generator().manual_seed(1)
            sigma = torch.tensor(0.01)
            return likelihood(image, poses, sigma, CENTER, RADIUS, 40, drawn).detach()

    torch.testing.assert_close(score(judged), score(plain), rtol=0, atol=0)
    for parameter in judged.surface.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    added = score(judged) - score(plain)
    assert added.std() > 0.1
    torch.testing.assert_close(score(judged, grad=True), score(judged), rtol=1e-4, atol=1e-3)


def test_the_term_has_a_gradient_in_the_pose() -> None:
    term, image = SurfaceTerm(), make_image()
    term.set_object(POINTS)
    poses = at((0.0, 0.0, BALL - 0.01)).requires_grad_()
    (through,) = term.measure(image, poses, torch.tensor(0.02), CENTER, RADIUS)[
        0, :, 1:2
    ]  # tight tolerance
    (gradient,) = torch.autograd.grad(through.sum(), poses)
    assert gradient[0, 0, 2, 3] < 0  # farther from the camera less is seen through
