"""Evenly drawn points: standard normal one by one, and means over them that vary less."""

import torch

from posefilter.geometry.camera import intrinsics
from posefilter.nets.likelihood import PoseLikelihood, flatten_images
from posefilter.nets.quasi_monte_carlo import draw_quasi_random

CPU = torch.device("cpu")


def test_every_point_is_standard_normal_by_itself() -> None:
    points = draw_quasi_random(4000, 16, torch.Generator().manual_seed(0), CPU)
    assert points.shape == (4000, 1, 16, 2)
    assert points.dtype == torch.float32
    assert torch.isfinite(points).all()
    # standard errors: 0.016 of a mean, 0.011 of a deviation
    assert points.mean(0).abs().max() < 0.07
    assert (points.std(0) - 1).abs().max() < 0.05
    both = points[:, 0, :, 0] * points[:, 0, :, 1]
    assert both.mean(0).abs().max() < 0.07


def test_sets_are_independent_and_the_seed_decides() -> None:
    draw = lambda seed: draw_quasi_random(3000, 8, torch.Generator().manual_seed(seed), CPU)  # noqa: E731
    one = draw(1)
    assert torch.equal(one, draw(1))
    assert not torch.equal(one, draw(2))
    first = one[:, 0, 0, 0]
    assert torch.corrcoef(torch.stack([first[:-1], first[1:]]))[0, 1].abs() < 0.08


def test_the_score_of_a_pose_varies_less_from_draw_to_draw() -> None:
    g = torch.Generator().manual_seed(0)
    rgb = torch.rand(1, 3, 12, 16, generator=g).repeat_interleave(8, 2).repeat_interleave(8, 3)
    depth = torch.full((1, 1, 96, 128), 0.8)
    image = flatten_images(rgb, depth, intrinsics(300.0, 300.0, 63.5, 47.5)[None])
    torch.manual_seed(3)
    likelihood = PoseLikelihood(width=32, blocks=2, octaves=2).eval()
    for parameter in likelihood.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    pose = torch.eye(4)[None, None].clone()
    pose[..., 2, 3] = 0.8

    def scores(even: bool) -> torch.Tensor:
        seen = image._replace(even=even)
        arguments = (seen, pose, torch.tensor(0.02), torch.zeros(3), 0.1, 64)
        draws = [likelihood(*arguments, torch.Generator().manual_seed(n)) for n in range(200)]
        return torch.stack(draws).flatten()

    with torch.no_grad():
        plain, even = scores(False), scores(True)
    assert plain.std() > 0
    assert even.std() < 0.7 * plain.std()
    assert abs(even.mean() - plain.mean()) < 4 * plain.std() / 200**0.5  # nothing is shifted
