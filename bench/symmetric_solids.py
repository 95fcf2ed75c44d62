"""Count the modes that a belief holds of solids whose symmetries it is not told.

    python bench/symmetric_solids.py [--particles 1000] [--runs 5] [--ways NAME ...] [--only NAME]

The likelihood is that of toy_posteriors.py: equal modes at the equivalent poses of a solid, 4 mm
and 3 degrees wide.  A mode is right within 10 degrees and 2 cm of an equivalent pose.  Precision is
the share of the belief's modes (of a weight above 0.2 %) that are right, recall the share of the
equivalent poses at which there is such a mode.  Of round solids, whose equivalent poses are a
continuum, the particles count as the modes, and 72 poses as the equivalent ones.  `least mass` is
the lightest equivalent pose's share of the belief within 10 degrees, over what all have on average.
`askew` turns the solid's symmetries away from the axes that the moves turn about; `unrelated modes`
are 12 rotations that no symmetry relates.
"""

import itertools
import math
import sys

import numpy as np
import torch
from exact_posteriors import CENTER, Posterior, make_middle
from programs import make_parser
from torch import Generator, Tensor
from toy_posteriors import WAYS, run

from posefilter.geometry.pose import make_pose, origin_of, rotation_of
from posefilter.geometry.rotation import angle_between, exp_so3, random_rotation

SHIFT, TURN = 0.004, 0.05  # [m], [rad] standard deviations of a mode
LEAST = 0.002  # mass of what counts as a mode
ROUND = ("cylinder", "cone")
HEAD = ("solid", "equivalent poses", "belief", "precision", "recall", "worst run", "least mass")


def turn_about(axis: int, count: int) -> Tensor:
    """Return the `count` turns of equal angle about an axis, (count, 3, 3)."""
    vector = torch.zeros(count, 3).double()
    vector[:, axis] = 2 * math.pi * torch.arange(count).double() / count
    return exp_so3(vector)


def list_solids() -> dict[str, Tensor]:
    """Return the rotations (S, 3, 3) at which solids look the same."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    signed = [
        np.eye(3)[list(order)] * np.array(sign)[:, None]
        for order, sign in itertools.product(itertools.permutations(range(3)), signs)
    ]
    cube = torch.tensor(np.array([one for one in signed if np.linalg.det(one) > 0]))
    upright = cube[:, 2, 2] != 0
    box = cube[(cube.diagonal(dim1=1, dim2=2) != 0).all(1)]
    flip = turn_about(0, 2)
    prism = (turn_about(2, 3)[:, None] @ flip).flatten(0, 1)
    skew = random_rotation(generator=torch.Generator().manual_seed(1)).double()
    unrelated = random_rotation(1, 12, generator=torch.Generator().manual_seed(5))[0].double()
    return {
        "box": box,
        "triangular prism": prism,
        "square prism": cube[upright],
        "cube": cube,
        "cone": turn_about(2, 72),
        "cylinder": (turn_about(2, 36)[:, None] @ flip).flatten(0, 1),
        "box, askew": skew @ box @ skew.T,
        "cube, askew": skew @ cube @ skew.T,
        "unrelated modes": unrelated,
    }


def make_solid(name: str, group: Tensor) -> Posterior:
    """Return equal modes at the equivalent poses of a solid; its density is not normalized."""
    pose = make_middle()
    copies = pose @ make_pose(group, torch.zeros(3).double())

    def log_density(poses: Tensor) -> Tensor:
        far = (origin_of(poses, CENTER) - origin_of(pose, CENTER)).square().sum(-1) / SHIFT**2
        if name in ROUND:
            cos = (rotation_of(copies)[:2, :, 2] * rotation_of(poses)[..., None, :, 2]).sum(-1)
            angle = cos.clamp(-1, 1).acos() / TURN
        else:
            angle = angle_between(rotation_of(poses)[:, None], rotation_of(copies)) / TURN
        return (-0.5 * angle.square()).logsumexp(1) - 0.5 * far

    def draw(count: int, g: Generator) -> Tensor:
        return copies  # the equivalent poses themselves

    return Posterior(log_density, draw, pose)


def count_modes(name: str, particles: int, seed: int, way: str) -> tuple[float, float, float]:
    """Return precision and recall of a belief's modes at 10 degrees and 2 cm, and the least mass of
    an equivalent pose over the mean.
    """
    group = list_solids()[name]
    posterior = make_solid(name, group)
    truths = posterior.draw(0, torch.Generator())
    belief = run(posterior, particles, seed, way)[0]
    samples = torch.from_numpy(belief.samples)
    near = match(samples, truths).double()
    mass = torch.from_numpy(belief.weights) @ near
    if name not in ROUND:
        modes = np.stack([mode.pose for mode in belief.modes if mode.mass > LEAST])
        near = match(torch.from_numpy(modes), truths).double()
    else:
        near = near[torch.from_numpy(belief.weights) > 0.1 / particles]
    least = float(mass.min() / mass.mean())
    return float(near.amax(1).mean()), float(near.amax(0).mean()), least


def match(poses: Tensor, truths: Tensor) -> Tensor:
    """Tell which poses are within 10 degrees and 2 cm of which others.  (N,), (M,) -> (N, M)."""
    turn = angle_between(rotation_of(poses)[:, None], rotation_of(truths)) < math.radians(10)
    far = origin_of(poses, CENTER)[:, None] - origin_of(truths, CENTER)
    return turn & (far.norm(dim=-1) < 0.02)


def main() -> int:
    """Print the table."""
    solids = list_solids()
    parser = make_parser(__doc__)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--only", nargs="+", choices=solids, default=list(solids))
    ways = [way for way in WAYS if way != "exact draws"]
    parser.add_argument("--ways", nargs="+", choices=ways, default=ways)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| {' | '.join(HEAD)} |\n|{'---|' * len(HEAD)}")
    for name, way in itertools.product(options.only, options.ways):
        rows = [count_modes(name, options.particles, seed, way) for seed in range(options.runs)]
        precision, recall, least = np.mean(rows, 0)
        worst = min(row[1] for row in rows)
        shares = [f"{100 * share:.0f} %" for share in (precision, recall, worst)]
        count = "a ring" if name == "cone" else "two rings" if name in ROUND else len(solids[name])
        cells = (name, count, way, *shares, f"{least:.2f}")
        print(f"| {' | '.join(map(str, cells))} |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
