"""A small run of a filter on two images, with every number known: for the tests of the 3-D view."""

import math

import torch

from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import random_rotation
from posefilter.types import Batch, BeliefBatch, ObjectModel, ParticleOutput, Particles, Step, Trace

H, W, STEPS, FIRST, N = 6, 8, 3, 50, 40
SHARES = (0.7, 0.25, 0.045, 0.005)  # of the belief's hypotheses


def box() -> ObjectModel:
    """Return a box of 6 x 16 x 21 cm that stands on its frame's origin."""
    hull = torch.tensor(
        [[x, y, z] for x in (-0.03, 0.03) for y in (-0.08, 0.08) for z in (0.0, 0.21)]
    )
    return ObjectModel(
        "box", hull, torch.tensor([0.0, 0.0, 0.105]), 0.136, 0.27, torch.eye(4)[None], hull
    )


def two_images() -> Batch:
    """Return two images of noise, a quarter of their depth unknown."""
    g = torch.Generator().manual_seed(0)
    depth = 0.5 + torch.rand(2, 1, H, W, generator=g)
    depth[torch.rand(2, 1, H, W, generator=g) < 0.25] = 0
    K = torch.tensor([[10.0, 0, 3.2], [0, 11.0, 2.9], [0, 0, 1]]).expand(2, 3, 3)
    zeros, blank = torch.zeros(2, dtype=torch.int64), torch.zeros(2, 1, H, W, dtype=torch.bool)
    rgb = torch.rand(2, 3, H, W, generator=g)
    return Batch(rgb, depth, blank, K, torch.eye(4).expand(2, 4, 4), zeros, zeros, torch.ones(2))


def hypotheses_of_belief() -> torch.Tensor:
    """Return the poses that the belief about the second image is drawn from, (4, 4, 4), far
    apart.
    """
    g = torch.Generator().manual_seed(1)
    place = torch.tensor([[0.0, 0, 0.8], [0.3, 0, 0.8], [0, 0.3, 0.9], [-0.3, 0, 1.0]])
    return make_pose(random_rotation(4, generator=g), place)


def run(pixels: bool) -> Trace:
    """Return a run of three steps, of particles that are pixels or poses; the estimate is 4 mm off
    the heaviest mode.
    """
    g = torch.Generator().manual_seed(2)
    history, outputs, steps = [], [], []
    for number in range(STEPS):
        count = N if number else FIRST
        place = torch.rand(2, count, 3, generator=g) * 0.2 + torch.tensor([0, 0, 0.8])
        poses = make_pose(random_rotation(2, count, generator=g), place)
        state = (
            torch.rand(2, count, 2, generator=g) * torch.tensor([W - 1.0, H - 1.0])
            if pixels
            else poses
        )
        log_weights = torch.log_softmax(torch.randn(2, count, generator=g), 1)
        history.append(
            Particles(
                state,
                torch.zeros(2, count, 0),
                log_weights,
                torch.zeros(2, count, dtype=torch.int64),
            )
        )
        outputs.append(
            ParticleOutput(log_weights, torch.zeros(2, count, 2), poses, torch.zeros(2, count, 0))
        )
        sigma = torch.tensor(0.04 / 2**number)
        steps.append(Step(number, STEPS, sigma.expand(2) if number == 1 else sigma))
    near = torch.randn(2, N, 6, generator=g) * torch.tensor([0.0005] * 3 + [0.004] * 3)
    center = box().center
    which = torch.arange(N) % 4
    poses = move_about(hypotheses_of_belief()[which].expand(2, N, 4, 4), near, center)
    weights = torch.tensor(SHARES)[which] * 4 / N
    best = move_about(
        hypotheses_of_belief()[:1].expand(2, 4, 4), torch.tensor([0.004, 0, 0, 0, 0, 0]), center
    )
    belief = BeliefBatch(poses, weights.log().expand(2, N), best, torch.tensor([0.0, math.pi]))
    return Trace(tuple(history), tuple(outputs), tuple(steps), belief)
