"""Type command lines that make no sense, and see that each ends in one line.

    python bench/fuzz.py [COUNT] [--seed SEED] [--command NAME] [--list]
        [--first NUMBER] [--minutes MINUTES]
    python bench/fuzz.py --each VALUE [--each VALUE ...]      # every setting of every command

Each line is one that works, with one or two settings changed: to values that are no numbers, out
of range, of another kind, or not in Hydra's grammar; to keys, choices, files and folders that there
are not. It runs in a process of its own, forked from this one; trainings are cut to four steps. A
line may be accepted, or be refused in one line with a status that is not 0. Prints the counts; the
exit status is 1 where a line ended otherwise. Line n of a seed is always the same: a run that was
stopped, by --minutes say, goes on with `--first` the number that it tells. With --each, nothing is
drawn: each setting of each command is set to each of the values. Lines of `convert_bag` need the
package rosbags.
"""

import argparse
import math
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from contextlib import chdir
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from forking import RAW, Ended, prepare, run, warm
from lightning import Trainer
from omegaconf import OmegaConf
from programs import HOME

import posefilter.cli.onboard
from posefilter.cli.command import compose_job
from posefilter.ranges import list_nodes
from posefilter.ros.messages import CAMERA_INFO, IMAGE, make_message, open_types

SECONDS, PATIENCE, MEMORY = 20, 300, 12 << 30  # of one line: processor [s], clock [s], [bytes]
ACCEPTED, REFUSED, USAGE = "accepted", "refused in one line", "refused with Hydra's usage"
FAILURES = (
    "raw traceback",
    f"no answer within {SECONDS} s of processor time",
    "ended by a signal",
    "refused in several lines",
    "refused without a word",
)
ODD = (
    "-1", "0", "nan", "inf", "-inf", "1e-9", "1e30", "1000000000", "0.5", "text", "null", "true",
    "[]", "[1,2]", "{a:1}", "", "\u00fc", "${seed}", "${nope}", "${oc.env:HOME}", "1,2", "'", '"',
    "999999999999999999999", "a b", "/proc/x", "-", "\\", "4294967296", "5", "[nan]", "[[1]]",
    "a=b", "(", ")", "]", "${", "!", "~", "${seed}.5", "/", ".", "..", "None", "''",
)  # fmt: skip
GARBAGE = (
    "", "=", "=1", "x", "--foo", "-x", "a=b=c", "[", "~model", "~seed", "+a=1", "++a=1", "~~a",
    "model", "model=", "a.b.c=1", "hydra=1", "hydra.run.dir=", "hydra/launcher=nope", "@",
    "\u00fc=1", "--config-name=nope", "--config-dir=/nope", "-cd", "seed==1", "seed=1=2", "seed= 1",
    "model@a=pose_pf", "filter@model.x=pose", "+filter/resample=none", "plugins=[os]", "plugins=x",
    "plugins=[1]", "tags=5", "tags={a:1}", "console=", "console=loud", "debug=nope", "debug=[1]",
    "~filter.particles", "filter=null", "filter={}", "data={}", "loss={}", "model={}", "trainer={}",
)  # fmt: skip
# Lightning types a process' command line for each of the others, which is this bench's here
SPAWNING = ("trainer.devices", "5")
PLACES = (
    "/proc/x", "/dev/null", "/dev/null/x", "", ".", "/nonexistent/\u00fc", "n" * 300, "5",
    "null", "[a]", "{}", "/sys/x", "/etc/hostname", "//", "~", "${nope}", "a/../b", "tar",
)  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    """Type so many lines; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", help="one, or several: a,b")
    parser.add_argument("--list", action="store_true", help="print each line")
    parser.add_argument("--first", type=int, default=0, help="line to begin with")
    parser.add_argument("--each", action="append", help="a value; can be repeated")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which it stops")
    given = parser.parse_args(arguments)
    began = time.monotonic()
    prepare()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        place, scratch = Path(folder), Path(folder) / "scratch"
        scratch.mkdir()
        lines = make_lines(place)
        chosen = given.command.split(",") if given.command else []
        commands = chosen or [*lines, "train", "train", "predict"]
        keys = {name: list_keys(name, place) for name in {*commands}}
        warm(
            {
                name: [word.replace("NEW", f"warm_{name}") for word in line]
                for name, line in lines.items()
                if name in commands and name != "onboard"  # which would take minutes
            }
        )
        every = [
            (name, f"{key}={value}")
            for name in dict.fromkeys(commands)
            for key in keys[name]
            for value in given.each or ()
            if (key, value) != SPAWNING
        ]
        stop = len(every) if given.each else given.first + given.count
        print(f"{stop - given.first} command lines, seed {given.seed}", flush=True)
        for number in range(given.first, stop):
            if time.monotonic() - began > 60 * given.minutes:
                print(f"stopped before line {number}")
                break
            rng = random.Random(f"{given.seed} {number}")
            command = every[number][0] if every else commands[number % len(commands)]
            own = [word.replace("NEW", f"new{number}") for word in lines[command]]
            if every:
                typed = [*own, every[number][1]]
            else:
                typed = change(own, keys[command], place, rng)
            with chdir(scratch):  # what is typed may name files of the working folder
                ended = run(command, typed, place / "log", PATIENCE, limit)
            outcome = judge(ended)
            counts[outcome] += 1
            if given.list or outcome in FAILURES:
                error = ended.err.strip().splitlines()
                added = [word for word in typed if word not in own]
                without = [word for word in own if word not in typed]
                said = error[-1][:300] if error else ""
                print(f"{number} {command} {added} without {without}: {outcome}: {said}")
    for outcome in (ACCEPTED, REFUSED, USAGE, *FAILURES):
        print(f"{counts[outcome]:6d}  {outcome}")
    return 1 if any(counts[outcome] for outcome in FAILURES) else 0


def judge(ended: Ended) -> str:
    """Return what came of a line."""
    lines = [line for line in ended.err.splitlines() if line.strip()]
    if "Traceback (most recent call last)" in ended.err or ended.status == RAW:
        return FAILURES[0]
    if ended.status is None or ended.cpu > SECONDS:
        return FAILURES[1]
    if ended.status < 0:
        return FAILURES[2]
    if ended.status == 0:
        return ACCEPTED
    if lines and lines[0].startswith("usage:"):
        return USAGE
    if not lines:
        return FAILURES[4]
    return REFUSED if len(lines) == 1 else FAILURES[3]


def limit() -> None:
    """Bound what a line may take of this machine, and cut trainings short."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    whole = Trainer.fit

    def fit(self: Trainer, *args: object, **more: object) -> None:
        loop = self.fit_loop.epoch_loop
        steps = loop.max_steps
        loop.max_steps = 4 if steps < 0 else min(4, steps)
        whole(self, *args, **more)  # type: ignore[arg-type]

    Trainer.fit = fit  # type: ignore[method-assign]
    posefilter.cli.onboard.STAGES = ()
    posefilter.cli.onboard.tell = lambda work: None


def make_lines(folder: Path) -> dict[str, list[str]]:
    """Make what the commands need; return a line for each that works, `NEW` for a new name."""
    data = folder / "data"
    frames = ["frames=12", "size=[160,120]", "distractors=[1,2]", "frames_per_scene=3"]
    once = [*frames, "workers=1", "console=json", f"out={data}"]
    assert run("generate", once, folder / "log").status == 0
    rgb, depth = folder / "rgb.png", folder / "depth.png"
    cv2.imwrite(str(rgb), np.full((120, 160, 3), 90, np.uint8))
    cv2.imwrite(str(depth), np.full((120, 160), 7000, np.uint16))
    for picture in (rgb, depth):  # a video of one frame
        (folder / "video" / picture.stem).mkdir(parents=True)
        (folder / "video" / picture.stem / "0.png").write_bytes(picture.read_bytes())
    quiet = ["console=json", "threads=1"]
    small = ["debug=smoke", *quiet, "logger=none", "data.progress=false", f"data.root={data}"]
    small += ["data.limit_train=4", "data.limit_val=1", "data.limit_test=2"]
    small += ["callbacks=checkpoints", "trainer.max_steps=2", "trainer.val_check_interval=2"]
    run_folder = folder / "run"
    done = run("train", [*small, f"out={run_folder}"], folder / "log", before=limit)
    if done.status:
        raise SystemExit(done.err)
    best = run_folder / "checkpoints" / "best.ckpt"
    absent = [word for word in once if not word.startswith("out=")]
    absent += ["absent_fraction=1", f"out={folder / 'absent'}"]
    assert run("generate", absent, folder / "log").status == 0
    lines = {
        "train": [*small, f"out={folder}/NEW", "model=cnn_patch"],
        "evaluate": [*quiet, f"checkpoint={best}", f"data.root={data}", f"out={folder}/NEW"],
        "predict": [
            *quiet, f"checkpoint={best}", f"rgb={rgb}", f"depth={depth}", f"out={folder}/NEW",
            "intrinsics=180,180,80,60", "depth_scale=10000",
        ],
        "generate": [
            "console=json", f"out={folder}/NEW", "frames=2", "size=[96,72]", "workers=1",
            "progress=false",
        ],
        "check_data": [
            "console=json", f"data.root={data}", "data.object=carton", "max_frames=2",
            f"out={folder}/NEW",
        ],
        "report": ["console=json", f"run={run_folder}", f"out={folder}/NEW"],
        "export": ["console=json", f"checkpoint={best}", f"out={folder}/NEW.ckpt"],
        "track": [
            *quiet, f"checkpoint={best}", f"frames={folder}/video", f"out={folder}/NEW",
            "intrinsics=180,180,80,60", "depth_scale=10000", "save_video=gif",
        ],
        "calibrate": [
            *quiet, f"checkpoint={best}", f"data.root={data}", f"absent={folder / 'absent'}",
            "data.split={train: 0, val: 1.0, test: 0}", "data.min_visibility_test=0", "frames=12",
            f"out={folder}/NEW.ckpt",
        ],
        "onboard": [*quiet, "mesh=carton", f"out={folder}/NEW"],
    }  # fmt: skip
    if find_spec("rosbags") is not None:
        bag = write_bag(folder / "bag")
        lines["convert_bag"] = [
            *quiet, f"bag={bag}", f"out={folder}/NEW.mcap", f"checkpoint={best}", "color=/rgb",
            "depth=/depth", "camera_info=/info",
        ]  # fmt: skip
    return lines


def write_bag(path: Path) -> Path:
    """Write a bag of one gray image, 0.7 m from a wall; return its folder."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    stamp = make_message("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = make_message("std_msgs/msg/Header", stamp=stamp, frame_id="camera")
    size = {"header": header, "height": 120, "width": 160}
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    K = np.array([180.0, 0, 80, 0, 180, 60, 0, 0, 1])
    P = np.array([180.0, 0, 80, 0, 0, 180, 60, 0, 0, 0, 1, 0])
    info = {
        "distortion_model": "plumb_bob", "d": np.zeros(5), "k": K, "r": np.eye(3).reshape(9),
        "p": P, "binning_x": 0, "binning_y": 0,
        "roi": make_message("sensor_msgs/msg/RegionOfInterest", **region),
    }  # fmt: skip
    images = {
        "/rgb": ("rgb8", 480, np.full(120 * 480, 90, np.uint8)),
        "/depth": ("16UC1", 320, np.full(120 * 160, 700, np.uint16).view(np.uint8)),
    }
    messages = [("/info", CAMERA_INFO, make_message(CAMERA_INFO, **size, **info))]
    for topic, (encoding, step, pixels) in images.items():
        own = {"encoding": encoding, "is_bigendian": 0, "step": step, "data": pixels}
        messages.append((topic, IMAGE, make_message(IMAGE, **size, **own)))
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, message in messages:
            connection = writer.add_connection(topic, kind, typestore=open_types())
            writer.write(connection, 0, open_types().serialize_cdr(message, kind))
    return path


def list_keys(command: str, folder: Path) -> list[str]:
    """Return the settings that a command has."""
    plain = OmegaConf.to_container(compose_job(command, HOME / "conf", [], folder).cfg)
    assert isinstance(plain, dict)
    values = [key for key, value, _ in list_nodes(plain) if not isinstance(value, dict | list)]
    keys = {key.partition("[")[0] for key in values}
    return sorted(key for key in keys if "_target_" not in key and key != "folder")


def change(line: list[str], keys: list[str], folder: Path, rng: random.Random) -> list[str]:
    """Return a line with one or two things changed."""
    typed = list(line)
    for _ in range(rng.choice([1, 1, 2])):
        way = rng.choice(["value"] * 6 + ["place", "place", "key", "garbage", "group", "leave out"])
        if way == "garbage":
            typed.append(rng.choice(GARBAGE))
        elif way == "leave out":
            typed.remove(rng.choice(typed))
        elif way == "key":
            key = rng.choice(keys)
            at = rng.randrange(len(key))
            typed.append(f"{key[:at]}{rng.choice(['', 'x', '.', '/', '@'])}{key[at + 1 :]}=1")
        elif way == "group":
            groups = sorted(p for p in (HOME / "conf").rglob("*") if p.is_dir())
            group = rng.choice(groups)
            names = [file.stem for file in group.glob("*.yaml")]
            names = [name for name in names if name != "traceback"]  # which asks for one
            names += ["nope", "null", "", "[a]", "5"]
            typed.append(f"{group.relative_to(HOME / 'conf')}={rng.choice(names)}")
        elif way == "place":
            place = rng.choice(PLACES)
            if place == "tar":
                place = str(folder / "run.tar")
                Path(place).write_bytes(bytes(1024))
            names = (
                "out", "data.root", "rgb", "depth", "checkpoint", "meshes", "data.meshes", "run",
                "frames", "absent", "bag",
            )  # fmt: skip
            typed.append(f"{rng.choice([key for key in names if key in keys] or ['out'])}={place}")
        elif (pair := (rng.choice(keys), rng.choice(ODD))) != SPAWNING:
            typed.append("=".join(pair))
    return typed


if __name__ == "__main__":
    sys.exit(main())
