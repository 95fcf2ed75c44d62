"""How the gradient of a roll-out grows with its length, before any training: the table `gradients`
of docs/methods.md.

    python bench/gradients.py [--into docs/methods.md] [train.py's settings ...]

Each row is a method at a ablation of its ablation, at the ablation's size; each figure the norm of
its network's gradient on the first batch of `experiment=memorize`, in units of one step's.
"""

import argparse
import math
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from methods_table import fill, mark, told

from posefilter.cli.command import compose_job
from posefilter.cli.machine import settle
from posefilter.cli.train import build_data, build_method, quiet, recipe

HOME = Path(__file__).parents[1]
STEPS = (1, 2, 4, 8, 16, 30)
LADDERS = {"cnn_patch": "ablation_detect", "patch_pf": "ablation"}
RUNGS = (
    "paper",
    "s1_glimpse",
    "s2_bounded",
    "c1_normalization",
    "c2_glimpse",
    "c3_bounded",
    "c6_position",
)


def gradient(model: str, sweep: str, ablation: str, steps: int, more: Sequence[str]) -> float:
    """Return the norm of the network's gradient of one batch, rolled out for so many steps."""
    with tempfile.TemporaryDirectory() as folder:
        said = [
            f"model={model}",
            "experiment=memorize",
            f"sweep={sweep}",
            f"ablation={ablation}",
            "seed=0",
            f"filter.steps={steps}",
        ]
        job = compose_job("train", HOME / "conf", [*said, *more], Path(folder))
    settle(job.cfg.threads, job.cfg.seed)
    data = build_data(job.cfg.data, "json")
    data.setup("fit")
    method = build_method(recipe(job))
    method.set_object(data.object_model(0))
    batch = next(iter(data.train_dataloader()))
    method.training_step(batch, 0).backward()
    parts = [p.grad.double().norm() for p in method.net.parameters() if p.grad is not None]
    return float(torch.stack(parts).norm())


def table(more: Sequence[str]) -> str:
    """Return all rows as Markdown, each said as soon as it is measured."""
    lines = [
        f"| method | ablation | {' | '.join('1 step' if n == 1 else f'{n} steps' for n in STEPS)} "
        f"|",
        "| --- " * (2 + len(STEPS)) + "|",
    ]
    for model, sweep in LADDERS.items():
        for ablation in RUNGS:
            norms = [gradient(model, sweep, ablation, steps, more) for steps in STEPS]
            cells = [written(norm / norms[0]) for norm in norms]
            lines.append(f"| {model} | {told(f'ablation={ablation}')} | {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    return "\n".join(lines)


def written(number: float) -> str:
    """Return a number in one or two digits; `overflows` where it is more than 32 bits hold."""
    if not math.isfinite(number):
        return "overflows"
    if number < 10:
        return f"{number:.1f}"
    if number < 1e5:
        return f"{float(f'{number:.2g}'):,.0f}"
    digit, power = f"{number:.0e}".split("e")
    return f"{digit}e{int(power)}"


def main() -> int:
    """Measure, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("more", nargs="*")
    parser.add_argument("--into", type=Path, default=HOME / "docs" / "methods.md")
    options = parser.parse_args()
    page = options.into.read_text()
    if not re.search(mark("gradients"), page):
        parser.error(f"{options.into} has no mark <!-- table: gradients -->")
    quiet()
    rows = table(options.more)
    options.into.write_text(fill(page, "gradients", lambda _: rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
