"""How the gradient of a roll-out grows with its length, before any training: a table of
docs/analysis/failures.md.

    python bench/gradients.py [--only ABLATION] [train.py's settings ...]   # --only may be repeated

Each row is a method at an ablation; each figure the norm of
its network's gradient on the first batch of `experiment=memorize`, in units of one step's.
"""

import math
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from programs import HOME, make_parser

from posefilter.cli.ablations import ABLATIONS
from posefilter.cli.build import build_data, quiet
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.cli.machine import settle

DESCRIPTIONS = {row.name: f"`{row.name}` {row.description}" for row in ABLATIONS}
STEPS = (1, 2, 4, 8, 16, 30)
SIZES = {"cnn_patch": "filter.particles=32", "patch_pf": "preset/size=patch_pf"}
SHOWN = (
    "paper", "s1_glimpse", "s2_bounded", "c1_normalization", "c2_glimpse", "c3_bounded",
    "c6_position",
)  # fmt: skip


def gradient(model: str, ablation: str, steps: int, more: Sequence[str]) -> float:
    """Return the norm of the network's gradient of one batch, rolled out for so many steps."""
    with tempfile.TemporaryDirectory() as folder:
        chosen = [f"model={model}", "experiment=memorize", f"ablation={ablation}", "seed=0"]
        chosen += [f"filter.steps={steps}", SIZES[model]]
        job = compose_job("train", HOME / "conf", [*chosen, *more], Path(folder))
    settle(job.cfg.threads, job.cfg.seed)
    data = build_data(job.cfg.data, "json")
    data.setup("fit")
    method = build_method(recipe(job))
    method.set_object(data.object_to_learn())
    batch = next(iter(data.train_dataloader()))
    method.training_step(batch, 0).backward()
    parts = [p.grad.double().norm() for p in method.net.parameters() if p.grad is not None]
    return float(torch.stack(parts).norm())


def table(more: Sequence[str], shown: Sequence[str] = SHOWN) -> str:
    """Return all rows as Markdown; each is printed to stderr as soon as it is measured."""
    lines = [
        f"| method | ablation | {' | '.join('1 step' if n == 1 else f'{n} steps' for n in STEPS)} "
        f"|",
        "| --- " * (2 + len(STEPS)) + "|",
    ]
    for model in SIZES:
        for ablation in shown:
            norms = [gradient(model, ablation, steps, more) for steps in STEPS]
            cells = [written(norm / norms[0]) for norm in norms]
            lines.append(f"| {model} | {DESCRIPTIONS[ablation]} | {' | '.join(cells)} |")
            print(lines[-1], file=sys.stderr, flush=True)
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
    """Measure, and print the table."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    parser.add_argument("--only", action="append", choices=SHOWN)
    options = parser.parse_args()
    quiet()
    print(table(options.more, options.only or SHOWN))
    return 0


if __name__ == "__main__":
    sys.exit(main())
