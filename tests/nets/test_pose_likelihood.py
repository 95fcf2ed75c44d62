"""Which points a pose reads, and that its score depends on nothing else."""

import pytest
import torch

from posefilter.errors import UserError
from posefilter.geometry.camera import intrinsics, project, rays
from posefilter.geometry.pose import invert, make_pose, origin_of, transform
from posefilter.geometry.rotation import exp_so3, random_rotation
from posefilter.nets.coordinates import Coordinates
from posefilter.nets.likelihood import PoseLikelihood, flatten_images, sample_points
from posefilter.nets.paper_likelihood import PaperLikelihood

H, W = 48, 64
K = intrinsics(80.0, 90.0, 31.0, 22.0)[None]
CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03]), 0.1


def image() -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(0)
    return torch.rand(1, 3, H, W, generator=g), 0.7 + 0.2 * torch.rand(1, 1, H, W, generator=g)


def pose() -> torch.Tensor:
    return make_pose(exp_so3(torch.tensor([0.4, -0.7, 0.2])), torch.tensor([0.02, 0.01, 0.8]))[
        None, None
    ]


def test_points_are_the_pixels_lifted_into_the_object_frame() -> None:
    rgb, depth = image()
    noise = torch.randn(1, 1, 20, 2, generator=torch.Generator().manual_seed(1))
    points = sample_points(flatten_images(rgb, depth, K), pose(), CENTER, RADIUS, noise)
    middle = origin_of(pose(), CENTER)
    reach = 0.6 * RADIUS * K[0, 0, 0] / middle[0, 0, 2]
    for k in range(20):  # one by one, by the definition
        u, v = (project(middle, K)[0, 0] + reach * noise[0, 0, k]).round().long().tolist()
        assert 0 <= u < W
        assert 0 <= v < H
        ray = rays(torch.tensor([[[float(u), float(v)]]]), K)[0, 0]
        there = transform(invert(pose()[0, 0]), (ray * depth[0, 0, v, u])[None])[0] - CENTER
        torch.testing.assert_close(points.position[0, 0, k], there, atol=1e-6, rtol=0)
        torch.testing.assert_close(points.color[0, 0, k], rgb[0, :, v, u])
        torch.testing.assert_close(
            points.ray[0, 0, k], pose()[0, 0, :3, :3].T @ (ray / ray.norm()), atol=1e-6, rtol=0
        )
    assert points.known.all()
    assert points.inside.all()


def test_a_pixel_without_depth_gives_the_rays_nearest_point() -> None:
    rgb, depth = image()
    noise = torch.randn(1, 1, 50, 2, generator=torch.Generator().manual_seed(1))
    points = sample_points(
        flatten_images(rgb, torch.zeros_like(depth), K), pose(), CENTER, RADIUS, noise
    )
    assert not points.known.any()
    # the nearest point is square to the ray
    assert (points.position * points.ray).sum(-1).abs().max() < 1e-5


def test_pixels_outside_the_frame_are_known_to_be_so() -> None:
    rgb, depth = image()
    away = make_pose(torch.eye(3), torch.tensor([2.0, 0.0, 0.8]))[None, None]
    points = sample_points(
        flatten_images(rgb, depth, K), away, CENTER, RADIUS, torch.randn(1, 1, 50, 2)
    )
    assert not points.inside.any()


def test_a_score_does_not_change_with_the_frame() -> None:
    """Turning camera and object together about the optical axis must not matter, nor what other
    poses are asked.
    """
    rgb, depth = image()
    net = PoseLikelihood(width=32, blocks=1)
    encoding = flatten_images(rgb, depth, K)
    g = lambda: torch.Generator().manual_seed(3)  # noqa: E731
    others = make_pose(random_rotation(1, 5), torch.tensor([0.0, 0.0, 0.9]))
    alone = net(encoding, pose(), torch.tensor(0.02), CENTER, RADIUS, 64, g())
    among = net(
        encoding, torch.cat([pose(), others], 1), torch.tensor(0.02), CENTER, RADIUS, 64, g()
    )
    torch.testing.assert_close(alone[:, 0], among[:, 0])
    assert (among[0, 1:] - among[0, 0]).abs().min() > 1e-5


def test_the_noise_level_changes_the_score() -> None:
    encoding = flatten_images(*image(), K)
    net = PoseLikelihood(width=32, blocks=1)
    g = lambda: torch.Generator().manual_seed(3)  # noqa: E731
    broad = net(encoding, pose(), torch.tensor(0.2), CENTER, RADIUS, 64, g())
    sharp = net(encoding, pose(), torch.tensor(0.005), CENTER, RADIUS, 64, g())
    assert (broad - sharp).abs().item() > 1e-4
    assert net.level(torch.tensor([0.003, 0.25]))[:, 0].tolist() == pytest.approx(
        [-1.0, 1.0], abs=1e-5
    )


def test_without_its_ray_a_point_is_judged_by_where_it_lies_alone() -> None:
    encoding = flatten_images(*image(), K)
    points = sample_points(encoding, pose(), CENTER, RADIUS, torch.randn(1, 1, 50, 2))
    turned = points._replace(ray=-points.ray)
    for ray in (True, False):
        net = PoseLikelihood(width=32, blocks=1, ray=ray)
        seen, other = (net.score_points(p, 0.02, CENTER, RADIUS) for p in (points, turned))
        assert torch.equal(seen, other) is not ray


def test_gradients_reach_the_pose() -> None:
    encoding = flatten_images(*image(), K)
    shift = torch.zeros(3, requires_grad=True)
    moved = make_pose(pose()[..., :3, :3], pose()[..., :3, 3] + shift)
    net = PoseLikelihood(width=32, blocks=1)
    net(
        encoding, moved, torch.tensor(0.01), CENTER, RADIUS, 64, torch.Generator().manual_seed(0)
    ).sum().backward()
    assert shift.grad is not None
    assert shift.grad.abs().max() > 0


def predicted(features: int = 2, wrong: float = 0.0) -> Coordinates:
    """Return what a network might say of a wall at 0.8 m: coordinates true at the pose above but
    for a shift, in radii.

    Two fragments, of equal share; the second's place is nonsense.
    """
    g = torch.Generator().manual_seed(2)
    h, w = H // 8, W // 8
    pixel = (
        torch.stack(torch.meshgrid(torch.arange(w), torch.arange(h), indexing="xy"), -1) * 8.0 + 3.5
    )
    ray = rays(pixel.reshape(1, -1, 2), K)
    there = (transform(invert(pose()[0, 0]), (ray * 0.8)[0]) - CENTER).reshape(1, h, w, 1, 3)
    place = torch.cat([there / RADIUS + wrong, torch.full((1, h, w, 1, 3), 99.0)], dim=3)
    centers = torch.tensor([[[0.0, 0.0, 0.0], [50.0, 50.0, 50.0]]])
    chatter = torch.randn(1, h, w, features, generator=g)
    return Coordinates(
        torch.zeros(1, h, w), torch.full((1, h, w, 2), 0.5).log(), place, centers, chatter
    )


def test_context_is_read_where_the_point_is() -> None:
    rgb, _ = image()
    flat = torch.full((1, 1, H, W), 0.8)
    noise = 0.3 * torch.randn(1, 1, 40, 2, generator=torch.Generator().manual_seed(1))
    points = sample_points(flatten_images(rgb, flat, K, predicted()), pose(), CENTER, RADIUS, noise)
    assert points.context is not None
    assert points.context.shape == (1, 1, 40, 5 + 2)
    torch.testing.assert_close(points.context[..., 0].exp(), torch.full((1, 1, 40), 0.5))
    # away from the border, where interpolation has to hold
    middle = (points.position / RADIUS).norm(dim=-1) < 1.2
    assert middle.sum() > 10
    off = (points.context[..., 1:4] - points.position / RADIUS).norm(dim=-1)[middle]
    assert off.max() < 1e-3  # on a wall the true coordinates are linear in the pixel
    moved = sample_points(
        flatten_images(rgb, flat, K, predicted(wrong=0.5)), pose(), CENTER, RADIUS, noise
    )
    assert moved.context is not None
    assert (moved.context[..., 1:4] - points.position / RADIUS).norm(dim=-1)[middle].min() > 0.7


def test_gradients_reach_the_features_but_not_the_predicted_coordinates() -> None:
    told = Coordinates(*(x.requires_grad_() for x in predicted()))
    net = PoseLikelihood(width=32, blocks=1, context=2)
    encoding = flatten_images(*image(), K, told)
    net(
        encoding, pose(), torch.tensor(0.01), CENTER, RADIUS, 64, torch.Generator().manual_seed(0)
    ).sum().backward()
    assert told.features.grad is not None
    assert told.features.grad.abs().max() > 0
    assert told.position.grad is None
    assert told.log_prob.grad is None
    assert told.logit.grad is None


def test_what_the_context_says_changes_the_score() -> None:
    net = PoseLikelihood(width=32, blocks=1, context=2)
    g = lambda: torch.Generator().manual_seed(3)  # noqa: E731
    right, wrong = (
        net(flatten_images(*image(), K, told), pose(), torch.tensor(0.01), CENTER, RADIUS, 64, g())
        for told in (predicted(), predicted(wrong=1.0))
    )
    assert (right - wrong).abs().item() > 1e-4


def test_context_without_a_proposal_network_is_refused() -> None:
    net = PoseLikelihood(width=32, blocks=1, context=2)
    with pytest.raises(UserError, match="model/proposals=dense"):
        net(
            flatten_images(*image(), K),
            pose(),
            torch.tensor(0.01),
            CENTER,
            RADIUS,
            64,
            torch.Generator(),
        )


def test_pixels_are_drawn_about_the_origin_or_the_center() -> None:
    rgb, depth = image()
    noise = torch.zeros(1, 1, 1, 2)
    for anchor in (None, torch.zeros(3)):
        points = sample_points(
            flatten_images(rgb, depth, K), pose(), CENTER, RADIUS, noise, anchor=anchor
        )
        point = CENTER if anchor is None else anchor
        wanted = project(transform(pose(), point[None, None, None])[:, 0], K).round()
        ray = torch.nn.functional.normalize(rays(wanted, K), dim=-1) @ pose()[0, 0, :3, :3]
        torch.testing.assert_close(points.ray[0, 0], ray[0])
    with pytest.raises(UserError, match="choose origin or center"):
        PaperLikelihood(anchor="middle")


@pytest.mark.parametrize(("about", "anchor"), [("origin", torch.zeros(3)), ("center", CENTER)])
def test_the_papers_likelihood_is_a_sum_over_points(about: str, anchor: torch.Tensor) -> None:
    rgb, depth = image()
    net = PaperLikelihood(anchor=about)
    noise = torch.randn(1, 1, 30, 2, generator=torch.Generator().manual_seed(5))
    points = sample_points(
        flatten_images(rgb, depth, K), pose(), CENTER, RADIUS, noise, anchor=anchor
    )
    by_hand = sum(
        net.score_samples(points.position[0, 0, k] + CENTER, points.color[0, 0, k])
        for k in range(30)
        if points.inside[0, 0, k] and points.known[0, 0, k]
    )
    got = net(
        flatten_images(rgb, depth, K),
        pose(),
        torch.tensor(0.0),
        CENTER,
        RADIUS,
        30,
        torch.Generator().manual_seed(5),
    )
    torch.testing.assert_close(got[0, 0], by_hand)
    assert (
        sum(p.numel() for p in net.parameters())
        == 6 * 128 + 128 + 5 * 2 * (128 * 128 + 128) + 128 + 1
    )  # table 1
