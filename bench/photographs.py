"""Run every run behind docs/results/photographs.md: filters of YCB objects, trained on renders,
tested on photographs.

    python bench/photographs.py --meshes DIR --frames DIR [--list] [--only NAME] [KEY=VALUE ...]
    python bench/photographs.py --table          # only writes docs/results/photograph_runs.csv

DIR of --meshes holds YCB's <class>/google_16k, DIR of --frames YCB-Video. One set of scenes is
rendered for all objects: each of fourteen is the target of some, and stands in the clutter of
others, so that one frame teaches several filters. Started again, it goes on: what has its
metrics.json is not run again. What is typed beyond the options, such as threads=1, is handed to
every training.
"""

import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from photograph_runs import (
    CLUTTER,
    CRACKER,
    DIM,
    FAR,
    FIFTH,
    FOURTH,
    OBJECTS,
    SIXTH,
    SIXTH_RUNS,
    SIXTH_SPLIT,
    SPLIT,
    TARGETS,
    THIRD,
    TRAIN_SPLIT,
    Run,
    plan,
)
from programs import HOME, make_parser, run_command

RUNS = HOME / "docs" / "results" / "photograph_runs.csv"
HEAD = ["tested on", "run", "object", "method", "augment", "warm start", "steps", "CPU min"]
HEAD += ["images", "ADD AUC", "ADD-S AUC", "ADD < 0.1 d %", "ADD-S < 0.1 d %", "median mm"]
HEAD += ["outscored %"]
FEW = 10  # images, at least: with fewer, "photographs" are YCB-Video's own renders
# name, folder of the evaluation, whether of few images
TESTS = (("renders", "renders", False), ("photographs", "photographs", False))
TESTS += (("ycb_video renders", "photographs", True),)


def render_commands(
    root: Path,
    frames: int = 300,
    folder: str = "data",
    first_seed: int = 1,
    lookalike_texture: str = "same",
) -> list[list[str]]:
    """Return what to run to render the scenes, one command an object.

    A seed decides a frame's camera, lights and layout whatever the object is. With one seed for all
    objects, as the runs before `shipped` had it, 14 x 180 frames have no more than 180 layouts and
    30 sets of backgrounds and distractors.
    """
    return [
        render_command(root / folder / name, name, seed, frames, lookalike_texture, root)
        for seed, name in enumerate(TARGETS, start=first_seed)
    ]


def render_command(
    out: Path, name: str, seed: int, frames: int, lookalike_texture: str, root: Path
) -> list[str]:
    """Return what to run to render the scenes of one object."""
    common = [f"frames={frames}", "frames_per_scene=2", "size=[320,240]", "distractors=[4,10]"]
    common += [f"lookalike_texture={lookalike_texture}", f"meshes={root / 'meshes'}"]
    return ["generate.py", f"out={out}", f"object={name}", f"seed={seed}", *common]


def list_sets(root: Path) -> list[list[list[str]]]:
    """Return the commands of each set but the first: that of the tests, and four to learn from."""
    third = render_commands(root, 400, THIRD, 101)
    fourth = render_commands(root, 400, FOURTH, 201, "different")
    fifth = render_commands(root, 400, FIFTH, 501, "different")
    sixth = [
        render_command(root / SIXTH / OBJECTS[name], OBJECTS[name], seed, frames, "different", root)
        for name, (seed, frames, _) in SIXTH_RUNS.items()
    ]
    return [render_commands(root), third, fourth, fifth, sixth]


def train_command(run: Run, root: Path, more: Sequence[str] = ()) -> list[str]:
    """Return what to run to train and test one filter on renders."""
    data = ["data=fat", f"data.root={root / run.scenes}", f"data.meshes={root / 'meshes'}"]
    splits = {"data": SPLIT, SIXTH: SIXTH_SPLIT}
    data += [f"data.object={run.object}", splits.get(run.scenes, TRAIN_SPLIT)]
    interval = max(500, run.steps // 4)
    budget = [f"trainer.max_steps={run.steps}", f"trainer.val_check_interval={interval}"]
    budget.append("data.min_visibility_test=0.3")
    words = run.words.format(root=root).split()
    validation = [] if "data.limit_val" in run.words else ["data.limit_val=40"]
    out = f"out={root / 'runs' / run.name}"
    return ["train.py", f"model={run.model}", out, *data, *budget, *validation, *words, *more]


def evaluate_commands(run: Run, root: Path, meshes: str, frames: str) -> list[list[str]]:
    """Return what to run to test one filter on the photographs, and on 24 of the held-out
    renders.
    """
    checkpoint = root / "runs" / run.name / "checkpoints" / "best.ckpt"
    photographs = ["data=ycb_video", f"data.root={frames}", f"data.meshes={meshes}"]
    renders = ["data=fat", f"data.root={root / 'data'}", f"data.meshes={root / 'meshes'}"]
    # a run on other scenes has another split: without this one, frames that taught what it began
    # with would be tested on
    renders += [SPLIT, "data.min_visibility_test=0.3", "data.limit_test=24"]
    tests = {"photographs": photographs, "renders": renders}
    common, out = ["evaluate.py", f"checkpoint={checkpoint}"], root / "evals" / run.name
    return [[*common, *where, f"out={out / name}"] for name, where in tests.items()]


def link_meshes(root: Path, meshes: Path, names: Sequence[str] = (*TARGETS, *CLUTTER)) -> None:
    """Make a folder that holds links to the meshes in use: with fewer kinds of clutter, each kind
    is seen more often.
    """
    folder = root / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        link = folder / name
        if not link.is_symlink():
            link.symlink_to((meshes / name).resolve())


def row(run: Run, root: Path, where: str) -> list[str] | None:
    """Return a run's row of renders or photographs without its first cell, or None where there is
    none.
    """
    own = _read(root / "runs" / run.name / "metrics.json")
    tested = _read(root / "evals" / run.name / where / "metrics.json")
    if own is None or not tested or not tested["instances"]:
        return None
    words = dict(word.split("=", 1) for word in run.words.split())
    start = _tell_start(words.get("warm_start", ""))
    step = own["training"]["cpu_seconds_per_step"]  # unknown where the test was made by itself
    cost = "" if step is None else f"{own['training']['steps'] * step / 60:.1f}"
    first = [run.name, run.object, run.model, _tell_augment(run), start, str(run.steps), cost]
    return [*first, *_figures(tested)]


def _tell_augment(run: Run) -> str:
    """Return the choice of augmentation, and what it did to the object."""
    choice = run.words.split("data/augment=")[1].split()[0]
    if not choice.startswith("camera"):
        return choice
    bare = ".probability=0 " in run.words
    marks = ["far"] if FAR in run.words else []
    marks += [] if bare else ["labels"] if DIM in run.words else ["labels", "bright"]
    return ", ".join([choice, *marks])


def _tell_start(checkpoint: str) -> str:
    """Return what a training began with, in words."""
    if not checkpoint:
        return "none"
    if checkpoint == CRACKER:
        return "cracker box"
    return "shipped" if checkpoint.startswith("weights/") else checkpoint.split("/")[2]


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None


def _figures(metrics: dict[str, Any]) -> list[str]:
    add, add_s, belief = metrics["add"], metrics["add_s"], metrics.get("belief") or {}
    outscored = belief.get("truth_outscored_by_wrong")
    wrong = "" if outscored is None else f"{100 * outscored:.0f}"
    figures = (add["auc"], add_s["auc"], add["recall_01d"], add_s["recall_01d"], add["median_mm"])
    return [str(metrics["instances"]), *(f"{figure:.1f}" for figure in figures), wrong]


def write_runs(root: Path, path: Path = RUNS) -> None:
    """Put the runs that are there into the file of runs; rows of others stay as they are.

    What YCB-Video has of an object that is in neither sequence, two or three rendered frames, is no
    photograph: it counts as a test of its own.
    """
    with path.open(newline="") as file:
        rows = {tuple(row[:2]): row for row in list(csv.reader(file))[1:]}
    for title, where, few in TESTS:
        for run in plan():
            cells = row(run, root, where)
            if cells is not None and (int(cells[7]) < FEW) == few:
                rows[title, run.name] = [title, *cells]
    keys = ((title, run.name) for title, _, _ in TESTS for run in plan())
    with path.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [HEAD, *(rows[k] for k in keys if k in rows)]
        )


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = make_parser(__doc__)
    parser.add_argument("more", nargs="*")
    parser.add_argument("--meshes", type=Path, help="a folder of YCB's meshes")
    parser.add_argument("--frames", help="a folder of YCB-Video")
    parser.add_argument("--only", action="append", choices=[run.name for run in plan()])
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    parser.add_argument("--table", action="store_true", help="only write the file of runs")
    parser.add_argument("--root", type=Path, default=Path("outputs/photographs"))
    options = parser.parse_args()
    if options.table:
        write_runs(options.root)
        return 0
    if not options.meshes or not options.frames:
        parser.error("--meshes and --frames are needed")
    link_meshes(options.root, options.meshes)
    commands = [(words, None) for each in list_sets(options.root) for words in each]
    for run in plan():
        if options.only and run.name not in options.only:
            continue
        commands.append(
            (train_command(run, options.root, options.more), options.root / "runs" / run.name)
        )
        tests = evaluate_commands(run, options.root, str(options.meshes), options.frames)
        commands += [(words, Path(words[-1].removeprefix("out="))) for words in tests]
    worst = 0
    for words, done in commands:
        skip = options.list or (done is not None and (done / "metrics.json").is_file())
        worst = max(worst, run_command(words, skip))
    if not options.list:
        write_runs(options.root)
    return worst


if __name__ == "__main__":
    sys.exit(main())
