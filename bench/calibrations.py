"""Calibrate weights files anew, on scenes of their own that no training and no test has.

    python bench/calibrations.py --root DIR --meshes DIR [--frames 400] [--without 240] [--each 90]
        [--list] [FILE.ckpt ...]

Without files, all of weights/ are.  A calibration replaces the one that the file has, in place.
The scenes are rendered first, below DIR of --root, `--each` frames for each of the 14 objects, by
seeds from 301 on; what is rendered already is not again.  An object is in about a third of all
frames, its own and those in which it stands in the clutter of others, so that 14 x 90 have some 400
with an object and 400 without.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import photographs
from programs import HOME, make_parser, run_command

FIRST_SEED = 301  # trainings and tests have seeds below


def render_commands(root: Path, each: int) -> list[list[str]]:
    """Return what to run to render the scenes, one command an object."""
    sets = photographs.render_commands(root, each, "data", FIRST_SEED, "different")
    return [[*words, "progress=false"] for words in sets]


def calibrate_command(file: Path, root: Path, frames: int, without: int) -> list[str]:
    """Return what to run to calibrate one file, in place."""
    words = ["data=fat", f"data.root={root / 'data'}", f"data.meshes={root / 'meshes'}"]
    words += ["data.split={val: 1.0}", "data.min_visibility_test=0.1", f"frames={frames}"]
    words.append(f"absent_frames={without}")
    return ["calibrate.py", f"checkpoint={file}", *words, "overwrite=true", "threads=1"]


def list_commands(
    files: Sequence[Path], root: Path, frames: int, without: int, each: int
) -> list[list[str]]:
    """Return all commands, in their order."""
    own = [calibrate_command(file.resolve(), root, frames, without) for file in files]
    return [*render_commands(root, each), *own]


def main() -> int:
    """Run the commands; the status is that of the worst."""
    parser = make_parser(__doc__)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--meshes", type=Path, required=True, help="a folder of YCB's meshes")
    parser.add_argument("--frames", type=int, default=400, help="with the object")
    parser.add_argument("--without", type=int, help="without it; as many, unless said")
    parser.add_argument("--each", type=int, default=90, help="frames rendered for each object")
    parser.add_argument("--list", action="store_true", help="print the commands, run nothing")
    options = parser.parse_args()
    files = options.files or sorted((HOME / "weights").glob("*.ckpt"))
    missing = [file for file in files if not file.is_file()]
    if missing:
        parser.error(f"{missing[0]}: there is no such file")
    root, worst = options.root.resolve(), 0
    if not options.list:
        photographs.link_meshes(root, options.meshes)
    without = options.frames if options.without is None else options.without
    for words in list_commands(files, root, options.frames, without, options.each):
        start = time.perf_counter()
        status = run_command(words, options.list)
        if not options.list:
            print(f"{time.perf_counter() - start:.0f} s, status {status}", flush=True)
        worst = max(worst, abs(status))
    return worst


if __name__ == "__main__":
    sys.exit(main())
