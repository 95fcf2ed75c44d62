"""Run every run behind docs/results/photographs.md: filters of YCB objects, trained on renders,
tested on photographs.

    python bench/photographs.py --meshes DIR --frames DIR [--list] [--only NAME] [KEY=VALUE ...]
    python bench/photographs.py --table                      # only rewrites the page's tables

DIR of --meshes holds YCB's <class>/google_16k, DIR of --frames YCB-Video. One set of scenes is
rendered for all objects: each of fourteen is the target of some, and stands in the clutter of
others, so that one frame teaches several filters. Started again, it goes on: what has its
metrics.json is not run again. What is typed beyond the options, such as threads=1, is handed to
every training.
"""

import argparse
import json
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from marked import format_row, put_table, read_rows

HOME = Path(__file__).parents[1]
PAGE = HOME / "docs" / "results" / "photographs.md"
HEAD = ["run", "object", "method", "augment", "warm start", "steps", "CPU min", "images", "ADD AUC"]
HEAD += ["ADD-S AUC", "ADD < 0.1 d %", "ADD-S < 0.1 d %", "median mm", "outscored %"]
FEW = 10  # images, at least: with fewer, "photographs" are YCB-Video's own renders
# title, folder of the evaluation, whether of few images
TABLES = (("renders", "renders", False), ("photographs", "photographs", False))
TABLES += (("ycb_video renders", "photographs", True),)
CRACKER = "weights/003_cracker_box.ckpt"
# the seed of an object's scenes is its place
TARGETS = (
    "035_power_drill",
    "005_tomato_soup_can",
    "004_sugar_box",
    "006_mustard_bottle",
    "061_foam_brick",
    "025_mug",
    "007_tuna_fish_can",
    "010_potted_meat_can",
    "011_banana",
    "002_master_chef_can",
    "024_bowl",
    "048_hammer",
    "009_gelatin_box",
    "003_cracker_box",
)
CLUTTER = ("021_bleach_cleanser", "052_extra_large_clamp")
_STEPS = "data.augment.steps"


def _color(label: int) -> str:
    """Return the colors of camera before it made the object bright; `label`: its step of labels."""
    after = f"{_STEPS}.{label + 4}.gain=0.2 {_STEPS}.{label + 4}.probability=0.3"
    return f"{_STEPS}.{label + 1}.probability=0.5 {after}"


def _plain(label: int) -> str:
    """Return the colors of camera before it stuck labels on the object."""
    return f"{_STEPS}.{label}.probability=0 {_STEPS}.{label + 1}.gain=[1,1] {_color(label)}"


# what camera did not do at first: labels and bright objects, bright objects alone, magnification
PLAIN, DIM = _plain(4), f"{_STEPS}.5.gain=[0.8,1.3] {_color(4)}"
FAR = f"{_STEPS}.1.pivot=center {_STEPS}.1.zoom=[0.75,1.3]"
NEAR = f"{_STEPS}.1.zoom=[0.7,2.2]"
SPLIT = "data.split={train: 0.8, val: 0.05, test: 0.15}"


class Run(NamedTuple):
    """A training: its name, its object, its method, the steps, and what else is typed."""

    name: str
    object: str
    model: str
    steps: int
    words: str = ""


def plan() -> list[Run]:
    """Return all trainings; a warm start follows the run that it starts from.

    `data/augment=camera` grew while they were made: it then magnified the object, stuck labels on
    it, and made it brighter. PLAIN, DIM, FAR and NEAR put back what a run did not have. DIM's
    brightness was normal in the logarithm, which is no choice any more; this is the nearest.
    """
    whole = f"data/augment=camera_full_image {_plain(3)}"
    after_drill = f"{whole} {_after(_best('drill_patch_camera'))}"
    short = "data/augment=camera data.limit_val=2 data.limit_test=2"
    first = f"{PLAIN} {FAR}"
    pair = f"{first} data.limit_val=4 data.limit_test=20 {_after(CRACKER)}"
    few = f"{short} {first} {_after(CRACKER)}"
    strong = pair.replace(first, "data/augment=strong")

    def run(name: str, target: str, steps: int, start: str, without: str) -> Run:
        words = [short, without, _after(start)]
        return Run(name, target, "pose_pf", steps, " ".join(filter(None, words)))

    def far(name: str, target: str, steps: int, start: str = CRACKER) -> Run:
        return run(name, target, steps, start, first)

    def near(name: str, target: str, steps: int, start: str = CRACKER) -> Run:
        return run(name, target, steps, start, f"{PLAIN} {NEAR}")

    def dim(name: str, target: str, steps: int, start: str) -> Run:
        return run(name, target, steps, start, f"{DIM} {NEAR}")

    def now(name: str, target: str, steps: int, start: str) -> Run:
        return run(name, target, steps, start, "")

    def more(name: str, target: str, steps: int, start: str) -> Run:
        """From here on, the likelihood learns from all 16 images of a batch, and not from 8."""
        return run(name, target, steps, _best(start), "model.likelihood_batch_size=16")

    def shipped(name: str, target: str, steps: int) -> Run:
        """From here on, scenes differ from object to object; begun with what shipped."""
        return run(name, target, steps, f"weights/{target}.ckpt", "model.likelihood_batch_size=16")

    mustard, sugar, drill = "006_mustard_bottle", "004_sugar_box", "035_power_drill"
    gelatin, mug, foam = "009_gelatin_box", "025_mug", "061_foam_brick"
    chef, soup, meat = "002_master_chef_can", "005_tomato_soup_can", "010_potted_meat_can"
    return [
        Run("mustard_pose_camera", mustard, "pose_pf", 300, f"data/augment=camera {pair}"),
        Run("mustard_pose_strong", mustard, "pose_pf", 300, strong),
        Run("sugar_pose_camera", sugar, "pose_pf", 300, few),
        Run("mug_pose_camera", mug, "pose_pf", 300, few),
        Run("gelatin_pose_camera", gelatin, "pose_pf", 250, few),
        Run("chef_can_pose_camera", chef, "pose_pf", 200, few),
        Run("foam_pose_camera", foam, "pose_pf", 150, few),
        Run("drill_pose_camera", drill, "pose_pf", 300, few),
        Run("drill_patch_camera", drill, "patch_pf", 4000, whole),
        Run("mustard_patch_camera", mustard, "patch_pf", 1000, after_drill),
        Run("sugar_patch_camera", sugar, "patch_pf", 1000, after_drill),
        far("gelatin_a", gelatin, 1000, _best("gelatin_pose_camera")),
        near("gelatin_b", gelatin, 600, _best("gelatin_a")),
        near("gelatin_c", gelatin, 500, _best("gelatin_b")),
        far("mug_a", mug, 1000, _best("mug_pose_camera")),
        near("mug_b", mug, 600, _best("mug_a")),
        dim("mug_c", mug, 800, _best("mug_b")),
        far("foam_a", foam, 1000),
        near("foam_b", foam, 600, _best("foam_a")),
        dim("foam_c", foam, 1000, _best("foam_b")),
        run("foam_d", foam, 800, _best("foam_c"), NEAR),
        now("foam_e", foam, 500, _best("foam_d")),
        near("chef_b", chef, 700, _best("chef_can_pose_camera")),
        near("chef_c", chef, 900, _best("chef_b")),
        near("drill_b", drill, 900),
        now("drill_c", drill, 600, _best("drill_b")),
        near("meat_b", meat, 350),
        now("meat_c", meat, 500, _best("meat_b")),
        near("soup_b", soup, 350),
        near("soup_c", soup, 450, _best("soup_b")),
        near("soup_d", soup, 800, _best("soup_c")),
        now("soup_e", soup, 400, _best("soup_d")),
        near("sugar_b", sugar, 400, _best("sugar_pose_camera")),
        near("mustard_b", mustard, 400, _best("mustard_pose_camera")),
        now("bowl_b", "024_bowl", 500, _best("mug_c")),
        now("tuna_b", "007_tuna_fish_can", 500, _best("soup_d")),
        now("hammer_b", "048_hammer", 500, _best("drill_c")),
        near("banana_b", "011_banana", 350),
        more("foam_f", foam, 800, "foam_d"),
        more("soup_f", soup, 800, "soup_e"),
        more("mug_d", mug, 700, "mug_c"),
        more("tuna_c", "007_tuna_fish_can", 700, "tuna_b"),
        more("hammer_c", "048_hammer", 800, "hammer_b"),
        more("chef_d", chef, 600, "chef_c"),
        more("banana_c", "011_banana", 800, "banana_b"),
        more("bowl_c", "024_bowl", 700, "bowl_b"),
        more("meat_d", meat, 700, "meat_c"),
        more("drill_d", drill, 600, "drill_c"),
        more("mustard_c", mustard, 500, "mustard_b"),
        more("sugar_c", sugar, 500, "sugar_b"),
        more("drill_e", drill, 1200, "drill_d"),  # the control of drill_f
        shipped("soup_g", soup, 1200),
        shipped("foam_g", foam, 1000),
        shipped("drill_f", drill, 1200),
        shipped("sugar_d", sugar, 1000),
        shipped("mug_e", mug, 1000),
        shipped("mustard_d", mustard, 1000),
        shipped("chef_e", chef, 900),
        run("foam_h", foam, 900, _best("foam_g"), "model.likelihood_batch_size=16"),
        run("foam_i", foam, 900, _best("foam_h"), "model.likelihood_batch_size=16"),
        shipped("meat_e", meat, 700),
        shipped("tuna_d", "007_tuna_fish_can", 1000),
        shipped("banana_d", "011_banana", 1000),
        shipped("bowl_d", "024_bowl", 1000),
        shipped("hammer_d", "048_hammer", 1000),
        shipped("gelatin_d", gelatin, 1000),
        shipped("cracker_c", "003_cracker_box", 1000),
        shipped("chef_f", chef, 1000),
        shipped("soup_h", soup, 1000),
        shipped("drill_g", drill, 1000),
    ]


def _best(run: str) -> str:
    """Return where a run's checkpoint is, below a root that is put in later."""
    return f"{{root}}/runs/{run}/checkpoints/best.ckpt"


def _after(checkpoint: str) -> str:
    return f"warm_start={checkpoint}"


def render_commands(root: Path, frames: int = 300) -> list[list[str]]:
    """Return what to run to render the scenes, one command an object.

    A seed decides a frame's camera, lights and layout whatever the object is. With one seed for all
    objects, as the runs before `shipped` had it, 14 x 180 frames have no more than 180 layouts and
    30 sets of backgrounds and distractors.
    """
    common = [
        f"frames={frames}",
        "frames_per_scene=2",
        "size=[320,240]",
        "distractors=[4,10]",
        f"meshes={root / 'meshes'}",
    ]
    return [
        ["generate.py", f"out={root / 'data' / name}", f"object={name}", f"seed={seed}", *common]
        for seed, name in enumerate(TARGETS, start=1)
    ]


def train_command(run: Run, root: Path, more: Sequence[str] = ()) -> list[str]:
    """Return what to run to train and test one filter on renders."""
    data = [
        "data=fat",
        f"data.root={root / 'data'}",
        f"data.meshes={root / 'meshes'}",
        f"data.object={run.object}",
        SPLIT,
    ]
    interval = max(500, run.steps // 4)
    budget = [
        f"trainer.max_steps={run.steps}",
        f"trainer.val_check_interval={interval}",
        "data.min_visibility_test=0.3",
    ]
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
    return [
        [
            "evaluate.py",
            f"checkpoint={checkpoint}",
            *where,
            f"out={root / 'evals' / run.name / name}",
        ]
        for name, where in (
            ("photographs", photographs),
            ("renders", [*renders, "data.limit_test=24"]),
        )
    ]


def link_meshes(root: Path, meshes: Path) -> None:
    """Make a folder that holds links to the meshes in use: with fewer kinds of clutter, each kind
    is seen more often.
    """
    folder = root / "meshes"
    folder.mkdir(parents=True, exist_ok=True)
    for name in (*TARGETS, *CLUTTER):
        link = folder / name
        if not link.is_symlink():
            link.symlink_to((meshes / name).resolve())


def row(run: Run, root: Path, where: str) -> list[str] | None:
    """Return a run's row of the table of renders or photographs, or None where there is none."""
    own = _read(root / "runs" / run.name / "metrics.json")
    tested = _read(root / "evals" / run.name / where / "metrics.json")
    if own is None or not tested or not tested["instances"]:
        return None
    words = dict(word.split("=", 1) for word in run.words.split())
    start = _tell_start(words.get("warm_start", ""))
    step = own["training"]["cpu_seconds_per_step"]  # unknown where the test was made by itself
    cost = "–" if step is None else f"{own['training']['steps'] * step / 60:.1f}"
    first = [
        f"`{run.name}`",
        run.object,
        f"`{run.model}`",
        _tell_augment(run),
        start,
        str(run.steps),
        cost,
    ]
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
    return "shipped" if checkpoint.startswith("weights/") else f"`{checkpoint.split('/')[2]}`"


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text()) if path.is_file() else None


def _figures(metrics: dict[str, Any]) -> list[str]:
    add, add_s, belief = metrics["add"], metrics["add_s"], metrics.get("belief") or {}
    outscored = belief.get("truth_outscored_by_wrong")
    wrong = "–" if outscored is None else f"{100 * outscored:.0f}"
    figures = (add["auc"], add_s["auc"], add["recall_01d"], add_s["recall_01d"], add["median_mm"])
    return [str(metrics["instances"]), *(f"{figure:.1f}" for figure in figures), wrong]


def write_tables(root: Path, page: Path = PAGE) -> None:
    """Put the runs that are there into the page's tables; rows of others stay as they are.

    What YCB-Video has of an object that is in neither sequence, two or three rendered frames, is no
    photograph: it has a table of its own.
    """
    text = page.read_text()
    for title, where, few in TABLES:
        rows = {line.split("`")[1]: line for line in read_rows(text, title)}
        for run in plan():
            cells = row(run, root, where)
            if cells is not None and (int(cells[7]) < FEW) == few:
                rows[run.name] = format_row(cells)
        planned = (rows[run.name] for run in plan() if run.name in rows)
        text = put_table(text, title, HEAD, planned)
    page.write_text(text)


def main() -> int:
    """Run the plan; the status is that of the worst command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("more", nargs="*")
    parser.add_argument("--meshes", type=Path, help="a folder of YCB's meshes")
    parser.add_argument("--frames", help="a folder of YCB-Video")
    parser.add_argument("--only", action="append", choices=[run.name for run in plan()])
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    parser.add_argument("--table", action="store_true", help="only rewrite the tables")
    parser.add_argument("--root", type=Path, default=Path("outputs/photographs"))
    options = parser.parse_args()
    if options.table:
        write_tables(options.root)
        return 0
    if not options.meshes or not options.frames:
        parser.error("--meshes and --frames are needed")
    link_meshes(options.root, options.meshes)
    commands = [(words, None) for words in render_commands(options.root)]
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
        print(f"$ python {shlex.join(words)}", flush=True)
        if options.list or (done is not None and (done / "metrics.json").is_file()):
            continue
        worst = max(
            worst, subprocess.run([sys.executable, *words], cwd=HOME, check=False).returncode
        )
    if not options.list:
        write_tables(options.root)
    return worst


if __name__ == "__main__":
    sys.exit(main())
