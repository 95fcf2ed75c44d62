"""Poses drawn from a density over SE(3), for importance sampling."""

import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import move_about
from posefilter.geometry.pose_density import PoseDensity
from posefilter.geometry.pose_kernels import whiten_kernels


def widen(density: PoseDensity, factor: float) -> PoseDensity:
    """Return the density with kernels that are wider by a factor, turns up to where they would
    wrap round.
    """
    covariance = factor**2 * measure_kernels(density)
    whiten, log_scale = whiten_kernels(covariance)
    return density._replace(whiten=whiten, log_scale=log_scale)


def measure_kernels(density: PoseDensity) -> Tensor:
    """Return the covariances of the kernels' twists.  -> (N, 6, 6) [m^2, m rad, rad^2]."""
    root = torch.linalg.inv(density.whiten)
    return root @ root.mT


def draw_poses(density: PoseDensity, count: int, generator: Generator) -> Tensor:
    """Draw poses from a density's kernels, not from its background.

    Of symmetric objects only the copies of the kernels themselves are drawn.

    Args:
        density: Of poses.
        count: Number of poses.
        generator: Source of randomness, on the density's device.

    Returns:
        (count, 4, 4) camera_from_object [m], float64.
    """
    device, dtype = density.center.device, density.center.dtype
    # systematic: one uniform number decides where all strata are hit
    start = torch.rand((), generator=generator, device=device, dtype=dtype)
    position = (torch.arange(count, device=device, dtype=dtype) + start) / count
    kernel = torch.searchsorted(density.log_weights.exp().cumsum(0), position)
    kernel = kernel.clamp(max=len(density.log_weights) - 1)
    noise = torch.randn(count, 6, generator=generator, device=device, dtype=dtype)
    twist = torch.linalg.solve_triangular(density.whiten[kernel], noise[..., None], upper=False)
    return move_about(density.matrices[kernel], twist[..., 0], density.center)
