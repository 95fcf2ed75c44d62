"""Compare beliefs on rendered validation scenes: as the filter leaves them, with its weights raised
to a power, and drawn anew by importance sampling at several temperatures.

    python bench/beliefs.py --weights 003_cracker_box ... --root DIR --meshes DIR [--frames 40]
        [--samples 400] [--pixels 256] [--out FILE.json]

`--root` holds a folder an object.  Every object's filter runs once an image; all variants are of
the same run.  For each variant: the coverage of the 50, 80, 90 and 95 % credible sets, the log
density of the truth (mean and median, see docs/belief.md) and the effective particles, of all
images and of those whose visibility is below and above one half.  The density knows the symmetries
that the checkpoint's object has.
"""

import json
import sys
from pathlib import Path
from typing import Any

import torch
from marked import format_table
from programs import HOME, make_parser

from posefilter.cli.build import build_data
from posefilter.cli.checkpoints import method_of, read_checkpoint
from posefilter.cli.command import compose_job
from posefilter.cli.evaluate import data_settings
from posefilter.data.absent import hide_annotation
from posefilter.data.loaders import make_loader
from posefilter.filters.importance import ImportanceSampling
from posefilter.metrics.credibility import SHOWN, measure_coverage, score_truth
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, BeliefBatch

SPLIT = "data.split={train: 0.8, val: 0.05, test: 0.15}"
POWERS = (1.0, 0.5, 0.25, 0.1)
TEMPERATURES = (0.1, 0.25, 0.5, 1.0, 2.0)
HEAD = ("variant", "frames", *(f"{level} %" for level in SHOWN), "log density", "median", "ESS")


def list_variants(
    belief: BeliefBatch, scene: Any, method: PoseEstimator, batch_number: int, options: Any
) -> dict[str, BeliefBatch]:
    """Return the beliefs to compare, by name."""
    out = {}
    for power in POWERS:
        weights = (power * belief.log_weights).log_softmax(1)
        out["as the filter leaves it" if power == 1 else f"weights ^ {power:g}"] = belief._replace(
            log_weights=weights
        )
    first = ImportanceSampling(options.samples, 1, options.widening, pixels=options.pixels)
    generator = method.generator("predict", batch_number)
    drawn, log_q = first.propose(
        belief.poses, belief.log_weights, method, options.widening, generator
    )
    score = method.score_poses(scene, drawn, first.sigma, generator, first.pixels).double()  # type: ignore[operator]
    for temperature in TEMPERATURES:
        for prior, log_prior in (("flat", 0.0), ("kernels", log_q)):
            weights = (score / temperature + log_prior - log_q).log_softmax(1)
            one = belief._replace(poses=drawn, log_weights=weights)
            out[f"importance, prior {prior}, T = {temperature:g}"] = one
    return out


def collect(name: str, options: Any) -> list[dict[str, Any]]:
    """Return a row an image and variant."""
    checkpoint = read_checkpoint(name)
    method = method_of(checkpoint, lightning=False)
    method.seed = 0
    own = method.object_model.name
    words = [f"checkpoint={name}", "data=fat", f"data.root={options.root / own}"]
    words += [f"data.meshes={options.meshes}", SPLIT, "data.min_visibility_test=0.1"]
    job = compose_job("calibrate", HOME / "conf", words, Path())
    settings = data_settings(job, checkpoint["recipe"]["settings"], own, "val")
    settings.limit_val = options.frames
    data = build_data(settings, "json")
    data.setup("validate")
    rows = []
    for number, batch in enumerate(make_loader(data.val_dataset, 8, 0)):
        seen = Batch(*hide_annotation(batch))
        with torch.no_grad():
            belief = method.predict_step(seen, number).belief
            variants = list_variants(belief, method.encode(seen), method, number, options)
        for variant, one in variants.items():
            scores = score_truth(one, batch.camera_from_object, method.object_model)
            ess = 1 / one.log_weights.double().exp().square().sum(1)
            columns = (scores.log_density, scores.rank, batch.visibility, ess)
            for values in zip(*(x.tolist() for x in columns), strict=True):
                keys = ("log_density", "rank", "visibility", "ess")
                rows.append(
                    {"object": own, "variant": variant, **dict(zip(keys, values, strict=True))}
                )
        print(f"{own}: {len(rows) // len(variants)} frames", file=sys.stderr, flush=True)
    return rows


def tabulate(rows: list[dict[str, Any]]) -> str:
    """Return the numbers of some images as a Markdown table, a row a variant."""
    lines = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        own = [row for row in rows if row["variant"] == variant]
        rank, density, ess = (
            torch.tensor([row[key] for row in own]).double()
            for key in ("rank", "log_density", "ess")
        )
        cells = [variant, str(len(own))]
        cells += [f"{100 * measure_coverage(rank, level / 100):.0f}" for level in SHOWN]
        cells += [f"{density.mean():.2f}", f"{density.median():.2f}", f"{ess.mean():.0f}"]
        lines.append(cells)
    return format_table(HEAD, lines)


def main() -> int:
    """Print the tables."""
    parser = make_parser(__doc__)
    parser.add_argument("--weights", nargs="+", required=True)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--samples", type=int, default=400)
    parser.add_argument("--pixels", type=int, default=256)
    parser.add_argument("--widening", type=float, default=2.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for name in options.weights:
        rows += collect(name, options)
        if options.out is not None:
            options.out.write_text(json.dumps(rows))
        print(f"\n{name}\n\n{tabulate([row for row in rows if row['object'] in name])}", flush=True)
    for label, low, high in (("visibility below 0.5", 0, 0.5), ("0.5 and above", 0.5, 2)):
        own = [row for row in rows if low <= row["visibility"] < high]
        print(f"\nall objects, {label}\n\n{tabulate(own)}", flush=True)
    print(f"\nall objects\n\n{tabulate(rows)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
