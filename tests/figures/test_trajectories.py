"""Trajectories: who stood where, and saw what."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from posefilter.figures.trajectories import extract_glimpses, follow_particles, trace_lineage
from posefilter.nets.glimpse import IntegerCut
from posefilter.types import BeliefBatch, ParticleOutput, Particles, Step, Trace


def test_a_trajectory_is_a_line_of_ancestors() -> None:
    def particles(x: list[float], ancestors: list[int]) -> Particles:
        state = torch.tensor(x)[None, :, None].expand(1, -1, 2)
        return Particles(state, torch.zeros(1, 3, 0), torch.zeros(1, 3), torch.tensor([ancestors]))

    history = [
        particles([0.0, 10.0, 20.0], [0, 1, 2]),
        particles([11.0, 12.0, 21.0], [1, 1, 2]),
        particles([22.0, 13.0, 14.0], [2, 0, 1]),
    ]
    assert trace_lineage(history)[0, :, :, 0].T.tolist() == [
        [20.0, 21.0, 22.0],
        [10.0, 11.0, 13.0],
        [10.0, 12.0, 14.0],
    ]


def test_the_heaviest_are_followed_and_what_they_saw_is_what_is_there() -> None:
    state = torch.tensor([[[2.0, 3.0], [10.0, 5.0], [20.0, 8.0]]])
    weights = torch.tensor([[0.05, 0.05, 0.9]]).log()
    particles = Particles(state, torch.zeros(1, 3, 0), weights, torch.tensor([[0, 1, 2]]))
    output = ParticleOutput(
        weights, torch.zeros(1, 3, 2), torch.eye(4).expand(1, 3, 4, 4), torch.zeros(1, 3, 0)
    )
    belief = BeliefBatch(output.pose, weights, output.pose[:, 0], torch.zeros(1))
    trace = Trace(
        (particles, particles),
        (output,) * 2,
        tuple(Step(t, 2, torch.tensor(1.0)) for t in range(2)),
        belief,
    )
    states = follow_particles(trace, max_particles=2)
    assert states.tolist() == [[[20.0, 8.0]]] * 2
    image = torch.rand(1, 4, 16, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
    method: Any = SimpleNamespace(
        image_patches=lambda encoding, state: IntegerCut(3)(encoding.image, state)
    )
    encoding: Any = SimpleNamespace(image=image)
    seen = extract_glimpses(method, encoding, states)
    assert seen.shape == (2, 1, 3, 3, 3)
    there = (image[0, :3, 7:10, 19:22].permute(1, 2, 0).numpy() + 1) / 2 * 255
    assert np.abs(seen[1, 0] - there).max() <= 0.5 + 1e-3
