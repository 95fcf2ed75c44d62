"""How accurate `patch_pf` is against how much of an image it reads and computes.

    python bench/sparse.py [--images 20]

The runs are those of `python bench/methods.py --only sparse`, and of `sparse_particles_unet`, ...
for fewer particles. Accuracy is over all images of their
tests, and its interval over scenes and seeds; pixels and operations are counted on the first
`--images` of them, with the weights of one seed. A pixel counts as read if the network over the
image reads it, or if it lies under the patches of a particle in any step. Writes the tables
of docs/results/sparse.md.
"""

from copy import deepcopy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from batches import list_counts
from comparisons import bootstrap, list_choices, measure_auc, measure_recall
from marked import format_row, put_table
from programs import HOME, make_parser
from torch.utils.data import default_collate
from torch.utils.flop_counter import FlopCounterMode

from posefilter.cli.build import build_data
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.command import compose_job
from posefilter.geometry.lookup import patch_offsets
from posefilter.metrics.image_errors import FILE, read_errors
from posefilter.models.image_space import ImageSpace
from posefilter.nets.encoders import FoveatedEncoder, NoEncoder
from posefilter.report.gather import read_json
from posefilter.types import Batch

PAGE = HOME / "docs" / "results" / "sparse.md"
NAMES = {  # what is chosen, and how the table has it
    ("unet", "", ""): "network over the image",
    ("unet", "80", ""): "the same at half the width",
    ("unet", "40", ""): "the same at a quarter of the width",
    ("pyramid", "", ""): "averages of blocks, not learned",
    ("foveated", "", ""): "foveated patches",
    ("foveated", "", "320"): "foveated patches, images twice as wide",
    ("none", "", ""): "a particle's own patch alone",
}
PARTICLES = 128  # the preset's
CHOICES = ("model/encoder", "model.encoder.max_width_px", "data.image_width")
ENCODERS = ("unet", "foveated", "none")  # that are tested with fewer particles


class Kind(NamedTuple):
    """The tests of one choice, by seed: their folders, and those of the runs that they test."""

    name: str
    particles: int
    tests: list[Path]
    runs: list[Path]


class Cost(NamedTuple):
    """What an estimate reads and computes, in the mean over images."""

    pixels: float
    share: float  # of the image's pixels
    encoder: float  # operations, additions and multiplications each counted [1e9]
    particles: float  # those of all that follows the encoder


def find_kinds(root: Path) -> list[Kind]:
    """Return the tests of each choice and number of particles, in the order of the names."""
    found: dict[tuple[str, int], Kind] = {}
    for file in sorted(root.rglob("metrics.json")):
        metrics = read_json(file)
        run = Path(metrics["checkpoint"]).parents[1]
        run = run if run.is_absolute() else HOME / run
        trained, typed = (list_choices(one) for one in (read_json(run / file.name), metrics))
        name = NAMES[*(trained.get(key, "") for key in CHOICES)]
        particles = int(typed.get("filter.particles", PARTICLES))
        kind = found.setdefault((name, particles), Kind(name, particles, [], []))
        kind.tests.append(file.parent)
        kind.runs.append(run)
    names = list(NAMES.values())
    return sorted(found.values(), key=lambda kind: (names.index(kind.name), -kind.particles))


def load(run: Path, images: int) -> tuple[ImageSpace, list[Batch]]:
    """Return a run's method, and the first images of its test."""
    checkpoint = read_checkpoint(run / "checkpoints" / "best.ckpt")
    method = method_of(checkpoint, lightning=False).eval()
    assert isinstance(method, ImageSpace)
    job = compose_job("train", HOME / "conf", read_json(run / "metrics.json")["overrides"], Path())
    data = build_data(job.cfg.data, "json", job.overrides)
    data.setup("test")
    count = min(images, len(data.test_dataset))
    return method, [default_collate([data.test_dataset[i]]) for i in range(count)]


def count_pixels(method: ImageSpace, batch: Batch, steps: list[Any]) -> int:
    """Return how many pixels of an image an estimate read.

    steps: The encoded image and the particles of each step.
    """
    height, width = batch.rgb.shape[-2:]
    if not isinstance(method.encoder, NoEncoder | FoveatedEncoder):
        return height * width
    read = torch.zeros(height, width, dtype=torch.bool)
    own = patch_offsets(method.glimpse.size)
    for encoding, state in steps:
        # a sample between pixels is a mean of four
        corners = state.floor().long()[:, :, None] + patch_offsets(2)
        places = [(corners[:, :, :, None] + own).flatten(1, 3)]
        if isinstance(method.encoder, FoveatedEncoder):
            index, _ = method.encoder.place_patches(encoding.context, state)
            places.append(index.flatten(1, 3))
        for u, v in (place[0].unbind(-1) for place in places):
            inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            read[v[inside], u[inside]] = True
    return int(read.sum())


def measure_cost(method: ImageSpace, batches: list[Batch], particles: int) -> Cost:
    """Return what estimates read and compute."""
    method.filter.particles = method.filter.initial_particles = particles
    steps: list[Any] = []
    measure, own = method.measure, []

    def watched(encoding: Any, particles: Any, *more: Any) -> Any:
        steps.append((encoding, particles.state.detach().clone()))
        return measure(encoding, particles, *more)

    plain = deepcopy(method).train()  # whose layers are torch's own, which its counter knows
    method.measure = watched  # type: ignore[method-assign]
    for batch in batches:
        steps.clear()
        with torch.no_grad():
            method.predict_step(batch, 0)
            with FlopCounterMode(display=False, custom_mapping=list_counts()) as whole:
                plain.predict_step(batch, 0)
            with FlopCounterMode(display=False, custom_mapping=list_counts()) as image:
                plain.encode(batch)
        pixels = count_pixels(method, batch, steps)
        size = batch.rgb.shape[-2] * batch.rgb.shape[-1]
        total, encoder = whole.get_total_flops(), image.get_total_flops()
        own.append(Cost(pixels, pixels / size, encoder / 1e9, (total - encoder) / 1e9))
    return Cost(*np.mean(own, axis=0))


def describe(kind: Kind, images: int) -> str:
    """Return a row."""
    rows = [read_errors(test / FILE) for test in kind.tests]
    cost = measure_cost(*load(kind.runs[0], images), kind.particles)
    cells = [kind.name, *([str(kind.particles)] if kind.particles != PARTICLES else [])]
    cells += [bootstrap(rows, measure_auc), bootstrap(rows, measure_recall)]
    cells += [f"{cost.pixels:,.0f}", f"{100 * cost.share:.0f} %"]
    return format_row([*cells, f"{cost.encoder:.2f}", f"{cost.particles:.2f}"])


def main() -> None:
    """Count, and write the table."""
    parser = make_parser(__doc__)
    made = HOME / "outputs" / "methods"
    roots = [made / "sparse", *(made / f"sparse_particles_{name}" for name in ENCODERS)]
    parser.add_argument("--root", type=Path, nargs="+", default=roots, help="folders of tests")
    parser.add_argument("--images", type=int, default=20)
    options = parser.parse_args()
    kinds = [kind for root in options.root for kind in find_kinds(root)]
    page = PAGE.read_text()
    head = ["ADD AUC", "ADD < 0.1 d %", "pixels read", "of the image"]
    head += ["10⁹ operations: network over the image", "all particles"]
    for title, few in (("sparse", False), ("few", True)):
        rows = []
        for kind in kinds:
            if (kind.particles != PARTICLES) == few:
                rows.append(describe(kind, options.images))
                print(rows[-1], flush=True)
        more = ["", "particles"] if few else [""]
        page = put_table(page, title, [*more, *head], rows)
    PAGE.write_text(page)


if __name__ == "__main__":
    main()
