"""A tiny trace whose every number is chosen by hand."""

from collections.abc import Callable

import pytest
import torch

from posefilter.geometry.camera import intrinsics
from posefilter.types import (
    Batch,
    BeliefBatch,
    Fragments,
    ObjectModel,
    ParticleOutput,
    Particles,
    Step,
    Trace,
)


def eye_pose(*shape: int, z: float = 1.0) -> torch.Tensor:
    pose = torch.eye(4, dtype=torch.float64).expand(*shape, 4, 4).clone()
    pose[..., 2, 3] = z
    return pose


@pytest.fixture
def model() -> ObjectModel:
    points = torch.tensor(
        [[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]], dtype=torch.float64
    )
    return ObjectModel(
        "cross", points, torch.zeros(3, dtype=torch.float64), 0.15, 0.2, torch.eye(4)[None], points
    )


@pytest.fixture
def batch() -> Batch:
    """One image, 20 wide and 10 high; the object covers u 5..8, v 2..5; depth 1 m everywhere."""
    mask = torch.zeros(1, 1, 10, 20, dtype=torch.bool)
    mask[0, 0, 2:6, 5:9] = True
    rgb, depth = (
        torch.zeros(1, 3, 10, 20, dtype=torch.float64),
        torch.ones(1, 1, 10, 20, dtype=torch.float64),
    )
    K = intrinsics(100.0, 100.0, 6.5, 3.5)[None].double()
    one = torch.zeros(1, dtype=torch.int64)
    return Batch(rgb, depth, mask, K, eye_pose(1), one, one, torch.ones(1))


@pytest.fixture
def make_trace() -> Callable[..., Trace]:
    """Build a trace from its places (T, N, 2), and of the readings whichever parts a test is
    about.
    """

    def make(
        state: torch.Tensor,
        log_likelihood: torch.Tensor | None = None,
        displacement: torch.Tensor | None = None,
        pose: torch.Tensor | None = None,
        latent: torch.Tensor | None = None,
        fragments: Fragments | None = None,
    ) -> Trace:
        T, N = state.shape[:2]
        empty = torch.zeros(1, N, 0, dtype=torch.float64)
        weights = torch.full((1, N), -torch.log(torch.tensor(float(N))).item(), dtype=torch.float64)
        ancestors = torch.arange(N)[None]
        history, outputs = [], []
        for t in range(T):
            history.append(Particles(state[t : t + 1], empty, weights, ancestors))
            outputs.append(
                ParticleOutput(
                    weights if log_likelihood is None else log_likelihood[t : t + 1],
                    torch.zeros(1, N, 2, dtype=torch.float64)
                    if displacement is None
                    else displacement[t : t + 1],
                    eye_pose(1, N) if pose is None else pose[t : t + 1],
                    empty if latent is None else latent[t : t + 1],
                    fragments,
                )
            )
        belief = BeliefBatch(outputs[-1].pose, weights, outputs[-1].pose[:, 0], weights[:, 0])
        return Trace(
            tuple(history),
            tuple(outputs),
            tuple(Step(t, T, torch.tensor(0.0)) for t in range(T)),
            belief,
        )

    return make
