"""What an estimate costs against image width, particles, iterations and image points.

    python bench/cost.py [--only width --only particles ...] [--methods patch_pf ...]
        [--max-particles 10000]

The five methods in their working preset, with new weights, on one drawn image: what is computed
does not depend on what was learned. Each value of a setting is measured in turn, and all of them
five times over, so that a machine whose speed drifts disturbs all alike. Times are the processor's,
of one thread; only their ratios are to go by. The image is encoded once, before the filter: both
are told apart. Writes the tables of docs/results/cost.md.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from marked import format_row, put_table
from programs import HOME, make_parser

import posefilter
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.images import check_images, make_batch
from posefilter.memory import keep_freed_memory
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch

PAGE = HOME / "docs" / "results" / "cost.md"
METHODS = ("pose_pf", "patch_pf", "pixel_pf", "cnn_patch", "downsized")
REPEATS = 5
SWEEPS: dict[str, tuple[int, ...]] = {
    "width": (160, 320, 640, 960),
    "particles": (10, 100, 1000, 10_000, 100_000),
    "steps": (1, 3, 10, 30, 100),
    "points": (16, 64, 256),
}
# beside the setting that is swept
PLAIN = {"width": 320, "particles": 100, "steps": 10, "points": 64}


class Cost(NamedTuple):
    """What one estimate took, in seconds of the processor."""

    encode: float
    filter: float


def make_method(name: str) -> PoseEstimator:
    """Return a new method of the cracker box, in its working preset, without what follows the last
    step: an estimate is a constant beside it, or a refinement of one pose.
    """
    typed = [f"model={name}", "variant=working", "filter/estimate=argmax", "filter/refine=none"]
    job = compose_job("train", HOME / "conf", typed, Path())
    torch.manual_seed(0)
    model = posefilter.load("003_cracker_box", device="cpu").object_models[0]
    return build_method(recipe(job), model, lightning=False).eval()


def draw_image(width: int) -> Batch:
    """Return a smooth random image with depth, of 4 to 3."""
    draw = np.random.default_rng(0)
    size = (width, 3 * width // 4)
    rgb = cv2.resize(draw.integers(0, 256, (12, 16, 3), dtype=np.uint8), size)
    depth = cv2.resize(draw.uniform(0.6, 1.2, (12, 16)).astype(np.float32), size)
    K = np.array([[1.7 * width, 0, width / 2], [0, 1.7 * width, size[1] / 2], [0, 0, 1]])
    return make_batch(check_images(rgb, depth, K)[0], None, None)


def measure(method: PoseEstimator, batch: Batch, particles: int, steps: int, points: int) -> Cost:
    """Return what one estimate takes."""
    own: Any = method
    own.filter.particles = own.filter.initial_particles = particles
    own.filter.steps = steps
    if hasattr(own, "pixels"):
        own.pixels = points
    encode, took = type(own).encode, []

    def timed(images: Batch) -> Any:
        begun = time.process_time()
        scene = encode(own, images)
        took.append(time.process_time() - begun)
        return scene

    own.encode = timed
    start = time.process_time()
    with torch.no_grad():
        own.predict_step(batch, 0)
    whole = time.process_time() - start
    del own.encode
    return Cost(took[0], whole - took[0])


def sweep(method: PoseEstimator, key: str, values: Sequence[int]) -> list[list[Cost]]:
    """Return the costs of each value, `REPEATS` of each, measured by turns."""
    costs: list[list[Cost]] = [[] for _ in values]
    images = {width: draw_image(width) for width in {PLAIN["width"], *SWEEPS["width"]}}
    for repeat in range(REPEATS + 1):  # the first warms up
        for value, own in zip(values, costs, strict=True):
            now = {**PLAIN, key: value}
            # many particles for two steps: what is measured is their share
            now["steps"] = 2 if key == "particles" else now["steps"]
            cost = measure(
                method, images[now["width"]], now["particles"], now["steps"], now["points"]
            )
            if repeat:
                own.append(cost)
    return costs


def fit_exponent(values: Sequence[float], costs: Sequence[float]) -> float:
    """Return the slope of the least squares line through the logarithms."""
    x, y = np.log(np.asarray(values, float)), np.log(np.asarray(costs, float))
    return float(np.polyfit(x, y, 1)[0])


def describe(name: str, key: str, values: Sequence[int], costs: Sequence[Sequence[Cost]]) -> str:
    """Return a row: medians in milliseconds, the ratio of the ends, and the exponents."""
    encode, own = (
        [float(np.median([getattr(cost, part) for cost in one])) for one in costs]
        for part in Cost._fields
    )
    shown = [show_milliseconds(value) for value in own]
    shown += ["–"] * (len(SWEEPS[key]) - len(values))
    ratios = [last.filter / first.filter for first, last in zip(costs[0], costs[-1], strict=True)]
    cells = [name, *shown, f"{np.median(ratios):.2f}", f"{fit_exponent(values, own):.2f}"]
    cells.append(f"{fit_exponent(values[-2:], own[-2:]):.2f}")
    if key == "width":
        cells += [show_milliseconds(value) for value in (encode[0], encode[-1])]
        # maps that are not learned, and copies of the image, are of no cost to speak of
        cells.append(f"{fit_exponent(values, encode):.2f}")
    return format_row(cells)


def show_milliseconds(seconds: float) -> str:
    """Return a time in milliseconds, of three digits."""
    return f"{float(f'{1000 * seconds:.3g}'):,g}"


def choose_values(name: str, key: str, max_values: int) -> tuple[int, ...]:
    """Return the values of a setting that are measured of a method."""
    if key != "particles":
        return SWEEPS[key]
    # a particle of pose_pf is 64 points; one of the detectors a patch that is convolved
    limit = min(max_values, 100_000 if name in ("patch_pf", "pixel_pf") else 10_000)
    return tuple(value for value in SWEEPS[key] if value <= limit)


def make_head(key: str) -> list[str]:
    """Return the headings of the table of a setting."""
    head = ["method", *(f"{value:,}" for value in SWEEPS[key]), "last / first", "exponent"]
    head += ["of the last two"]
    if key == "width":
        head += [f"encoder at {SWEEPS[key][0]}", f"at {SWEEPS[key][-1]}", "its exponent"]
    return head


def main() -> None:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--only", action="append", choices=[*SWEEPS])
    parser.add_argument("--methods", nargs="+", default=METHODS, choices=METHODS)
    parser.add_argument("--max-particles", type=int, default=100_000, help="particles")
    typed = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    methods = {name: make_method(name) for name in typed.methods}
    for key in typed.only or SWEEPS:
        rows = []
        for name, method in methods.items():
            if key == "points" and name != "pose_pf":
                continue  # the others read a patch
            values = choose_values(name, key, typed.max_particles)
            rows.append(describe(name, key, values, sweep(method, key, values)))
            print(key, rows[-1], flush=True)
        PAGE.write_text(put_table(PAGE.read_text(), key, make_head(key), rows))


if __name__ == "__main__":
    main()
