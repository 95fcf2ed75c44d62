"""Compare the filter's belief with posteriors that are known exactly.

    python bench/toy_posteriors.py [--particles 1000] [--runs 4] [--truths 400] [--solids]

Posteriors on SE(3), each with an exact density and exact draws: a Gaussian in which shifts and
turns go together, two modes of mass 0.7 and 0.3, and a ring, as of an object that is round.  The
filter starts with any rotation and within 10 cm, and is annealed as pose_pf is.  `search` is its
way to weight (`filter/reweight=current_likelihood`), which reads the likelihood at every step;
`tempered` counts it once (`likelihood_ratio`); `drawn anew` is that with a last pass of importance
sampling (posefilter.filters.importance).  Truths are drawn from the posterior; `gap` is the mean
log density that the exact posterior has at them less that of the belief, over runs and truths.
`correlation` is the largest error of a correlation between a shift and a turn, of the belief that
is the mean over runs (of the Gaussian alone, the others having none that is defined).

With --solids: likelihoods of symmetric solids, whose belief is not told the symmetries.  Recall is
the share of the equivalent poses with a mode within 10 degrees and 2 cm, precision the share of the
modes (of a weight above 0.2 %) that are so near one.
"""

import argparse
import itertools
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Generator, Tensor

from posefilter.belief import Belief
from posefilter.filters.estimate import Argmax
from posefilter.filters.importance import ImportanceSampling
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import NoRefine
from posefilter.filters.resample import Systematic
from posefilter.filters.reweight import Annealed, TemperedSMC
from posefilter.filters.schedule import Geometric
from posefilter.geometry.pose import make_pose, move_about, origin_of, rotation_of
from posefilter.geometry.pose_statistics import twist_between
from posefilter.geometry.rotation import angle_between, exp_so3, random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.types import ParticleOutput, Particles, Step

CENTER = torch.zeros(3).double()
RADIUS = 0.1  # [m]
FIRST, LAST, STEPS = 0.1, 0.005, 16  # [m] noise levels


class Posterior(NamedTuple):
    """A distribution of poses that is known exactly."""

    log_density: Callable[[Tensor], Tensor]  # (M, 4, 4) -> (M,), in the measure of Belief
    draw: Callable[[int, Generator], Tensor]  # -> (M, 4, 4)
    middle: Tensor  # (4, 4)
    covariance: Tensor | None = None  # (6, 6) of twists, where it says all


class Toy:
    """A method whose log-likelihood is a posterior's log density, over the square of the noise
    level.
    """

    space = PoseSpace((0.0, 0.0, 0.0), RADIUS)
    latent_width = 0

    def __init__(self, posterior: Posterior) -> None:
        self.posterior = posterior

    def encode(self, batch: Any) -> None:
        """Return nothing: there is no image."""
        return

    def measure(
        self, scene: None, particles: Particles, step: Step, generator: Generator
    ) -> ParticleOutput:
        """Score poses; at the last step as they are."""
        score = (LAST / float(step.sigma)) ** 2 * self.evaluate(particles.state)
        still = torch.zeros(*score.shape, 6).double()
        return ParticleOutput(score, still, particles.state, particles.latent)

    def score_poses(
        self, scene: None, poses: Tensor, sigma: float, generator: Generator, pixels: int
    ) -> Tensor:
        """Score poses as they are."""
        return self.evaluate(poses)

    def evaluate(self, poses: Tensor) -> Tensor:
        """Return the log density of (1, N) poses."""
        return self.posterior.log_density(poses[0])[None]


def start(batch: Any, scene: None, method: Toy, count: int, generator: Generator) -> Tensor:
    """Draw any rotation, and positions within 10 cm."""
    turn = random_rotation(1, count, generator=generator).double()
    shift = 0.2 * torch.rand(1, count, 3, generator=generator).double() - 0.1
    return make_pose(turn, method.posterior.middle[:3, 3] + shift)


def run(posterior: Posterior, particles: int, seed: int, way: str = "drawn anew") -> Belief:
    """Run the filter in one of `WAYS`, and return its belief."""
    filter = ParticleFilter(
        particles,
        STEPS,
        initialize=start,
        schedule=Geometric(FIRST, LAST),
        reweight=Annealed() if way == "search" else TemperedSMC(),
        resample=Systematic(),
        propagate=Gaussian(0.5),
        estimate=Argmax(),
        refine=ImportanceSampling(particles, 3) if way == "drawn anew" else NoRefine(),
        first_particles=8 * particles,
    )
    generator = torch.Generator().manual_seed(seed)
    found = filter(None, Toy(posterior), generator).belief  # type: ignore[arg-type]
    weights = found.log_weights[0].double().exp().numpy()
    poses = found.poses[0].double().numpy()
    return Belief(poses, weights / weights.sum(), CENTER.numpy(), RADIUS, 2 * RADIUS)


def make_middle(seed: int = 0) -> Tensor:
    """Return a pose half a meter ahead."""
    g = torch.Generator().manual_seed(seed)
    return make_pose(random_rotation(generator=g), torch.tensor([0.05, -0.02, 0.5])).double()


def make_gaussian(middle: Tensor | None = None) -> Posterior:
    """Return twists that are normal; of the correlations, 0.8 is of x with the turn about y."""
    pose = make_middle() if middle is None else middle
    mix = torch.eye(6).double()
    for i, j, value in ((0, 4, 0.8), (1, 2, -0.5), (2, 3, 0.4)):
        mix[i, j] = mix[j, i] = value
    scale = torch.diag(torch.tensor([0.004, 0.003, 0.01, 0.03, 0.1, 0.05]).double())
    covariance = scale @ mix @ scale
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


def make_modes() -> Posterior:
    """Return two Gaussians with masses of 0.7 and 0.3, a half turn and 3 cm apart."""
    half = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])).double()
    other = make_middle() @ half
    other[0, 3] += 0.03
    parts, masses = (make_gaussian(), make_gaussian(other)), (0.7, 0.3)

    def log_density(poses: Tensor) -> Tensor:
        each = [
            one.log_density(poses) + math.log(mass) for one, mass in zip(parts, masses, strict=True)
        ]
        return torch.stack(each).logsumexp(0)

    def draw(count: int, g: Generator) -> Tensor:
        first = torch.rand(count, generator=g) < masses[0]
        both = [one.draw(count, g) for one in parts]
        return torch.where(first[:, None, None], both[0], both[1])

    return Posterior(log_density, draw, make_middle())


def make_ring(shift: float = 0.004, tilt: float = 0.05) -> Posterior:
    """Return poses of a round object: any turn about its z axis, which tilts by little."""
    pose = make_middle()
    grid = torch.linspace(0, math.pi, 100_001).double()
    mass = grid.sin() * (-0.5 * (grid / tilt) ** 2).exp()
    # of SO(3), pi^2 in all, the share with a tilt in da is sin(a) da / 2
    total = math.pi**2 * float(torch.trapezoid(mass, grid)) / 2

    def log_density(poses: Tensor) -> Tensor:
        cos = (rotation_of(pose)[:, 2] * rotation_of(poses)[..., 2]).sum(-1).clamp(-1, 1)
        far = (origin_of(poses, CENTER) - origin_of(pose, CENTER)).square().sum(-1)
        place = -0.5 * far / shift**2 - 3 * math.log(shift * math.sqrt(2 * math.pi))
        return place - 0.5 * (cos.acos() / tilt).square() - math.log(total)

    def draw(count: int, g: Generator) -> Tensor:
        cumulated = mass.cumsum(0) / mass.sum()
        angle = grid[torch.searchsorted(cumulated, torch.rand(count, generator=g).double())]
        about, spin = (2 * math.pi * torch.rand(2, count, generator=g)).double()
        o = torch.zeros_like(angle)
        lean = exp_so3(torch.stack([angle * about.cos(), angle * about.sin(), o], -1))
        turn = rotation_of(pose) @ lean @ exp_so3(torch.stack([o, o, spin], -1))
        noise = shift * torch.randn(count, 3, generator=g).double()
        return make_pose(turn, pose[:3, 3] + noise)

    return Posterior(log_density, draw, pose)


WAYS = ("search", "tempered", "drawn anew")
POSTERIORS = {"Gaussian": make_gaussian, "two modes": make_modes, "ring": make_ring}


def measure(name: str, options: Any, way: str) -> list[Any]:
    """Return a row of the table: the exact mean log density, the gap, errors of correlations, and
    the share of the truths that 50 and 90 % credible sets hold.
    """
    posterior = POSTERIORS[name]()
    exact, found, held = [], [], []
    spread = torch.zeros(6, 6).double()
    for seed in range(options.runs):
        truths = posterior.draw(options.truths, torch.Generator().manual_seed(1000 + seed))
        belief = run(posterior, options.particles, seed, way)
        exact.append(float(posterior.log_density(truths).mean()))
        found.append(float(belief.log_density(truths.numpy()).mean()))
        held.append([belief.contains(truths.numpy(), level).mean() for level in (0.5, 0.9)])
        spread += torch.from_numpy(belief.covariance) / options.runs
    error: float | None = None
    if posterior.covariance is not None:
        gap = (normalize(spread) - normalize(posterior.covariance))[:3, 3:]
        error = float(gap.abs().max())
    gaps = np.array(exact) - np.array(found)
    return [np.mean(exact), np.mean(found), gaps.mean(), gaps.max(), error, *np.mean(held, 0)]


def normalize(covariance: Tensor) -> Tensor:
    """Return the correlations of a covariance."""
    deviation = covariance.diagonal().sqrt()
    return covariance / deviation[:, None] / deviation


def list_symmetries() -> dict[str, Tensor]:
    """Return the rotations (S, 3, 3) of some solids."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    signed = [
        np.eye(3)[list(order)] * np.array(sign)[:, None]
        for order, sign in itertools.product(itertools.permutations(range(3)), signs)
    ]
    cube = torch.tensor(np.array([one for one in signed if np.linalg.det(one) > 0]))
    upright = cube[:, 2, 2] != 0
    box = cube[(cube.diagonal(dim1=1, dim2=2) != 0).all(1)]
    turns = [exp_so3(torch.tensor([0, 0, 2 * math.pi * k / 3]).double()) for k in range(3)]
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0])).double()
    prism = torch.stack([a @ b for a in turns for b in (torch.eye(3).double(), flip)])
    return {"box": box, "triangular prism": prism, "square prism": cube[upright], "cube": cube}


def make_solid(group: Tensor, shift: float = 0.004, turn: float = 0.05) -> Posterior:
    """Return equal modes at the equivalent poses of a solid; its density is not normalized."""
    pose = make_middle()
    copies = pose @ make_pose(group, torch.zeros(3).double())

    def log_density(poses: Tensor) -> Tensor:
        far = (origin_of(poses, CENTER) - origin_of(pose, CENTER)).square().sum(-1) / shift**2
        angle = angle_between(rotation_of(poses)[:, None], rotation_of(copies)) / turn
        return (-0.5 * angle.square()).logsumexp(1) - 0.5 * far

    def draw(count: int, g: Generator) -> Tensor:
        return copies  # the equivalent poses themselves

    return Posterior(log_density, draw, pose)


def count_modes(group: Tensor, particles: int, seed: int) -> tuple[float, float]:
    """Return precision and recall of a belief's modes at 10 degrees and 2 cm."""
    posterior = make_solid(group)
    truths = posterior.draw(0, torch.Generator())
    belief = run(posterior, particles, seed)
    modes = np.stack([mode.pose for mode in belief.modes if mode.mass > 0.002])
    poses = torch.from_numpy(modes)
    turn = angle_between(rotation_of(poses)[:, None], rotation_of(truths)) < math.radians(10)
    far = origin_of(poses, CENTER)[:, None] - origin_of(truths, CENTER)
    near = turn & (far.norm(dim=-1) < 0.02)
    return float(near.any(1).double().mean()), float(near.any(0).double().mean())


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--truths", type=int, default=400)
    parser.add_argument("--only", nargs="+", choices=POSTERIORS, default=list(POSTERIORS))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    parser.add_argument("--solids", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.solids:
        print("| solid | equivalent poses | runs | precision | recall |\n|---|---|---|---|---|")
        for name, group in list_symmetries().items():
            pairs = [count_modes(group, options.particles, seed) for seed in range(options.runs)]
            precision, recall = (100 * np.mean(values) for values in zip(*pairs, strict=True))
            cells = (name, len(group), options.runs, f"{precision:.0f} %", f"{recall:.0f} %")
            print(f"| {' | '.join(map(str, cells))} |", flush=True)
        return 0
    print("| posterior | belief | exact | belief's | gap | worst run | correlation | 50 % | 90 % |")
    print(f"|{'---|' * 9}")
    for name, way in itertools.product(options.only, options.ways):
        exact, found, gap, worst, error, half, most = measure(name, options, way)
        off = "" if error is None else f"{error:.2f}"
        numbers = (f"{exact:.2f}", f"{found:.2f}", f"{gap:.2f}", f"{worst:.2f}", off)
        cells = (name, way, *numbers)
        print(f"| {' | '.join(cells)} | {100 * half:.0f} % | {100 * most:.0f} % |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
