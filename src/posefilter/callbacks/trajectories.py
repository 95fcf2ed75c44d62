"""The particles' trajectories over an image: where each stood, and what it saw there."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from posefilter.figures.particles import choose_by_weight, normalize_weights
from posefilter.protocols import Encoding, HasImagePatches
from posefilter.types import Particles, Trace


def trace_lineage(history: Sequence[Particles]) -> Tensor:
    """Return where each particle of the last step, and its ancestors before it, stood.  -> (B, T,
    N, *S).
    """
    last = history[-1]
    rows = torch.arange(len(last.state), device=last.state.device)[:, None]
    index = torch.arange(last.state.shape[1], device=last.state.device).expand(len(last.state), -1)
    path = []
    for particles in reversed(history):
        path.append(particles.state[rows, index])
        index = particles.ancestors[rows, index]
    return torch.stack(path[::-1], dim=1)


def follow_particles(trace: Trace, max_particles: int = 8) -> Tensor:
    """Return the ways of a few particles of one image, chosen by their last weight.  -> (T, n, 2)
    [px].
    """
    chosen = choose_by_weight(normalize_weights(trace.particles[-1]), max_particles).unique()
    return trace_lineage(trace.particles)[0][:, chosen]


def extract_glimpses(method: HasImagePatches, encoding: Encoding, states: Tensor) -> np.ndarray:
    """Return what particles see where they stand in one image, its colors.

    (T, n, 2) [px] -> (T, n, k, k, 3) uint8.
    """
    seen = method.image_patches(encoding, states.flatten(0, 1)[None])[0, :, :3]
    colors = ((seen + 1) / 2).clamp(0, 1).mul(255).round().byte().cpu()
    return colors.unflatten(0, states.shape[:2]).permute(0, 1, 3, 4, 2).numpy()
