"""Compare the calibrated belief with simpler error models, on rendered frames that no calibration
saw: does it help that its width and shape go by the image?

    python bench/belief_baseline.py --root DIR --meshes DIR --store DIR [--frames 120]
        [--minutes 5] FILE.ckpt ...
    python bench/belief_baseline.py --store DIR FILE.ckpt ...      # only prints the tables

Every frame below --root with a visibility above 0.1 is taken, in a fixed shuffle.  What the filter
leaves is kept in --store, in the files that `bench/calibrated.py` keeps in FILE.beliefs, which may
be given instead; started again, it goes on, and --minutes ends it early.

All models are Student's t about the estimate:

    as it ships                 of the checkpoint's calibration: s^2 (C + F), s and C of the image
    one covariance              the same for every image
    C of the image, one scale   C of the particles, the same s for every image
    one shape, shipped size     one covariance, scaled to the volume of what ships

The last three are fitted, by maximum likelihood, to the right estimates of other scenes: scenes are
divided into --folds parts, and each is judged by what the others say.  Their degrees of freedom are
those of 3, 5 and 8 that explain these best.  The gain is the mean difference of the log density of
the truth to that of the belief as it ships [nat], with the interval of 95 % of a bootstrap over
scenes; above 0, the other model is better.  Coverage is that of ellipsoids, and should be their
level.  Both are of the frames whose estimate is right, which is what all of them suppose.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from calibrated import load_observation, observe, save_observation, share
from checkpoint_frames import open_frames
from confidence import degrees_of
from marked import format_table
from programs import make_parser
from scene_bootstrap import bootstrap_scenes
from scipy.special import gammaln
from scipy.stats import f as f_distribution

from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.confidence.belief_scale import POSSIBLE_DEGREES, measure_spread
from posefilter.confidence.tolerance import RIGHT, measure_pose_errors
from posefilter.data.loaders import make_loader
from posefilter.metrics.credibility import SHOWN
from posefilter.models.base import PoseEstimator

_ROUNDS = 100  # of expectation and maximization
_RESAMPLES = 2000
SHIPPED = "as it ships"
Fit = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


class Errors(NamedTuple):
    """Errors of the estimates of n frames, and what is known of each; a turn is the shift [m] that
    it gives at the object's radius.
    """

    twist: np.ndarray  # (n, 6) from the estimate to the truth
    scatter: np.ndarray  # (n, 6, 6) second moment of the particles about the estimate: C
    shipped: np.ndarray  # (n, 6, 6) s^2 (C + F), of the checkpoint's calibration
    right: np.ndarray  # (n,) bool
    visibility: np.ndarray  # (n,)
    scene: np.ndarray  # (n,) names


class Judgement(NamedTuple):
    """What an error model says of n errors."""

    log_density: np.ndarray  # (n,) [nat]
    level: np.ndarray  # (n,) of the smallest ellipsoid that holds the error


def measure_errors(method: PoseEstimator, store: Path) -> Errors:
    """Return the errors of the frames whose observations a folder holds."""
    object_model, calibration = method.object_model, method.calibration
    if calibration is None or calibration.belief_scale is None:
        raise SystemExit(f"{object_model.name}: is not calibrated, or without a belief's scale")
    parts: list[tuple[Any, ...]] = []
    for file in sorted(store.glob(f"{object_model.name}.with.*.npz")):
        found = load_observation(file)
        spread = measure_spread(found.belief, found.truth, object_model)
        probability = calibration.assess(found.features).probability
        features = calibration.standardize(found.features)
        factor = calibration.belief_scale.find_factor(probability, features)
        shipped = factor[:, None, None] ** 2 * calibration.belief_scale.find_shape(spread.scatter)
        right = RIGHT.accepts(measure_pose_errors(found.belief.best, found.truth, object_model))
        parts.append((*spread, shipped, right, found.visibility, np.array(found.scenes)))
    if not parts:
        raise SystemExit(f"{store}: holds no frames of {object_model.name}")
    columns = zip(*parts, strict=True)
    return Errors(*(np.concatenate([np.asarray(x) for x in column]) for column in columns))


def judge(twist: np.ndarray, shape: np.ndarray, degrees: int) -> Judgement:
    """Judge errors by Student's t.

    Args:
        twist: (n, 6).
        shape: Matrices (n, 6, 6), or one (6, 6): the covariance is n / (n - 2) times it.
        degrees: Of freedom.
    """
    squared = (twist * np.linalg.solve(shape, twist[..., None])[..., 0]).sum(-1)
    constant = gammaln(degrees / 2 + 3) - gammaln(degrees / 2) - 3 * np.log(degrees * np.pi)
    log_volume = 0.5 * np.linalg.slogdet(shape)[1]
    density = constant - log_volume - 0.5 * (degrees + 6) * np.log1p(squared / degrees)
    return Judgement(density, f_distribution.cdf(squared / 6, 6, degrees))


def fit_covariance(twist: np.ndarray, shape: np.ndarray, degrees: int) -> np.ndarray:
    """Return the one matrix (6, 6) of highest likelihood, of errors that are divided by the sizes
    of their shapes (n, 6, 6), times these sizes.  -> (n, 6, 6) as `shape` or (6, 6).

    Expectation and maximization (Dempster et al. 1980): an error of the squared distance d counts
    (n + 6) / (n + d).
    """
    size = measure_size(shape)
    near = twist / size[:, None]
    own = near.T @ near / len(near)
    for _ in range(_ROUNDS):
        squared = (near * np.linalg.solve(own, near.T).T).sum(-1)
        weights = (degrees + 6) / (degrees + squared)
        own = (weights[:, None] * near).T @ near / len(near)
    return own


def fit_scale(twist: np.ndarray, shape: np.ndarray, degrees: int) -> np.ndarray:
    """Return the one factor () of highest likelihood of shapes (n, 6, 6), squared."""
    squared = (twist * np.linalg.solve(shape, twist[..., None])[..., 0]).sum(-1)
    factor = squared.mean() / 6
    for _ in range(_ROUNDS):
        factor = ((degrees + 6) / (degrees + squared / factor) * squared).mean() / 6
    return np.asarray(factor)


def measure_size(shape: np.ndarray) -> np.ndarray:
    """Return the geometric means of the axes of ellipsoids.  (n, 6, 6) -> (n,)."""
    return np.asarray(np.exp(np.linalg.slogdet(shape)[1] / 12))


def compare(found: Errors, degrees: int, folds: int = 5, seed: int = 0) -> dict[str, Judgement]:
    """Return what the models say of all frames, by name.

    Args:
        found: Of one object.
        degrees: Of freedom, of the calibration.
        folds: Parts of the scenes.
        seed: Of their shuffle.
    """
    size = measure_size(found.shipped)[:, None, None] ** 2 * np.eye(6)
    even = np.broadcast_to(np.eye(6), found.scatter.shape)
    models: dict[str, tuple[Fit, np.ndarray]] = {
        "one covariance": (fit_covariance, even),
        "C of the image, one scale": (fit_scale, found.scatter),
        "one shape, shipped size": (fit_covariance, size),
    }
    out = {SHIPPED: judge(found.twist, found.shipped, degrees)}
    order = np.random.default_rng(seed).permutation(np.unique(found.scene))
    fold = {scene: k % folds for k, scene in enumerate(order)}
    part = np.array([fold[scene] for scene in found.scene])
    for name, (fit, shape) in models.items():
        density, level = np.full((2, len(part)), np.nan)
        for k in range(folds):
            learned, held = found.right & (part != k), part == k
            if learned.sum() <= 12:
                raise SystemExit("too few right estimates to fit a covariance to")
            tried = []
            for n in POSSIBLE_DEGREES:
                own = fit(found.twist[learned], shape[learned], n)
                scale = measure_size(shape)[:, None, None] ** 2
                whole = own * shape if own.ndim == 0 else own * scale
                likelihood = judge(found.twist[learned], whole[learned], n).log_density.sum()
                tried.append((likelihood, judge(found.twist[held], whole[held], n)))
            density[held], level[held] = max(tried, key=lambda one: one[0])[1]
        out[name] = Judgement(density, level)
    return out


def bootstrap(values: np.ndarray, scene: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of values (n,), and the ends of its interval of 95 %, of a bootstrap over
    scenes (n,).
    """
    ends = bootstrap_scenes(scene.tolist(), lambda rows: float(values[rows].mean()), _RESAMPLES)
    return float(values.mean()), *ends


def tabulate(name: str, found: Errors, judged: dict[str, Judgement]) -> list[list[str]]:
    """Return a row a model, of the frames whose estimate is right and of all."""
    rows, own = [], found.right
    for model, one in judged.items():
        levels = [one.level[own] < level / 100 for level in SHOWN]
        gain = one.log_density - judged[SHIPPED].log_density
        cells = [name, f"{own.sum()} of {len(own)}", model, share(np.transpose(levels))]
        for some in (own, own & (found.visibility < 0.75), np.ones_like(own)):
            if model == SHIPPED or not some.any():
                cells.append("–")
                continue
            mean, low, high = bootstrap(gain[some], found.scene[some])
            cells.append(f"{mean:+.2f} [{low:+.2f}, {high:+.2f}]")
        rows.append(cells)
    return rows


def collect(file: str, method: PoseEstimator, checkpoint: dict[str, Any], options: Any) -> bool:
    """Add the observations of one checkpoint that are missing; tell whether none is left."""
    name, end = method.object_model.name, options.end
    options.store.mkdir(parents=True, exist_ok=True)
    data = open_frames(file, checkpoint, name, options)
    records = data.val_dataset.records
    for number, batch in enumerate(make_loader(data.val_dataset, 8, 0)):
        stored = options.store / f"{name}.with.{number:04d}.npz"
        if stored.exists():
            continue
        if time.monotonic() > end:
            return False
        scenes = [one.group for one in records[8 * number : 8 * number + 8]]
        save_observation(observe(method, batch, number, scenes), stored)
    return True


def main() -> int:
    """Collect observations, print the table; the status is 3 where --minutes ended it."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="+")
    parser.add_argument("--root")
    parser.add_argument("--meshes")
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--folds", type=int, default=5)
    options = parser.parse_args()
    if (options.root is None) != (options.meshes is None):
        parser.error("--root and --meshes belong together")
    torch.set_num_threads(1)
    options.end, whole, rows = time.monotonic() + 60 * options.minutes, True, []
    for file in options.files:
        checkpoint = read_checkpoint(file)
        method = method_of(checkpoint, lightning=False)
        method.seed = 0
        if options.root is not None:
            whole &= collect(file, method, checkpoint, options)
        found = measure_errors(method, options.store)
        judged = compare(found, degrees_of(method), options.folds)
        rows += tabulate(method.object_model.name, found, judged)
    levels = " / ".join(map(str, SHOWN))
    head = ("object", "right", "error model", f"ellipsoids of {levels} %", "gain [nat]")
    print(format_table((*head, "visibility below 0.75", "wrong ones too"), rows))
    return 0 if whole else 3


if __name__ == "__main__":
    sys.exit(main())
