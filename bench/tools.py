"""Train and test all five methods on hand tools made of parts.

    python bench/tools.py --meshes DIR [--only TOOL] [--list] [KEY=VALUE ...]

DIR holds YCB's <class>/google_16k. Scenes of the tools among each other are rendered once. The
three methods that estimate a pose learn a whole tool; the two detectors learn each of its parts as
an object of its own. Started again, it goes on: what has its metrics.json is not run again. What is
typed beyond the options, such as threads=1, is handed to every training. Last, the table of
docs/data_meshes.md is written.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from marked import format_row, put_table
from photographs import link_meshes
from programs import HOME, make_parser, run_command

from posefilter.meshes.store import MeshStore

ROOT = Path("outputs/tools")
PAGE = HOME / "docs" / "data_meshes.md"
TOOLS = ("048_hammer", "051_large_clamp", "043_phillips_screwdriver")
CLUTTER = ("037_scissors", "042_adjustable_wrench", "044_flat_screwdriver", "035_power_drill")
POSE, DETECT = ("pixel_pf", "patch_pf", "pose_pf"), ("cnn_patch", "downsized")
STEPS = {"pixel_pf": 1500, "patch_pf": 1500, "pose_pf": 1000, "cnn_patch": 800, "downsized": 800}
SPLIT = "data.split={train: 0.8, val: 0.05, test: 0.15}"
HEAD = ("tool", "method", "learned", "steps", "images", "box IoU", "part", "part box IoU")
HEAD += ("part mask IoU", "ADD AUC", "ADD-S AUC")


class Run(NamedTuple):
    """A training of one method on a tool, or on a part of one (`TOOL.PART`)."""

    model: str
    object: str

    @property
    def folder(self) -> Path:
        """Return where it is written, below the home folder."""
        return ROOT / "runs" / f"{self.model}_{self.object}"


def plan(tool: str, parts: Sequence[str]) -> list[Run]:
    """Return the trainings of one tool."""
    whole = [Run(model, tool) for model in POSE]
    return whole + [Run(model, f"{tool}.{part}") for model in DETECT for part in parts]


def render_command(seed: int, tool: str) -> list[str]:
    """Return what to run to render the scenes whose target is a tool."""
    words = [f"out={ROOT / 'data' / tool}", f"object={tool}", f"seed={seed}", "frames=300"]
    words += ["frames_per_scene=2", "size=[320,240]", "distractors=[3,7]", "lookalike_texture=same"]
    return ["generate.py", *words, f"meshes={ROOT / 'meshes'}"]


def train_command(run: Run, more: Sequence[str]) -> list[str]:
    """Return what to run to train and test one method."""
    steps = STEPS[run.model]
    words = [f"model={run.model}", f"out={run.folder}", "data=fat", f"data.root={ROOT / 'data'}"]
    words += [f"data.meshes={ROOT / 'meshes'}", f"data.object={run.object}", SPLIT]
    words += [f"trainer.max_steps={steps}", f"trainer.val_check_interval={steps}", "seed=0"]
    words += ["data.min_visibility_test=0.3", "data.limit_val=8", "data.limit_test=100"]
    if run.model == "pose_pf":
        words += ["warm_start=weights/003_cracker_box.ckpt", "data/augment=camera"]
    return ["train.py", *words, *more]


def tabulate(run: Run, metrics: dict[str, Any]) -> list[str]:
    """Return a run's rows of the table, one a part; its own figures stand in the first."""
    tool, _, part = run.object.partition(".")
    steps = str(metrics["training"]["steps"])
    first = [tool, f"`{run.model}`", part or "whole", steps, str(metrics["instances"])]
    first.append(_show(metrics.get("iou"), 3))
    if part:
        return [format_row([*first, part, *["–"] * 4])]
    errors = [_show((metrics.get(name) or {}).get("auc"), 1) for name in ("add", "add_s")]
    rows = []
    for i, (name, each) in enumerate(metrics["parts"]["by_part"].items()):
        own = [_show(each[key], 3) for key in ("box_iou", "mask_iou")]
        cells = [*first, name, *own, *errors] if i == 0 else [*[""] * 6, name, *own, "", ""]
        rows.append(format_row(cells))
    return rows


def _show(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def read_rows(runs: Sequence[Run]) -> Iterator[str]:
    """Yield the rows of the runs that are done."""
    for run in runs:
        file = HOME / run.folder / "metrics.json"
        if file.is_file():
            yield from tabulate(run, json.loads(file.read_text()))


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    parser.add_argument("--meshes", type=Path, required=True)
    parser.add_argument("--only", choices=TOOLS, help="one tool")
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    options = parser.parse_args()
    store = MeshStore(str(options.meshes))
    runs = {tool: plan(tool, tuple(store.load(tool).parts or ())) for tool in TOOLS}
    lines = [
        render_command(seed, tool)
        for seed, tool in enumerate(TOOLS, start=1)
        if not (HOME / ROOT / "data" / tool / "preview.png").is_file()
    ]
    for tool in [options.only] if options.only else TOOLS:
        todo = [run for run in runs[tool] if not (HOME / run.folder / "metrics.json").is_file()]
        lines += [train_command(run, options.more) for run in todo]
    worst = 0
    if lines and not options.list:
        link_meshes(HOME / ROOT, options.meshes, (*TOOLS, *CLUTTER))
    for words in lines:
        worst = max(worst, run_command(words, options.list))
    if not options.list:
        rows = [row for tool in TOOLS for row in read_rows(runs[tool])]
        PAGE.write_text(put_table(PAGE.read_text(), "tools", HEAD, rows))
    return worst


if __name__ == "__main__":
    sys.exit(main())
