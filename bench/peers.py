"""posefilter against what a user would pick instead, on the same frames and in the same run.

    python bench/peers.py filters  --python-pydpf PATH --python-particles PATH
    python bench/peers.py cases    --frames DIR --meshes DIR --renders DIR --render-meshes DIR
    python bench/peers.py tune     --python-open3d PATH --python-ppf PATH
    python bench/peers.py images   --python-open3d PATH --python-ppf PATH [--minutes 5]
    python bench/peers.py times    --python-open3d PATH --python-ppf PATH
    python bench/peers.py roofline
    python bench/peers.py tracks   --visp PROGRAM --frames DIR --meshes DIR

Each PATH is the interpreter of a virtual environment that has the peer alone: pydpf needs Python
3.12, `particles` a NumPy before 2, and opencv-contrib takes the place of OpenCV. A peer whose
option is left out is left out, and said to be. PROGRAM is what worker_visp.cpp compiles to.
`cases` reads the images once, into --out; `tune` tries every setting on validation renders;
`images` goes on where it was stopped; `times` does the same with one image of each object, and only
prints its tables. The others go to docs/results/peers.md.
"""

import argparse
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import peer_filters
import peer_images
import peer_tracks
import roofline
import torch
from marked import put_table
from peer_process import Peer, PeerError
from programs import HOME, make_parser

from posefilter.data.readers.registry import open_meshes
from posefilter.memory import keep_freed_memory

PAGE = HOME / "docs" / "results" / "peers.md"
PHOTOGRAPHED = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "006_mustard_bottle",
    "009_gelatin_box", "025_mug", "061_foam_brick",
)  # fmt: skip
RENDERED = (
    "003_cracker_box", "006_mustard_bottle", "011_banana", "025_mug", "035_power_drill",
    "048_hammer",
)  # fmt: skip
FEW = 2  # validation renders of an object, for tuning
MANY = {"photographs": 20, "renders": 12}  # images of an object
PROGRAMS = {
    "open3d": "worker_open3d.py",
    "ppf": "worker_ppf.py",
    "pydpf": "worker_pydpf.py",
    "particles": "worker_particles.py",
}


def start_peers(
    options: argparse.Namespace, names: tuple[str, ...], stack: ExitStack
) -> dict[str, Any]:
    """Return the peers' programs that were asked for, None for the others."""
    found: dict[str, Any] = {}
    for name in names:
        python = getattr(options, f"python_{name}")
        found[name] = None
        if python is None:
            print(f"{name}: left out, give --python-{name}", flush=True)
            continue
        found[name] = stack.enter_context(Peer(PROGRAMS[name], python, options.threads))
        print(f"{name}: {found[name].about['versions']}", flush=True)
    return found


def run_filters(options: argparse.Namespace) -> None:
    """Compare filter cores."""
    with ExitStack() as stack:
        own = stack.enter_context(Peer("worker_posefilter.py", threads=options.threads))
        print(f"posefilter: {own.about['versions']}", flush=True)
        peers = start_peers(options, ("pydpf", "particles"), stack)
        runners = peer_filters.list_runners(own, peers["pydpf"], peers["particles"])
        lines = []
        for count, steps in peer_filters.SIZES.items():
            told = peer_filters.measure(runners, count, steps, options.repeats)
            lines.append(peer_filters.make_lines(count, steps, told))
            print(*lines[-1], sep="\n", flush=True)
    if None in peers.values():
        print("not written into the page: its tables have all peers", flush=True)
        return
    for count, rows in zip(peer_filters.SIZES, lines, strict=True):
        put(f"filters {count}", peer_filters.HEAD, rows)


def write_cases(options: argparse.Namespace) -> None:
    """Read images of all kinds once."""
    folder = options.out
    if options.frames and not (folder / "photographs").exists():
        if not options.meshes:
            raise SystemExit("--frames needs --meshes")
        found = peer_images.read_photographs(
            options.frames, options.meshes, PHOTOGRAPHED, MANY["photographs"]
        )
        store = open_meshes(options.meshes, None, "ycb_video", list(PHOTOGRAPHED))
        peer_images.write_cases(folder / "photographs", found, store)
    for title, part, most in (("validation", "val", FEW), ("renders", "test", MANY["renders"])):
        if not options.renders or (folder / title).exists():
            continue
        if not options.render_meshes:
            raise SystemExit("--renders needs --render-meshes")
        where = (options.renders, options.render_meshes)
        found = peer_images.read_renders(*where, RENDERED, most, part)
        store = open_meshes(options.render_meshes, None, "fat", list(RENDERED))
        peer_images.write_cases(folder / title, found, store)


def run_images(options: argparse.Namespace) -> None:
    """Measure the errors, or seconds, of all methods, or tune the peers."""
    tuning, timing = options.what == "tune", options.what == "times"
    until = time.monotonic() + 60 * options.minutes
    titles = ("validation",) if tuning else ("photographs", "renders")
    with ExitStack() as stack:
        peers = start_peers(options, ("open3d", "ppf"), stack)
        programs = {"Open3D": peers["open3d"], "PPF": peers["ppf"]}
        for title in titles:
            if not (options.out / title / "index.json").is_file():
                print(f"{title}: left out, `cases` has not read them", flush=True)
                continue
            cases = peer_images.read_cases(options.out / title, options.only or ())
            if timing:
                cases = peer_images.choose_few(cases, 1)
            ways = [] if tuning else [peer_images.make_own_way(case.object for case in cases)]
            tuned = peer_images.read_rows(options.out / "tune.jsonl")
            ways += peer_images.list_ways(programs, tuned, tuning)
            file = options.out / f"{options.what}.jsonl"
            rows = peer_images.measure(ways, cases, file, title, until)
            lines = peer_images.make_lines(rows, title)
            print(title, *lines, sep="\n", flush=True)
            if timing:
                continue
            if not tuning:
                put(f"{options.what} {title}", peer_images.HEAD, lines)
                continue
            for method in programs:
                own = [line for line in lines if line.startswith(f"| {method}:")]
                if own:
                    put(f"tune {method}", peer_images.HEAD, own)


def run_roofline(options: argparse.Namespace) -> None:
    """Measure the likelihood against the peak of matrix products."""
    for title, head, lines in roofline.measure(options.repeats, options.threads):
        print(title, *lines, sep="\n", flush=True)
        put(title, head, lines)


def run_tracks(options: argparse.Namespace) -> None:
    """Compare tracks with ViSP's."""
    if not (options.visp and options.frames and options.meshes):
        raise SystemExit("tracks needs --visp, --frames and --meshes")
    names = options.only or PHOTOGRAPHED
    where = (options.visp, options.frames, options.meshes)
    for title, head, lines in peer_tracks.measure(*where, names, options.out):
        print(title, *lines, sep="\n", flush=True)
        if not options.only:  # the page's tables have all objects
            put(title, head, lines)


def put(title: str, head: Any, lines: list[str]) -> None:
    """Write a table into the page."""
    PAGE.write_text(put_table(PAGE.read_text(), title, head, lines))


RUNS = {
    "filters": run_filters,
    "cases": write_cases,
    "tune": run_images,
    "images": run_images,
    "times": run_images,
    "roofline": run_roofline,
    "tracks": run_tracks,
}


def main() -> int:
    """Measure what is asked for, print it, and write it into the page."""
    parser = make_parser(__doc__)
    parser.add_argument("what", choices=[*RUNS])
    for name in PROGRAMS:
        parser.add_argument(f"--python-{name}", help=f"the interpreter that has {name}")
    parser.add_argument("--frames", help="a folder of YCB-Video")
    parser.add_argument("--meshes", help="a folder of YCB's meshes")
    parser.add_argument("--renders", help="a folder of renders, one folder an object")
    parser.add_argument("--render-meshes", help="their meshes")
    parser.add_argument("--visp", help="what worker_visp.cpp compiles to")
    parser.add_argument("--only", action="append", help="an object; can be repeated")
    parser.add_argument("--out", type=Path, default=HOME / "outputs" / "peers")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument(
        "--minutes", type=float, default=1e9, help="stop after these, to go on later"
    )
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        RUNS[options.what](options)
    except PeerError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
