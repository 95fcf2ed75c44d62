"""Test pretrained weights beside packages of the same print in another size.

    python bench/other_sizes.py --meshes DIR [--root outputs/other_sizes] [--frames 80]

The gelatin box beside the pudding box, of the same brand and larger; the sugar box beside copies of
itself, 1.35 and 0.75 times as large. DIR holds YCB's <class>/google_16k. The scenes are rendered
once, with few kinds of clutter, so that another size is in about half of the images. Tested with
one search and with all (`filter.max_searches`); one thread.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from photographs import link_meshes
from programs import HOME, make_parser

from posefilter.meshes.store import MeshStore
from posefilter.meshes.write import write_obj

CLUTTER = ("003_cracker_box", "005_tomato_soup_can", "006_mustard_bottle")
BESIDE = {"009_gelatin_box": ("008_pudding_box",), "004_sugar_box": ("025_mug",)}
COPIES = {"004_sugar_box": {"large_sugar_box": 1.35, "small_sugar_box": 0.75}}
SEEDS = {"009_gelatin_box": 4242, "004_sugar_box": 4343}
SEARCHES = (1, 3)


def gather_meshes(root: Path, meshes: Path, name: str) -> None:
    """Make a folder of an object, what stands beside it, and its copies in other sizes."""
    link_meshes(root, meshes, (name, *BESIDE[name], *CLUTTER))
    mesh = MeshStore(meshes).load(name)
    middle = mesh.vertices.mean(0)
    for other, factor in COPIES.get(name, {}).items():
        scaled = middle + factor * (mesh.vertices - middle)
        write_obj(replace(mesh, name=other, vertices=scaled), root / "meshes" / other)


def render_command(root: Path, name: str, frames: int) -> list[str]:
    """Return what to run to render an object's scenes."""
    words = [f"out={root / name / 'data'}", f"object={name}", f"meshes={root / name / 'meshes'}"]
    words += [f"seed={SEEDS[name]}", f"frames={frames}", "frames_per_scene=2", "size=[320,240]"]
    words += ["distractors=[3,5]", "occluded_fraction=0.2"]
    return ["generate.py", *words]


def test_command(root: Path, name: str, searches: int) -> list[str]:
    """Return what to run to test the weights that ship."""
    words = [f"checkpoint={name}", "data=fat", f"data.root={root / name / 'data'}"]
    words += [f"data.meshes={root / name / 'meshes'}", f"data.object={name}"]
    words += ["data.split={test: 1.0}", "data.min_visibility_test=0.3", "threads=1"]
    words += [f"filter.max_searches={searches}", f"out={root / name / f'searches_{searches}'}"]
    return ["evaluate.py", *words]


def main() -> int:
    """Render and test what is missing, and print a row for each."""
    parser = make_parser(__doc__)
    parser.add_argument("--meshes", type=Path, required=True, help="a folder of YCB's meshes")
    parser.add_argument("--root", type=Path, default=Path("outputs/other_sizes"))
    parser.add_argument("--frames", type=int, default=80, help="of each object")
    parser.add_argument("--only", nargs="+", choices=list(BESIDE), default=list(BESIDE))
    options = parser.parse_args()
    root = options.root.resolve()
    print("| object | searches | images | ADD AUC | ADD-S AUC | ADD < 0.1 d % |")
    for name in options.only:
        gather_meshes(root / name, options.meshes, name)
        commands = [render_command(root, name, options.frames)]
        done = {n: root / name / f"searches_{n}" / "metrics.json" for n in SEARCHES}
        commands += [test_command(root, name, n) for n in SEARCHES if not done[n].is_file()]
        for command in commands:
            subprocess.run([sys.executable, *command], cwd=HOME, check=True, stdout=sys.stderr)
        for searches, file in done.items():
            m = json.loads(file.read_text())
            cells = [name, str(searches), str(m["instances"]), f"{m['add']['auc']:.1f}"]
            cells += [f"{m['add_s']['auc']:.1f}", f"{m['add']['recall_01d']:.0f}"]
            print("| " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
