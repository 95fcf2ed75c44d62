"""Train and test all five methods on hand tools made of parts.

    python bench/tools.py --meshes DIR [--only TOOL] [--parts [--seeds 0 1]] [--list] [KEY=VALUE]

DIR holds YCB's <class>/google_16k. Scenes of the tools among each other are rendered once. The
three methods that estimate a pose learn a whole tool; the two detectors learn each of its parts as
an object of its own. Started again, it goes on: what has its metrics.json is not run again. What is
typed beyond the options, such as threads=1, is handed to every training. Last, the table of
docs/data_meshes.md is written.

With --parts pose_pf alone is trained, with each seed, and the same weights are tested with its
filter and with particles of each part that pass messages (models/parts_pf.py); that table is
written.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import marked
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
BY_PARTS = (
    "model._target_=posefilter.models.parts_pf.PartsPF",
    "filter/resample=within_parts",
)
WIDE = ("model.translation_mm=1e5", "model.rotation_deg=1e5")  # messages that say nothing
FILTERS = {"pose_pf": (), "parts_pf": BY_PARTS, "no_messages": (*BY_PARTS, *WIDE)}
ENDS = {"refined": (), "plain": ("filter/refine=none",)}
ERRORS = {"ADD AUC": ("add", "auc"), "ADD-S AUC": ("add_s", "auc")}
IOUS = {"part box IoU": ("parts", "box_iou"), "part mask IoU": ("parts", "mask_iou")}
FIGURES = {**ERRORS, **IOUS}
PARTS_HEAD = (
    "tool",
    "filter",
    "seeds",
    "images",
    *FIGURES,
    *(f"{name}, plain" for name in FIGURES),
)


class Run(NamedTuple):
    """A training of one method on a tool, or on a part of one (`TOOL.PART`)."""

    model: str
    object: str
    seed: int = 0

    @property
    def folder(self) -> Path:
        """Return where it is written, below the home folder."""
        seed = f"_seed{self.seed}" if self.seed else ""
        return ROOT / "runs" / f"{self.model}_{self.object}{seed}"

    def test_folder(self, filter: str, end: str) -> Path:
        """Return where a test of its weights is written, below the home folder."""
        return ROOT / "tests" / f"{filter}_{end}_{self.object}_seed{self.seed}"


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
    words += [f"trainer.max_steps={steps}", f"trainer.val_check_interval={steps}"]
    words += [f"seed={run.seed}"]
    words += ["data.min_visibility_test=0.3", "data.limit_val=8", "data.limit_test=100"]
    if run.model == "pose_pf":
        words += ["warm_start=weights/003_cracker_box.ckpt", "data/augment=camera"]
    return ["train.py", *words, *more]


def test_command(run: Run, filter: str, end: str, more: Sequence[str]) -> list[str]:
    """Return what to run to test a training's weights with a filter, refined or plain."""
    words = [f"checkpoint={run.folder}", f"out={run.test_folder(filter, end)}", "data=fat"]
    words += [f"data.root={ROOT / 'data'}", f"data.meshes={ROOT / 'meshes'}"]
    return ["evaluate.py", *words, *FILTERS[filter], *ENDS[end], *more]


def tabulate_parts(tool: str, filter: str, seeds: Sequence[int]) -> list[str]:
    """Return the row of a filter on a tool: means over the seeds that are done; none without."""
    files = {
        end: [HOME / Run("pose_pf", tool, seed).test_folder(filter, end) / "metrics.json"
              for seed in seeds]
        for end in ENDS
    }  # fmt: skip
    done = [i for i in range(len(seeds)) if all(own[i].is_file() for own in files.values())]
    if not done:
        return []
    found = {end: [json.loads(own[i].read_text()) for i in done] for end, own in files.items()}
    cells = [tool, f"`{filter}`", ", ".join(str(seeds[i]) for i in done)]
    cells.append(str(found["plain"][0]["instances"]))
    for end in ENDS:
        for name, (group, key) in FIGURES.items():
            mean = sum(one[group][key] for one in found[end]) / len(done)
            cells.append(_show(mean, 1 if name in ERRORS else 3))
    return [format_row(cells)]


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


def group_rows(lines: Sequence[str]) -> dict[str, list[str]]:
    """Return a table's rows by tool; one whose first cell is empty belongs to the row above."""
    out: dict[str, list[str]] = {}
    tool = ""
    for line in lines:
        tool = line.split("|")[1].strip() or tool
        out.setdefault(tool, []).append(line)
    return out


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
    parser.add_argument("--parts", action="store_true", help="test pose_pf by parts")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="with --parts")
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
        own = (
            [Run("pose_pf", tool, seed) for seed in options.seeds] if options.parts else runs[tool]
        )
        todo = [run for run in own if not is_done(run.folder)]
        lines += [train_command(run, options.more) for run in todo]
        if options.parts:
            lines += [
                test_command(run, filter, end, options.more)
                for run, filter, end in product(own, FILTERS, ENDS)
                if not is_done(run.test_folder(filter, end))
            ]
    worst = 0
    if lines and not options.list:
        link_meshes(HOME / ROOT, options.meshes, (*TOOLS, *CLUTTER))
    for words in lines:
        worst = max(worst, run_command(words, options.list))
    if options.parts and not options.list:
        pairs = product(TOOLS, FILTERS)
        rows = [row for pair in pairs for row in tabulate_parts(*pair, options.seeds)]
        PAGE.write_text(put_table(PAGE.read_text(), "tools by parts", PARTS_HEAD, rows))
    elif not options.list:
        before, rows = group_rows(marked.read_rows(PAGE.read_text(), "tools")), list[str]()
        for tool in TOOLS:  # the rows of a tool whose runs are not all there stay
            whole = all(is_done(run.folder) for run in runs[tool])
            rows += list(read_rows(runs[tool])) if whole else before.get(tool, [])
        PAGE.write_text(put_table(PAGE.read_text(), "tools", HEAD, rows))
    return worst


def is_done(folder: Path) -> bool:
    """Tell whether a folder below the home folder has results."""
    return (HOME / folder / "metrics.json").is_file()


if __name__ == "__main__":
    sys.exit(main())
