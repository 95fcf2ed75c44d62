"""Contrast and the paper's regression against values worked by hand."""

import math

import pytest
import torch
from tests.models.toy import scenes, square

from posefilter.filters.loop import make_particles
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.labels.paper_points import PaperPoints
from posefilter.losses.contrastive import Contrastive, pose_distance
from posefilter.losses.regression import Regression
from posefilter.metrics.errors import add
from posefilter.models.candidate_samplers import one_step_trace
from posefilter.types import Batch, ObjectModel, ParticleOutput, Trace

MODEL = square()


def trace(poses: torch.Tensor, scores: torch.Tensor, sigma: float) -> Trace:
    particles = make_particles(poses, 0)
    output = ParticleOutput(scores, torch.zeros(*scores.shape, 6), poses, particles.latent)
    return one_step_trace(particles, output, torch.full((len(poses),), sigma))


def candidates(batch: Batch, shifts: list[float]) -> torch.Tensor:
    moves = torch.stack([make_pose(torch.eye(3), torch.tensor([s, 0.0, 0.0])) for s in shifts])
    return moves @ batch.camera_from_object[:, None]


def test_two_candidates_by_hand() -> None:
    batch = scenes(1)
    poses = candidates(batch, [0.0, 0.02])
    scores = torch.tensor([[1.0, 0.5]])
    p = 1 / (1 + math.exp(-0.5 * (0.02 / 0.01) ** 2))  # target on the truth
    q = 1 / (1 + math.exp(-0.5))
    by_hand = p * math.log(p / q) + (1 - p) * math.log((1 - p) / (1 - q))
    assert Contrastive()(trace(poses, scores, 0.01), batch, MODEL).item() == pytest.approx(
        by_hand, rel=1e-4
    )


def test_the_divergence_vanishes_at_the_target_alone() -> None:
    batch = scenes(2)
    poses = candidates(batch, [0.0, 0.01, 0.03])
    best = -0.5 * (torch.tensor([0.0, 0.01, 0.03]) / 0.02) ** 2
    right = Contrastive()(trace(poses, best.expand(2, 3) + 7.0, 0.02), batch, MODEL)
    assert right.abs().max() < 1e-5
    assert Contrastive()(trace(poses, best.flip(0).expand(2, 3), 0.02), batch, MODEL).min() > 0.1


def test_images_without_the_object_teach_nothing() -> None:
    batch = scenes(2)
    batch.mask[0] = False
    value = Contrastive()(
        trace(candidates(batch, [0.0, 0.1]), torch.tensor([[0.0, 9.0], [0.0, 9.0]]), 0.01),
        batch,
        MODEL,
    )
    assert value[0] == 0
    assert value[1] > 1


def test_distance_is_add_and_minds_symmetries() -> None:
    batch = scenes(3)
    poses = candidates(batch, [0.0, 0.015])
    plain = pose_distance(poses, batch.camera_from_object, MODEL)
    torch.testing.assert_close(
        plain[:, 1],
        add(poses[:, 1], batch.camera_from_object, MODEL.points).float(),
        atol=1e-5,
        rtol=0,
    )
    half = make_pose(exp_so3(torch.tensor([0.0, 0.0, math.pi])), torch.zeros(3))
    turned = (batch.camera_from_object @ half)[:, None]
    twofold: ObjectModel = MODEL._replace(symmetries=torch.stack([torch.eye(4), half]))
    assert pose_distance(turned, batch.camera_from_object, MODEL).min() > 0.05
    assert pose_distance(turned, batch.camera_from_object, twofold).max() < 1e-5


def test_the_papers_labels() -> None:
    offset = torch.tensor([-0.5, -0.011, -0.009, 0.009, 0.011, -0.009, 0.009, 0.02])
    own = torch.tensor([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    state = torch.stack([torch.zeros(8), torch.zeros(8), offset, own], -1)[None]
    particles = make_particles(state, 0)
    output = ParticleOutput(
        torch.zeros(1, 8), torch.zeros(1, 8, 6), torch.eye(4).expand(1, 8, 4, 4), particles.latent
    )
    run = one_step_trace(particles, output, torch.tensor([0.01]))
    label = PaperPoints()(run, scenes(1), MODEL)
    assert label[0, 0].tolist() == [0, 0, 100, 100, -100, 0, 0, -100]
    weighted = run._replace(
        particles=(
            particles._replace(
                log_weights=torch.log(torch.tensor([[1.0] + [0.0] * 6 + [1.0]]) / 2)
            ),
        )
    )
    assert Regression(PaperPoints())(weighted, scenes(1), MODEL).item() == pytest.approx(0.5)
