"""Compare the filter's belief with posteriors that are known exactly.

    python bench/toy_posteriors.py [--particles 1000] [--runs 5] [--first-seed 0] [--truths 400]
        [--only NAME ...] [--ways NAME ...]

Posteriors on SE(3), each with an exact density and exact draws: a Gaussian in which shifts and
turns go together, two modes, and a ring, as of an object that is round.  Every run has a posterior
of its own, with other poses, widths, correlations and masses, and its own seed.  The filter starts
with any rotation and within 10 cm, and is annealed as pose_pf is.

Ways: `search` weights as the filter does by default (`filter/reweight=current_likelihood`), which
reads the likelihood at every step; `islands` and `niches` do too, and resample within islands
(`filter/resample=islands`) or niches (`filter/resample=niches`); `tempered` counts it once
(`likelihood_ratio`); `drawn anew` is a last pass of importance sampling
(`filter/refine=mean_shift_and_importance`); `moved` has more rounds of it, those before the last
tempered, and then moves that leave the posterior unchanged
(`filter/refine=mean_shift_and_resample_move`).  `exact draws` are what a perfect sampler would
give: their gap is the kernel density's own.

Truths are drawn from the posterior.  `gap` is the mean log density that the exact posterior has at
them less that of the belief, over runs and truths; `mass` is the mean error of the first mode's
mass; `correlation` is the largest error of a correlation between a shift and a turn, of the mean
error over runs (of the Gaussian alone, the others having none that is defined); then the share of
the truths in the 50 and 90 % credible sets, and the evaluations of the likelihood a particle.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from exact_posteriors import CENTER, Posterior, make_gaussian, make_modes, make_ring, normalize
from programs import make_parser
from torch import Generator, Tensor

from posefilter.belief import Belief
from posefilter.filters.estimate import Argmax
from posefilter.filters.importance import ImportanceSampling
from posefilter.filters.loop import ParticleFilter
from posefilter.filters.niches import Niches
from posefilter.filters.propagate import Gaussian
from posefilter.filters.refine import Compose, NoRefine
from posefilter.filters.resample import Islands, Systematic
from posefilter.filters.resample_move import ResampleMove
from posefilter.filters.reweight import CurrentLikelihood, LikelihoodRatio
from posefilter.filters.schedule import Geometric
from posefilter.geometry.pose import make_pose, rotation_of
from posefilter.geometry.rotation import angle_between, random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.protocols import Refine, Resample
from posefilter.types import ParticleOutput, Particles, Step

RADIUS = 0.1  # [m]
FIRST, LAST, STEPS = 0.1, 0.005, 16  # [m] noise levels
REACH = 0.5  # [rad] from the middle of a mode: beyond its width, and short of the other mode


class Toy:
    """A method whose log-likelihood is a posterior's log density, over the square of the noise
    level.
    """

    space = PoseSpace((0.0, 0.0, 0.0), RADIUS)
    latent_width = 0

    def __init__(self, posterior: Posterior) -> None:
        self.posterior, self.evaluations = posterior, 0

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
        """Return the log density of (1, N) poses, and count them."""
        self.evaluations += poses.shape[1]
        return self.posterior.log_density(poses[0])[None]


def start(batch: Any, scene: None, method: Toy, count: int, generator: Generator) -> Tensor:
    """Draw any rotation, and positions within 10 cm."""
    turn = random_rotation(1, count, generator=generator).double()
    shift = 0.2 * torch.rand(1, count, 3, generator=generator).double() - 0.1
    return make_pose(turn, method.posterior.middle[:3, 3] + shift)


def make_resample(way: str) -> Resample:
    """Return the resampling of one of `WAYS`."""
    if "niches" in way:
        return Niches()
    return Islands(Systematic()) if "islands" in way else Systematic()


def make_refine(way: str, particles: int) -> Refine:
    """Return the last pass of one of `WAYS`."""
    if way.endswith("drawn anew"):
        return ImportanceSampling(particles, 3)
    if way.endswith("moved"):
        return Compose([ImportanceSampling(particles, 5, min_effective=0.2), ResampleMove(8)])
    return NoRefine()


def make_belief(poses: Tensor, weights: Tensor) -> Belief:
    """Return the belief of poses (N, 4, 4) with weights (N,)."""
    weights = weights.double() / weights.double().sum()
    return Belief(poses.double().numpy(), weights.numpy(), CENTER.numpy(), RADIUS, 2 * RADIUS)


def run(posterior: Posterior, particles: int, seed: int, way: str) -> tuple[Belief, float]:
    """Run the filter in one of `WAYS`.

    Returns:
        Its belief, and the evaluations of the likelihood for each particle.
    """
    generator = torch.Generator().manual_seed(seed)
    if way == "exact draws":
        return make_belief(posterior.draw(particles, generator), torch.ones(particles)), 0.0
    filter = ParticleFilter(
        particles,
        STEPS,
        initialize=start,
        schedule=Geometric(FIRST, LAST),
        reweight=CurrentLikelihood() if not way.startswith("tempered") else LikelihoodRatio(),
        resample=make_resample(way),
        propagate=Gaussian(0.5),
        estimate=Argmax(),
        refine=make_refine(way, particles),
        initial_particles=8 * particles,
    )
    toy = Toy(posterior)
    found = filter(None, toy, generator).belief  # type: ignore[arg-type]
    return make_belief(found.poses[0], found.log_weights[0].exp()), toy.evaluations / particles


WAYS = (
    "search", "search, drawn anew", "search, moved", "islands", "islands, moved", "niches",
    "niches, moved", "tempered", "tempered, moved", "exact draws",
)  # fmt: skip
POSTERIORS: dict[str, Callable[[int], Posterior]] = {
    "Gaussian": make_gaussian,
    "two modes": make_modes,
    "ring": make_ring,
    "two modes, unlike": partial(make_modes, alike=False),
}
HEAD = ("posterior", "belief", "exact", "gap", "worst run", "mass", "correlation", "50 %", "90 %")
HEAD += ("evaluations",)


def measure(name: str, options: Any, way: str) -> list[str]:
    """Return a row of the table."""
    exact, found, held, counts, masses, off = [], [], [], [], [], []
    for seed in range(options.first_seed, options.first_seed + options.runs):
        posterior = POSTERIORS[name](seed)
        truths = posterior.draw(options.truths, torch.Generator().manual_seed(1000 + seed))
        belief, count = run(posterior, options.particles, seed, way)
        counts.append(count)
        exact.append(float(posterior.log_density(truths).mean()))
        found.append(float(belief.log_density(truths.numpy()).mean()))
        held.append([belief.contains(truths.numpy(), level).mean() for level in (0.5, 0.9)])
        if posterior.covariance is not None:
            error = normalize(torch.from_numpy(belief.covariance)) - normalize(posterior.covariance)
            off.append(error[:3, 3:])
        if posterior.mass is not None:
            turns = rotation_of(torch.from_numpy(belief.samples))
            near = angle_between(turns, rotation_of(posterior.middle)).numpy() < REACH
            masses.append(abs(belief.weights[near].sum() - posterior.mass))
    gaps = np.array(exact) - np.array(found)
    mass = np.mean(masses) if masses else None
    correlation = float(torch.stack(off).abs().mean(0).max()) if off else None
    numbers = (np.mean(exact), gaps.mean(), gaps.max(), mass, correlation)
    cells = ["" if x is None else f"{x:.2f}" for x in numbers]
    shares = [f"{100 * share:.0f} %" for share in np.mean(held, 0)]
    return [name, way, *cells, *shares, f"{np.mean(counts):.0f}"]


def main() -> int:
    """Print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument(
        "--first-seed", type=int, default=0, help="even: as many odd ones as with 0"
    )
    parser.add_argument("--truths", type=int, default=400)
    parser.add_argument("--only", nargs="+", choices=POSTERIORS, default=list(POSTERIORS))
    parser.add_argument("--ways", nargs="+", choices=WAYS, default=list(WAYS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for name in options.only:
        for way in options.ways:
            print(f"| {' | '.join(measure(name, options, way))} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
