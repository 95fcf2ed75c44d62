"""A GPU against the CPU of the same machine: equal figures, and how long the filter takes.

    python bench/gpu.py --root DIR --meshes DIR [--only 003_cracker_box] [--images 100] \
        [--out ROWS.json]
    python bench/gpu.py --table ROWS.json   # only puts rows into docs/performance.md

`--root` has renders that no training saw, in the format of Falling Things; all are used. The same
poses are scored by the same image points on both, in float32 and in bfloat16, against the reference
(`PoseLikelihood`) in float64 on the CPU. Both search the same images: a GPU draws other random
numbers by the same seed, so that estimates are compared by their errors. And times: an image, a
batch of 8, and the paper's filter of 1,000 particles, 100 steps and 256 image points a pose, with
this project's likelihood and with the paper's own network. Medians, each call waited for.
"""

import json
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from batches import stack
from held_out import bound_auc, read_frames
from marked import format_row, put_table
from programs import HOME, make_parser

import posefilter
from posefilter.cli.machine import device_name, versions
from posefilter.data.frames import Sample
from posefilter.estimator import get_trained_size
from posefilter.images import check_images, make_batch
from posefilter.metrics.errors import add, add_s
from posefilter.metrics.scores import auc
from posefilter.models.base import PoseEstimator
from posefilter.nets import fused
from posefilter.nets.likelihood import sample_points
from posefilter.types import Batch

PAGE = HOME / "docs" / "performance.md"
HEADS = {
    "gpu scores": ("computed", "noise level mm", "largest difference", "mean difference"),
    "gpu estimates": (
        "object", "images", "ADD AUC, CPU", "GPU", "ADD-S AUC, CPU", "GPU",
        "difference of the mean ADD, mm", "probability: mean difference",
    ),
    "gpu times": ("what", "CPU ms", "GPU ms", "CPU over GPU"),
}  # fmt: skip
PAPER = ("filter.particles=1000", "filter.initial_particles=1000", "filter.steps=100")
ONCE = ("filter.max_searches=1", "filter.magnified_width=null", "filter/refine=none")
POSES, POINTS = 1000, 256
Rows = list[list[str]]


def load(name: str, device: str, *overrides: str) -> posefilter.Estimator:
    """Return an estimator on a device."""
    return posefilter.load(name, overrides=overrides, device=device)


def clock(call: Callable[[], Any], repeats: int) -> float:
    """Return the median time of a call [ms], after one that is not counted; of a single call where
    `repeats` is 1.
    """

    def wait() -> None:
        if torch.cuda.is_available():
            torch.cuda.synchronize()

    times = []
    for _ in range(repeats + (repeats > 1)):
        wait()
        begun = time.perf_counter()
        call()
        wait()
        times.append(time.perf_counter() - begun)
    return 1000 * statistics.median(times[repeats > 1 :])


def make_search(method: PoseEstimator, sample: Sample) -> Batch:
    """Return an image as a method searches it, on its device."""
    images, _ = check_images(sample.rgb, sample.depth, sample.intrinsics)
    size = get_trained_size(method.recipe.get("settings", {}))
    return Batch(*(x.to(method.device) for x in make_batch(images, *size)))


@torch.no_grad()
def compare_scores(name: str, sample: Sample) -> Rows:
    """Return how far scores of the same poses, by the same points, are from float64 on the CPU."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1, 1, POINTS, 2, generator=generator, dtype=torch.float64)
    truth = torch.as_tensor(sample.camera_from_object, dtype=torch.float64)
    methods = {device: load(name, device).methods[0] for device in ("cpu", "cuda")}
    encoding = methods["cpu"].encode(make_search(methods["cpu"], sample))
    space = methods["cpu"].space
    poses = truth.expand(1, POSES, 4, 4).contiguous()

    def score(device: str, dtype: torch.dtype, network: torch.dtype, sigma: float) -> torch.Tensor:
        """Score the poses; in float64 by the reference."""
        method: Any = methods[device]

        def put(x: Any) -> Any:
            if not isinstance(x, torch.Tensor):
                return x
            return x.to(device, dtype) if x.is_floating_point() else x.to(device)

        image = encoding.image
        context = type(image.context)(*(put(x) for x in image.context))
        image = image._replace(
            values=put(image.values), intrinsics=put(image.intrinsics), context=context, tables=None
        )
        likelihood = method.likelihood.to(dtype)
        at = torch.tensor(sigma, dtype=dtype, device=device)
        center, radius = put(method.object_model.center), method.object_model.radius
        own = put(moved)
        if dtype == torch.float64:
            points = sample_points(image, own, center, radius, put(noise))
            found = likelihood.score_sampled(points, own, at, center, radius)
        else:
            found = fused.score(likelihood, image, own, at, center, radius, put(noise), network)
        found = found + likelihood.judge_surface(image, own, at, center, radius)
        method.likelihood.float()
        return found.double().cpu()

    rows = []
    for sigma in (0.003, 0.02, 0.1):
        moved = space.move(poses, sigma * torch.randn(1, POSES, 6, generator=generator).double())
        exact = score("cpu", torch.float64, torch.float64, sigma)
        for words, device, network in (
            ("CPU, float32", "cpu", torch.float32),
            ("GPU, float32", "cuda", torch.float32),
            ("CPU, bfloat16", "cpu", torch.bfloat16),
            ("GPU, bfloat16", "cuda", torch.bfloat16),
        ):
            away = (score(device, torch.float32, network, sigma) - exact).abs()
            rows.append([words, f"{1000 * sigma:.0f}", f"{away.max():.4f}", f"{away.mean():.4f}"])
    return rows


def compare_estimates(name: str, frames: Sequence[tuple[str, Sample]]) -> Rows:
    """Return what both find in the same images."""
    errors, symmetric, probability = {}, {}, {}
    truth = torch.stack([torch.as_tensor(one.camera_from_object) for _, one in frames]).double()
    for device in ("cpu", "cuda"):
        estimator = load(name, device)
        results = [
            estimator.predict(one.rgb, one.depth, one.intrinsics, seed=i)
            for i, (_, one) in enumerate(frames)
        ]
        poses = torch.stack([torch.as_tensor(one.pose) for one in results]).double()
        points = estimator.object_models[0].points.double().cpu()
        errors[device], symmetric[device] = add(poses, truth, points), add_s(poses, truth, points)
        probability[device] = torch.tensor([one.probability for one in results])
    scenes = [scene for scene, _ in frames]
    cells = [name, str(len(frames))]
    for one in (errors, symmetric):
        for device in ("cpu", "cuda"):
            low, high = bound_auc(scenes, one[device])
            cells.append(f"{auc(one[device]):.1f} [{low:.1f}, {high:.1f}]")
    # a lost estimate is lost by meters, or by centimeters: beyond one they count the same
    less = (errors["cuda"].clamp_max(0.1) - errors["cpu"].clamp_max(0.1)) * 1000
    spread = 1.96 * less.std() / len(less) ** 0.5
    cells.append(f"{less.mean():+.2f} ± {spread:.2f}")
    cells.append(f"{(probability['cuda'] - probability['cpu']).mean():+.4f}")
    return [cells]


def run_filter(method: PoseEstimator, batch: Batch) -> None:
    """Search a batch once."""
    with torch.no_grad():
        method.filter(batch, method, method.generator("predict", 0))


def build_paper() -> PoseEstimator:
    """Return the paper's fifth method, untrained: what it costs does not depend on its weights."""
    config = posefilter.compose(["model=pose_pf", "variant=paper", f"model.pixels={POINTS}"])
    return posefilter.build(config)


def measure_times(name: str, frames: Sequence[tuple[str, Sample]], repeats: int) -> Rows:
    """Return the times of searches on both."""
    samples = [one for _, one in frames[:8]]
    stacked = stack(samples)
    single = tuple(part[0] for part in stacked)
    found: dict[str, dict[str, float]] = {}
    for device in ("cuda", "cpu"):
        many = repeats if device == "cuda" else max(2, repeats // 5)
        plain = load(name, device)
        whole = load(name, device, *PAPER, *ONCE, f"model.pixels={POINTS}").methods[0]
        own = make_search(whole, samples[0])
        rows = {
            "an image": clock(lambda e=plain: e.predict(*single), many),
            "an image of a batch of 8": clock(lambda e=plain: e.predict(*stacked), many) / 8,
            "the paper's filter, this likelihood": clock(
                lambda m=whole, b=own: run_filter(m, b), 1 if device == "cpu" else repeats
            ),
        }
        paper = build_paper()
        paper.set_object(plain.object_models[0])
        paper = paper.to(device).eval()
        rows["the paper's filter and its network"] = clock(
            lambda m=paper, b=own: run_filter(m, b), 1 if device == "cpu" else repeats
        )
        found[device] = rows
        for words, ms in rows.items():
            print(device, words, f"{ms:.1f} ms", flush=True)
    own = found["cuda"]
    return [
        [words, f"{ms:.0f}", f"{own[words]:.1f}", f"{ms / own[words]:.1f}"]
        for words, ms in found["cpu"].items()
    ]


def put_tables(rows: dict[str, Rows]) -> None:
    """Put rows into the page."""
    page = PAGE.read_text()
    for title, lines in rows.items():
        if title in HEADS:
            page = put_table(page, title, HEADS[title], map(format_row, lines))
    PAGE.write_text(page)


def show(title: str, rows: Iterable[Sequence[str]]) -> None:
    """Print a table."""
    print(title, format_row(HEADS[title]), *map(format_row, rows), sep="\n", flush=True)


def main() -> None:
    """Measure, print and write; or put what was written into the page."""
    parser = make_parser(__doc__)
    parser.add_argument("--table", type=Path, help="rows that were written before")
    parser.add_argument("--root", help="held-out renders in the format of Falling Things")
    parser.add_argument("--meshes", help="a folder of YCB's meshes")
    parser.add_argument("--only", nargs="+", default=["003_cracker_box"], help="the objects")
    parser.add_argument("--images", type=int, default=100, help="of each object")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2, help="of the CPU")
    parser.add_argument("--out", type=Path, default=Path("gpu.json"))
    options = parser.parse_args()
    if options.table:
        put_tables(json.loads(options.table.read_text()))
        return
    if not torch.cuda.is_available():
        raise SystemExit("torch finds no GPU here")
    torch.set_num_threads(options.threads)
    frames = {
        name: read_frames(options.root, options.meshes, name, options.images, split={"test": 1.0})
        for name in options.only
    }
    name, first = next(iter(frames.items()))
    rows: dict[str, Any] = {"device": device_name(torch.device("cuda")), "versions": versions()}
    rows["gpu times"] = measure_times(name, first, options.repeats)
    rows["gpu scores"] = compare_scores(name, first[0][1])
    rows["gpu estimates"] = [
        row for name, own in frames.items() for row in compare_estimates(name, own)
    ]
    for title in HEADS:
        show(title, rows[title])
    options.out.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
