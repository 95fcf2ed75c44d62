"""Distributions of poses that are known exactly: their density, and draws."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from posefilter.geometry.pose import make_pose, move_about, origin_of, rotation_of
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import exp_so3, random_rotation

CENTER = torch.zeros(3).double()


class Posterior(NamedTuple):
    """A distribution of poses that is known exactly."""

    log_density: Callable[[Tensor], Tensor]  # (M, 4, 4) -> (M,), in the measure of Belief
    draw: Callable[[int, Generator], Tensor]  # -> (M, 4, 4)
    middle: Tensor  # (4, 4)
    covariance: Tensor | None = None  # (6, 6) of twists, where it says all
    mass: float | None = None  # of the mode at `middle`, where there is another


def normalize(covariance: Tensor) -> Tensor:
    """Return the correlations of a covariance."""
    deviation = covariance.diagonal().sqrt()
    return covariance / deviation[:, None] / deviation


def make_middle(seed: int = 0) -> Tensor:
    """Return a pose half a meter ahead."""
    g = torch.Generator().manual_seed(seed)
    return make_pose(random_rotation(generator=g), torch.tensor([0.05, -0.02, 0.5])).double()


def make_gaussian(seed: int = 0, middle: Tensor | None = None) -> Posterior:
    """Return twists that are normal.

    Standard deviations are 2 to 10 mm, and 1.5 to 6 degrees.  Correlations are those of a Wishart
    matrix with 9 degrees of freedom.
    """
    pose = make_middle(seed) if middle is None else middle
    g = torch.Generator().manual_seed(100 + seed)
    square = torch.randn(6, 9, generator=g).double()
    least = torch.tensor([0.002] * 3 + [0.025] * 3).double()
    most = torch.tensor([0.01] * 3 + [0.1] * 3).double()
    scale = torch.diag(least * (most / least) ** torch.rand(6, generator=g).double())
    covariance = scale @ normalize(square @ square.T) @ scale
    root = torch.linalg.cholesky(covariance)
    normal = torch.distributions.MultivariateNormal(torch.zeros(6).double(), scale_tril=root)

    def log_density(poses: Tensor) -> Tensor:
        twist = twist_between(pose, poses, CENTER)
        half = torch.sinc(twist[:, 3:].norm(dim=1) / (2 * math.pi))
        return normal.log_prob(twist) - 2 * half.log() + math.log(8)

    def draw(count: int, g: Generator) -> Tensor:
        noise = torch.randn(count, 6, generator=g, dtype=torch.float64) @ root.T
        return move_about(pose.expand(count, 4, 4), noise, CENTER)

    return Posterior(log_density, draw, pose, covariance)


def make_modes(seed: int = 0, alike: bool = True) -> Posterior:
    """Return two Gaussians, the first with a mass of 0.2 to 0.8.

    They are 3 cm apart, and a half turn about the x axis, or with odd seeds any turn.  Both have
    one shape where they are `alike`, else the second has its own, and so another volume.
    """
    g = torch.Generator().manual_seed(200 + seed)
    pose = make_middle(seed)
    other = pose @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    if seed % 2:
        other[:3, :3] = random_rotation(generator=g).double()
    other[0, 3] += 0.03
    mass = 0.2 + 0.6 * float(torch.rand((), generator=g))
    parts = (make_gaussian(seed, pose), make_gaussian(seed + 50 * (not alike), other))
    masses = (mass, 1 - mass)

    def log_density(poses: Tensor) -> Tensor:
        each = [
            one.log_density(poses) + math.log(mass) for one, mass in zip(parts, masses, strict=True)
        ]
        return torch.stack(each).logsumexp(0)

    def draw(count: int, g: Generator) -> Tensor:
        first = torch.rand(count, generator=g) < masses[0]
        both = [one.draw(count, g) for one in parts]
        return torch.where(first[:, None, None], both[0], both[1])

    return Posterior(log_density, draw, pose, mass=mass)


def make_ring(seed: int = 0) -> Posterior:
    """Return poses of a round object: any turn about its z axis, which tilts by little.

    The position's standard deviation is 3 to 8 mm, that of the tilt 2 to 6 degrees.
    """
    pose = make_middle(seed)
    wide = torch.rand(2, generator=torch.Generator().manual_seed(300 + seed)).tolist()
    shift, tilt = 0.003 + 0.005 * wide[0], 0.035 + 0.07 * wide[1]
    grid = torch.linspace(0, math.pi, 100_001).double()
    share = grid.sin() * (-0.5 * (grid / tilt) ** 2).exp()
    # of SO(3), pi^2 in all, the share with a tilt in da is sin(a) da / 2
    total = math.pi**2 * float(torch.trapezoid(share, grid)) / 2

    def log_density(poses: Tensor) -> Tensor:
        cos = (rotation_of(pose)[:, 2] * rotation_of(poses)[..., 2]).sum(-1).clamp(-1, 1)
        far = (origin_of(poses, CENTER) - origin_of(pose, CENTER)).square().sum(-1)
        place = -0.5 * far / shift**2 - 3 * math.log(shift * math.sqrt(2 * math.pi))
        return place - 0.5 * (cos.acos() / tilt).square() - math.log(total)

    def draw(count: int, g: Generator) -> Tensor:
        cumulated = share.cumsum(0) / share.sum()
        angle = grid[torch.searchsorted(cumulated, torch.rand(count, generator=g).double())]
        about, spin = (2 * math.pi * torch.rand(2, count, generator=g)).double()
        o = torch.zeros_like(angle)
        lean = exp_so3(torch.stack([angle * about.cos(), angle * about.sin(), o], -1))
        turn = rotation_of(pose) @ lean @ exp_so3(torch.stack([o, o, spin], -1))
        noise = shift * torch.randn(count, 3, generator=g).double()
        return make_pose(turn, pose[:3, 3] + noise)

    return Posterior(log_density, draw, pose)
