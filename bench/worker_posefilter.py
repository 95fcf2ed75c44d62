"""posefilter's filter core on the task of filter_task.py."""

import math
import platform
import time
from typing import Any

import filter_task as task
import torch
from peer_process import serve
from torch import Generator, Tensor

from posefilter.filters.estimate import Argmax
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import SequentialBayes
from posefilter.filters.schedule import Constant
from posefilter.geometry.spaces import PoseSpace
from posefilter.memory import keep_freed_memory
from posefilter.types import Batch, ParticleOutput, Particles, Step


class Observed:
    """The method: its likelihood is that of the task."""

    space = PoseSpace((0.0, 0.0, 0.0), task.RADIUS)
    latent_width = 0

    def __init__(self, steps: int) -> None:
        self.seen = [task.observe(step) for step in range(steps)]

    def encode(self, batch: Batch) -> None:
        """Return nothing: there is no image."""

    def measure(
        self, scene: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Return the log-likelihoods of the particles."""
        state = particles.state
        score = ((1 - state[..., 2, 2]) / task.LEAN).square_()
        for axis, seen in enumerate(self.seen[step.number]):
            score += ((state[..., axis, 3] - seen) / task.NOISE).square_()
        score *= -0.5
        still = state.new_zeros(1, 1, 1).expand(*state.shape[:2], 6)
        return ParticleOutput(score, still, state, particles.latent)


class Around:
    """First states: the walk's noise, wider, about the first observation."""

    def __call__(
        self, batch: Batch, scene: None, method: Observed, particles: int, generator: Generator
    ) -> Tensor:
        """Return states (1, N, 4, 4)."""
        at = torch.eye(4)
        at[:3, 3] = torch.tensor(method.seen[0])
        scale = method.space.noise_scale(torch.tensor(task.START * task.SHIFT))
        noise = torch.randn(1, particles, 6, generator=generator)
        return method.space.move(at.expand(1, particles, 4, 4), scale * noise)


def run(particles: int, steps: int, seed: int) -> dict[str, Any]:
    """Run the filter once; return its seconds and its log evidence."""
    method: Any = Observed(steps)
    core = ParticleFilter(
        particles,
        steps,
        Around(),
        Constant(task.SHIFT),
        SequentialBayes(),
        Systematic(),
        Gaussian(1.0),
        Argmax(),
        NoRefine(),
    )
    nothing: Any = None
    begun = time.process_time()
    with torch.no_grad():
        trace = core(nothing, method, Generator().manual_seed(seed))
    seconds = time.process_time() - begun
    assert trace.log_evidence is not None
    evidence = float(trace.log_evidence.sum())
    assert math.isfinite(evidence)
    return {"seconds": seconds, "evidence": evidence}


if __name__ == "__main__":
    torch.set_num_threads(torch.get_num_threads())
    keep_freed_memory()
    serve(
        {"versions": f"torch {torch.__version__}, Python {platform.python_version()}"}, {"run": run}
    )
