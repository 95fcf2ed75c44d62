"""Poses from three or four votes: exact where votes are, near the seed, by the weights."""

import torch
from torch import Tensor

from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import angle_between, exp_so3
from posefilter.geometry.votes import draw_votes

CENTER, RADIUS = torch.tensor([0.01, -0.02, 0.03]), 0.15
POSE = make_pose(exp_so3(torch.tensor([0.4, -0.7, 0.2])), torch.tensor([0.1, 0.05, 0.9]))


def place(thing: Tensor) -> Tensor:
    """Return where points (n, 3), from the center and in radii, are in the camera [m]."""
    return (thing * RADIUS + CENTER) @ POSE[:3, :3].T + POSE[:3, 3]


def draw(point: Tensor, weight: Tensor, position: Tensor, count: int = 60, **more: int) -> Tensor:
    share = torch.ones(1, len(point), position.shape[1]) / position.shape[1]
    g = torch.Generator().manual_seed(0)
    return draw_votes(
        point[None], weight[None], share, position[None], CENTER, RADIUS, count, g, **more
    )[0]


def right(poses: Tensor) -> Tensor:
    turn = angle_between(poses[:, :3, :3], POSE[:3, :3]) < 0.05
    return turn & ((poses[:, :3, 3] - POSE[:3, 3]).norm(dim=-1) < 0.005)


def scattered(count: int) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def test_points_far_from_the_seed_do_not_vote() -> None:
    """A second object ten radii away, moved otherwise: a mixture of both would fit neither."""
    thing = scattered(40)
    there = place(thing)
    other = there + torch.tensor([10 * RADIUS, 0.0, 0.0]) + 0.05
    point = torch.cat([there, other])
    poses = draw(point, torch.ones(80), torch.cat([thing, thing])[:, None], 200, votes=6)
    of_first = poses[:, 0, 3] < 0.9
    assert 60 < int(of_first.sum()) < 140
    assert right(poses[of_first]).float().mean() > 0.95


def test_points_without_weight_do_not_vote() -> None:
    thing = scattered(40)
    wrong = torch.cat([thing[:10], scattered(70)[40:]])
    weight = (torch.arange(40) < 10).float()
    assert right(draw(place(thing), weight, wrong[:, None], votes=6)).float().mean() > 0.9
    assert right(draw(place(thing), 1 - weight, wrong[:, None], votes=6)).sum() == 0


def test_of_two_fragments_the_one_that_keeps_the_distances_is_drawn() -> None:
    """The other of each point lies where the object would be twice as large."""
    thing = scattered(40) * 0.5
    options = torch.stack([thing, 2 * thing + 0.3], dim=1)
    poses = draw(place(thing), torch.ones(40), options, 300, votes=6)
    # seeds are of either fragment: where they are of the first, so are the other votes
    assert 0.25 < right(poses).float().mean() < 0.75  # by chance all seven are in 1 of 128


def test_an_image_without_weights_has_poses_nevertheless() -> None:
    thing = scattered(12)
    poses = draw(place(thing), torch.zeros(12), thing[:, None], 20, votes=6)
    assert right(poses).float().mean() > 0.8
