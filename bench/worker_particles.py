"""The library `particles` on the task of filter_task.py: NumPy, double precision.

Its systematic resampling is compiled by numba. Poses are rows of a quaternion (w, x, y, z) and a
translation.
"""

import platform
import time
from importlib.metadata import version
from typing import Any

import filter_task as task
import numpy as np
import particles
from peer_process import serve


def move(state: np.ndarray, shift: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Return states (N, 7) moved by (3, N) [m] and (3, N) [rad]."""
    angle = np.maximum(np.sqrt((turn * turn).sum(0)), task.SMALL)
    half = 0.5 * angle
    x, y, z = turn * (np.sin(half) / angle)
    w = np.cos(half)
    a, b, c, d = state[:, :4].T
    out = np.empty_like(state)
    out[:, 0] = a * w - b * x - c * y - d * z
    out[:, 1] = a * x + b * w + c * z - d * y
    out[:, 2] = a * y - b * z + c * w + d * x
    out[:, 3] = a * z + b * y - c * x + d * w
    out[:, 4:] = state[:, 4:] + shift.T
    return out


class Walk(particles.FeynmanKac):
    """The bootstrap filter of the task."""

    def __init__(self, steps: int, seed: int) -> None:
        super().__init__(steps)
        self.draw = np.random.default_rng(seed)
        self.seen = np.array([task.observe(step) for step in range(steps)])

    def M0(self, N: int) -> np.ndarray:  # noqa: N802
        """Draw the first states."""
        state = np.zeros((N, 7))
        state[:, 0], state[:, 4:] = 1, self.seen[0]
        noise = task.START * self.draw.standard_normal((2, 3, N))
        return move(state, task.SHIFT * noise[0], task.TURN * noise[1])

    def M(self, t: int, xp: np.ndarray) -> np.ndarray:  # noqa: N802
        """Draw moved states."""
        noise = self.draw.standard_normal((2, 3, len(xp)))
        return move(xp, task.SHIFT * noise[0], task.TURN * noise[1])

    def logG(self, t: int, xp: np.ndarray, x: np.ndarray) -> np.ndarray:  # noqa: N802
        """Return log-likelihoods."""
        lean = 2 * (x[:, 1] ** 2 + x[:, 2] ** 2) / task.LEAN
        score = lean * lean
        for axis in range(3):
            apart = (x[:, 4 + axis] - self.seen[t, axis]) / task.NOISE
            score += apart * apart
        return -0.5 * score


def run(particles_: int, steps: int, seed: int) -> dict[str, Any]:
    """Run the filter once; return its seconds and its log evidence."""
    np.random.seed(seed)  # noqa: NPY002  the library's own draws
    core = particles.SMC(
        fk=Walk(steps, seed), N=particles_, resampling="systematic", ESSrmin=1.0, collect="off"
    )
    begun = time.process_time()
    core.run()
    return {"seconds": time.process_time() - begun, "evidence": float(core.logLt)}


if __name__ == "__main__":
    found = f"particles {version('particles')}, numpy {np.__version__}, Python "
    serve(
        {"versions": found + platform.python_version()},
        {"run": lambda particles, steps, seed: run(particles, steps, seed)},
    )
