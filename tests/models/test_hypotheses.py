"""The comparisons without a filter, end to end on a toy world, and the laws that they must keep."""

from functools import partial

import pytest
import torch
from tests.models.toy import SIDE, scenes, square
from torch import Tensor, nn

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax
from posefilter.filters.initialize import FromProposals
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Identity
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import NoResampling
from posefilter.filters.reweight import CurrentLikelihood
from posefilter.filters.schedule import Constant
from posefilter.geometry.keypoints import draw_gaussians, project_keypoints
from posefilter.losses.heatmaps import Heatmaps
from posefilter.metrics.errors import add
from posefilter.models.dense_coordinates import DenseCoordinates
from posefilter.models.keypoints import Keypoints
from posefilter.models.pose_particles import Hypotheses
from posefilter.nets.coordinates import CoordinateLoss
from posefilter.nets.heatmaps import STRIDE, HeatmapNet
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.types import ObjectModel, Trace

WIDTHS = (16, 24, 32, 32)


def thick() -> ObjectModel:
    """Return the square in a box 10 cm deep, whose corners are no plane."""
    hull = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-0.5, 0.5)]) * (
        SIDE / 2
    )
    return square()._replace(hull=hull)


def test_keypoints_of_a_flat_object_are_refused() -> None:
    """Of corners in a plane EPnP finds some pose, and not the right one."""
    method = make("keypoints")
    flat = thick()
    flat = flat._replace(hull=flat.hull * torch.tensor([1.0, 1.0, 1e-4]), name="card")
    with pytest.raises(UserError, match="model=keypoints: card is flat"):
        method.set_object(flat)
    method.set_object(thick())


def make(kind: str, seed: int = 0) -> Hypotheses:
    torch.manual_seed(seed)
    pieces = (
        FromProposals(),
        Constant(0.02),
        CurrentLikelihood(),
        NoResampling(),
        Identity(),
        Argmax(),
    )
    base = {
        "filter": ParticleFilter(64, 1, *pieces, NoRefine()),
        "optimizer": partial(torch.optim.AdamW, lr=3e-3),
    }
    method: Hypotheses
    if kind == "dense_coordinates":
        net = ObjectCoordinateNet(WIDTHS, fragments=16)
        method = DenseCoordinates(net, loss=CoordinateLoss(), **base)
    else:
        method = Keypoints(HeatmapNet(WIDTHS, 32), loss=Heatmaps(1.0), **base)
    method.set_object(thick())
    return method


def train(method: Hypotheses, steps: int) -> Hypotheses:
    optimizer = torch.optim.AdamW(method.parameters(), 3e-3)
    method.train()
    for step in range(steps):
        losses = method.training_losses(scenes(8, seed=step), torch.Generator())
        optimizer.zero_grad()
        losses["loss"].mean().backward()
        optimizer.step()
    return method.eval()


@torch.no_grad()
def run(method: Hypotheses, count: int = 16, seed: int = 10_000) -> tuple[Trace, Tensor]:
    """Return traces of scenes that no training saw, and the estimates' ADD [m]."""
    batch = scenes(count, seed=seed)
    trace = method.eval().filter(batch, method, torch.Generator().manual_seed(0))
    return trace, add(trace.belief.best, batch.camera_from_object, method.object_model.points)


@pytest.mark.parametrize(("kind", "steps", "most"), [
    ("dense_coordinates", 60, 0.04),
    ("keypoints", 60, 0.06),
])  # fmt: skip
@pytest.mark.slow
def test_a_short_training_finds_the_pose(kind: str, steps: int, most: float) -> None:
    before, (trace, after) = run(make(kind))[1], run(train(make(kind), steps))
    assert before.median() > 0.1
    assert after.median() < most
    # the score is the logarithm of a share, and tells the right from the untrained
    assert trace.belief.score.exp().median() > 0.4
    assert (trace.belief.score <= 0).all()
    torch.testing.assert_close(trace.belief.log_weights.logsumexp(1), torch.zeros(16))


@pytest.mark.parametrize("kind", ["dense_coordinates", "keypoints"])
def test_neither_mask_nor_truth_is_used_and_a_seed_repeats(kind: str) -> None:
    method, batch = make(kind).eval(), scenes(3, seed=30_000)
    blind = batch._replace(
        mask=torch.zeros_like(batch.mask), camera_from_object=torch.eye(4).expand(3, 4, 4)
    )
    with torch.no_grad():
        a, b, other = (
            method.filter(x, method, torch.Generator().manual_seed(seed)).belief
            for x, seed in ((batch, 0), (blind, 0), (batch, 1))
        )
    assert torch.equal(a.poses, b.poses)
    assert torch.equal(a.best, b.best)
    assert not torch.equal(a.poses, other.poses)


@pytest.mark.parametrize("kind", ["dense_coordinates", "keypoints"])
def test_the_estimate_is_the_hypothesis_of_highest_score(kind: str) -> None:
    method = make(kind)
    trace, _ = run(method, 4)
    score = method.score(trace.encoding, trace.belief.poses)
    torch.testing.assert_close(trace.belief.score, score.clamp_min(1e-6).log().amax(1))
    share = score.clamp_min(1e-6)
    torch.testing.assert_close(trace.belief.log_weights.exp(), share / share.sum(1, keepdim=True))


class Planted(nn.Module):
    """Maps of true poses, some of them wiped out or shown elsewhere, too."""

    def __init__(self, pixels: Tensor, hidden: int = 0, ghosts: float = 0.0) -> None:
        super().__init__()
        maps = self.draw(pixels) + ghosts * self.draw(pixels + torch.tensor([16.0, 12.0]))
        maps[:, :hidden] = 0
        self.logits = maps.clamp(1e-4, 1 - 1e-4).logit()

    @staticmethod
    def draw(pixels: Tensor) -> Tensor:
        there = torch.ones(pixels.shape[:2], dtype=torch.bool)
        return draw_gaussians(pixels, there, 12, 16, STRIDE, 1.0)

    def forward(self, *_: Tensor) -> Tensor:
        return self.logits


@pytest.mark.parametrize(("hidden", "ghosts"), [(0, 0.0), (3, 0.0), (0, 0.6)])
def test_planted_maps_give_back_the_pose(hidden: int, ghosts: float) -> None:
    method, batch = make("keypoints").eval(), scenes(16, seed=1)
    assert isinstance(method, Keypoints)
    truth = batch.camera_from_object
    keypoints = method.encode(batch).keypoints
    pixels = project_keypoints(truth[:, None], keypoints, batch.intrinsics)[0][:, 0]
    method.net = Planted(pixels, hidden, ghosts)  # type: ignore[assignment]
    trace = method.filter(batch, method, torch.Generator().manual_seed(0))
    assert add(trace.belief.best, truth, method.object_model.points).median() < 0.02
    right = method.score(trace.encoding, truth[:, None])
    assert (trace.belief.score.exp() > right[:, 0] - 0.05).all()


def test_maps_that_are_right_cost_nothing_and_a_flipped_one_much() -> None:
    method, batch = make("keypoints"), scenes(4, seed=1)
    keypoints = method.encode(batch).keypoints
    truth = batch.camera_from_object[:, None]
    pixels = project_keypoints(truth, keypoints, batch.intrinsics)[0][:, 0]
    losses = []
    for logits in (Planted(pixels).logits, Planted(pixels.flip(1)).logits):
        encoding = method.encode(batch)._replace(logits=logits)
        empty = Trace((), (), (), None, encoding=encoding)  # type: ignore[arg-type]
        losses.append(method.loss(empty, batch, method.object_model))
    assert losses[0].max() < 0.1
    assert losses[1].min() > 3


def test_an_image_without_depth_is_refused_where_depth_is_needed() -> None:
    batch = scenes(2)._replace(depth=torch.zeros(2, 1, 48, 64))
    with pytest.raises(UserError, match="so few pixels of an image have depth"):
        make("dense_coordinates").eval().predict_step(batch, 0)
    assert make("keypoints").eval().predict_step(batch, 0).belief.best.isfinite().all()
