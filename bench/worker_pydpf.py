"""pydpf's particle filter on the task of filter_task.py, and its resamplers.

Poses are kept in two ways: as matrices (4, 4) that are moved by textbook formulas (posefilter's
reference, `move_about`); and as quaternion and translation in one row of seven numbers, written for
speed.
"""

import platform
import time
from importlib.metadata import version
from typing import Any

import filter_task as task
import pydpf
import torch
from peer_process import serve
from torch import Generator, Tensor

from posefilter.geometry.pose import move_about


class Matrices:
    """States (B, N, 4, 4), moved by textbook formulas."""

    @staticmethod
    def start(at: Tensor, count: int) -> Tensor:
        """Return states at a translation (B, 3), without a turn.  -> (B, count, 4, 4)."""
        state = torch.eye(4).repeat(len(at), count, 1, 1)
        state[..., :3, 3] = at[:, None]
        return state

    @staticmethod
    def move(state: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
        """Return states moved by (B, N, 3) [m] and (B, N, 3) [rad]."""
        return move_about(state, torch.cat([shift, turn], dim=-1), shift.new_zeros(3))

    @staticmethod
    def read(state: Tensor) -> tuple[Tensor, Tensor]:
        """Return translations (B, N, 3) and how far the third axis leans, (B, N)."""
        return state[..., :3, 3], 1 - state[..., 2, 2]


class Quaternions:
    """States (B, N, 7): unit quaternion (w, x, y, z) and translation."""

    @staticmethod
    def start(at: Tensor, count: int) -> Tensor:
        """Return states at a translation (B, 3), without a turn.  -> (B, count, 7)."""
        state = at.new_zeros(len(at), count, 7)
        state[..., 0] = 1
        state[..., 4:] = at[:, None]
        return state

    @staticmethod
    def move(state: Tensor, shift: Tensor, turn: Tensor) -> Tensor:
        """Return states moved by (B, N, 3) [m] and (B, N, 3) [rad]."""
        x, y, z = turn.unbind(-1)
        angle = (x * x + y * y + z * z).sqrt_().clamp_min_(task.SMALL)
        half = 0.5 * angle
        scale = half.sin() / angle
        x, y, z = x * scale, y * scale, z * scale
        w = half.cos()
        a, b, c, d, *at = state.unbind(-1)
        moved = [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ]
        moved += [t + s for t, s in zip(at, shift.unbind(-1), strict=True)]
        return torch.stack(moved, dim=-1)

    @staticmethod
    def read(state: Tensor) -> tuple[Tensor, Tensor]:
        """Return translations (B, N, 3) and how far the third axis leans, (B, N)."""
        b, c = state[..., 1], state[..., 2]
        return state[..., 4:], 2 * (b * b + c * c)


WAYS = {"matrices": Matrices, "quaternions": Quaternions}


class Prior(pydpf.Module):
    """The first states."""

    def __init__(self, way: Any, at: Tensor, generator: Generator) -> None:
        super().__init__()
        self.way, self.at, self.generator = way, at, generator

    def sample(self, batch_size: int, n_particles: int, **data: Any) -> Tensor:
        """Draw states."""
        size = (batch_size, n_particles, 3)
        noise = [task.START * torch.randn(size, generator=self.generator) for _ in range(2)]
        state = self.way.start(self.at.expand(batch_size, 3), n_particles)
        return self.way.move(state, task.SHIFT * noise[0], task.TURN * noise[1])


class Walk(pydpf.Module):
    """The motion."""

    def __init__(self, way: Any, generator: Generator) -> None:
        super().__init__()
        self.way, self.generator = way, generator

    def sample(self, prev_state: Tensor, **data: Any) -> Tensor:
        """Draw moved states."""
        size = (*prev_state.shape[:2], 3)
        shift = task.SHIFT * torch.randn(size, generator=self.generator)
        turn = task.TURN * torch.randn(size, generator=self.generator)
        return self.way.move(prev_state, shift, turn)


class Observed(pydpf.Module):
    """The likelihood."""

    def __init__(self, way: Any) -> None:
        super().__init__()
        self.way = way

    def fitness(self, state: Tensor, observation: Tensor, **data: Any) -> Tensor:
        """Return log-likelihoods (B, N)."""
        at, lean = self.way.read(state)
        score = (lean / task.LEAN).square_()
        for axis in range(3):  # a sum over three neighbors is slow in PyTorch
            score += ((at[..., axis] - observation[:, axis, None]) / task.NOISE).square_()
        return score.mul_(-0.5)


class Evidence(pydpf.Module):
    """What is kept of a step: its log evidence."""

    def forward(self, likelihood: Tensor, **data: Any) -> Tensor:
        """Return it as it came."""
        return likelihood


def run(particles: int, steps: int, seed: int, way: str) -> dict[str, Any]:
    """Run the filter once; return its seconds and its log evidence."""
    generator = Generator().manual_seed(seed)
    seen = torch.tensor([task.observe(step) for step in range(steps)])[:, None]
    poses = WAYS[way]
    model = pydpf.FilteringModel(
        dynamic_model=Walk(poses, generator),
        observation_model=Observed(poses),
        prior_model=Prior(poses, seen[0], generator),
    )
    core = pydpf.ParticleFilter(pydpf.SystematicResampler(generator), model)
    begun = time.process_time()
    with torch.no_grad():
        told = core(particles, steps - 1, Evidence(), seen)
    seconds = time.process_time() - begun
    return {"seconds": seconds, "evidence": float(told.sum())}


def resample(scheme: str, log_weights: list[list[float]], seed: int) -> dict[str, Any]:
    """Return the ancestors, and the children's log weights, of a scheme."""
    weights = torch.tensor(log_weights, dtype=torch.float64)
    generator = Generator().manual_seed(seed)
    if scheme == "multinomial":
        core: Any = pydpf.MultinomialResampler(generator)
    else:
        core = pydpf.SystematicResampler(generator)
    if scheme == "soft":
        core = pydpf.SoftResampler(0.5, core, torch.device("cpu"))
    state = torch.arange(weights.shape[1], dtype=torch.float64).expand(weights.shape)[..., None]
    children, new = core(state, weights)
    return {"ancestors": children[..., 0].long().tolist(), "log_weights": new.tolist()}


if __name__ == "__main__":
    found = f"pydpf {version('pydpf')}, torch {torch.__version__}, Python "
    serve({"versions": found + platform.python_version()}, {"run": run, "resample": resample})
