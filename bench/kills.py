"""Kill trainings at random times, go on with them, and compare them with trainings that were not.

    python bench/kills.py [COUNT] [--seed SEED] [--models A,B] [--workers 0,2] [--minutes MINUTES]
        [--after SHARE] [--first NUMBER] [--keep FOLDER]

Each training is a process of its own, forked from this one, and is killed by SIGKILL at a random
share of the processor time that it takes, in its later part with --after; it writes a checkpoint
after every batch, so that many kills fall into the writing of one. It is then gone on with by
`resume=`, or started anew where it had no checkpoint yet. Weights, optimizer, particles of the
training's own and the test's numbers must be the same bits as those of a training that was never
killed. Prints the counts; the exit status is 1 where one was not.

Kill n of a seed is always the same: a run that was stopped, by --minutes say, goes on with --first.
With --keep, the data and what the trainings that are not killed came to stay in a folder, for the
next run of the same code; they are made anew where the code is another.
"""

import argparse
import hashlib
import json
import math
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import torch
from forking import prepare, run, start, wait, warm
from programs import HOME

MODELS = ("pose_pf", "patch_pf", "pixel_pf", "cnn_patch", "downsized")
SMALL = (
    "debug=smoke", "console=json", "threads=1", "logger=none", "callbacks=checkpoints",
    "data.progress=false", "callbacks.last.minutes=0", "trainer.max_steps=6",
    "trainer.val_check_interval=3", "data.limit_test=2", "data.limit_val=2",
)  # fmt: skip
_TICKS = os.sysconf("SC_CLK_TCK")  # a second, of a process's clock
TIMES = ("seconds_per_image", "training", "git", "overrides", "checkpoint")


class Whole(NamedTuple):
    """A training that was not killed."""

    seconds: float  # of its own processor time, without that of its loader processes
    bits: dict[str, Any]


def main(arguments: list[str] | None = None) -> int:
    """Kill so many trainings; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("count", nargs="?", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--workers", default="0,2")
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which it stops")
    parser.add_argument(
        "--after", type=float, default=0.0, help="share of a training before which none is killed"
    )
    parser.add_argument("--first", type=int, default=0, help="kill to begin with")
    parser.add_argument("--keep", type=Path, help="folder for what the next run can use")
    given = parser.parse_args(arguments)
    print(f"at most {given.count} kills, seed {given.seed}", flush=True)
    prepare()
    kinds = [(m, w) for w in given.workers.split(",") for m in given.models.split(",")]
    last = given.first + given.count
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        keep = given.keep or folder / "kept"
        counts = kill_many(
            folder, kinds, last, given.seed, given.minutes, given.after, given.first, keep
        )
    print(f"{counts.total()} kills")
    for what, count in sorted(counts.items()):
        print(f"{count:5d}  {what}")
    return 1 if any(what.startswith("NOT") for what in counts) else 0


def kill_many(
    folder: Path,
    kinds: list[tuple[str, str]],
    count: int,
    seed: int,
    minutes: float = math.inf,
    after: float = 0.0,
    first: int = 0,
    keep: Path | None = None,
) -> Counter[str]:
    """Kill trainings of each kind in turn.

    Args:
        folder: An empty one, for the runs.
        kinds: Methods, each with a number of loader processes.
        count: The number of the last kill, plus 1.
        seed: Decides when.
        minutes: After which no further training is begun.
        after: Share of a training's time before which it is not killed.
        first: The number of the first kill.
        keep: Folder for the data and for what the trainings that are not killed came to.

    Returns:
        How many ended how.
    """
    began = time.monotonic()
    keep = (keep or folder / "kept") / digest_code()
    data = make_data(keep / "data", folder / "log")
    common = [*SMALL, f"data.root={data}"]
    warm({"train": [*common, "model=pose_pf", "trainer.max_steps=1", f"out={folder / 'warm'}"]})
    wholes: dict[tuple[str, str], Whole] = {}
    counts: Counter[str] = Counter()
    for number in range(first, count):
        if time.monotonic() - began > 60 * minutes:
            print(f"stopped before kill {number}", flush=True)
            break
        kind = kinds[number % len(kinds)]
        settings = [*common, f"model={kind[0]}", f"data.workers={kind[1]}"]
        if kind not in wholes:
            wholes[kind] = find_whole(keep / f"{kind[0]}_{kind[1]}.pt", folder, settings)
        part = after + (1 - after) * random.Random(f"{seed} {number}").random()
        found = kill_one(folder / f"{number:04d}", settings, wholes[kind], part)
        counts[found] += 1
        if found.startswith("NOT"):
            print(f"kill {number} {kind} at {part:.3f}: {found}", flush=True)
    return counts


def make_data(folder: Path, log: Path) -> Path:
    """Render what is trained with, where it is not there; return its folder."""
    if not folder.is_dir():
        frames = ["frames=24", "size=[160,120]", "distractors=[1,2]", "frames_per_scene=4"]
        typed = [*frames, "object=carton", "workers=1", "console=json", f"out={folder}"]
        assert run("generate", typed, log).status == 0
    return folder


def digest_code() -> str:
    """Return what changes when the code or the configuration does."""
    digest = hashlib.sha256(" ".join(SMALL).encode())
    for file in sorted([*(HOME / "src").rglob("*.py"), *(HOME / "conf").rglob("*.yaml")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def find_whole(file: Path, folder: Path, settings: list[str]) -> Whole:
    """Return what a training without a kill came to, of a file where it is kept."""
    if file.is_file():
        kept = torch.load(file, weights_only=True)
        return Whole(kept["seconds"], kept["bits"])
    whole = train_whole(folder / f"whole_{file.stem}", settings)
    torch.save(whole._asdict(), file)
    return whole


def train_whole(out: Path, settings: list[str]) -> Whole:
    """Train without a kill."""
    log = out.with_suffix(".log")
    number = start("train", [*settings, f"out={out}"], log)
    seconds = follow(number, math.inf)
    ended = wait(number, log, 10)
    assert ended.status == 0, ended.err
    return Whole(seconds, read_bits(out))


def follow(number: int, seconds: float) -> float:
    """Wait until a process has used so much processor time, or has ended; return what it has used.

    Its clock stands while it is suspended or waits for others, so that a busy machine does not
    decide when a training is killed.
    """
    used = 0.0
    while used < seconds:
        fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
        if fields[0] == "Z":
            break
        used = (int(fields[11]) + int(fields[12])) / _TICKS
        time.sleep(0.005)
    return used


def kill_one(out: Path, settings: list[str], whole: Whole, part: float) -> str:
    """Kill a training, go on with it, and say what came of it.

    Args:
        out: Its folder.
        settings: What is typed.
        whole: The same training, not killed.
        part: When, as a share of the whole one's processor time.
    """
    log = out.with_suffix(".log")
    number = start("train", [*settings, f"out={out}"], log)
    follow(number, part * whole.seconds)
    os.kill(number, signal.SIGKILL)
    wait(number, log, 10)
    checkpoints = out / "checkpoints"
    if (out / "metrics.json").is_file():
        state = "after its end"
    elif any(checkpoints.glob(".*.part")):
        state = "while it wrote a checkpoint"
    elif any(checkpoints.glob("last*.ckpt")):
        state = "after its first checkpoint"
    else:
        state = "before its first checkpoint"
    if state != "after its end":
        goes_on = any(checkpoints.glob("last*.ckpt"))
        again = [f"resume={out}", *settings] if goes_on else [*settings, f"out={out}"]
        if not goes_on and checkpoints.is_dir():  # a folder with a run is not overwritten
            again[-1] = f"out={out}_again"
            out = Path(f"{out}_again")
        ended = run("train", again, log)
        if ended.status != 0:
            return f"NOT gone on with, killed {state}: {ended.err.strip()[-300:]}"
    differing = list_differing(whole.bits, read_bits(out))
    left = [file.name for file in out.rglob(".*") if file.name != ".hydra"]
    if differing or left:
        return f"NOT the same, killed {state}: {differing[:3]} {left[:3]}"
    return f"the same bits, killed {state}"


def read_bits(out: Path) -> dict[str, Any]:
    """Return what must be the same of two trainings."""
    state = torch.load(out / "checkpoints" / "last.ckpt", weights_only=True)
    metrics = json.loads((out / "metrics.json").read_text())
    kept = ("state_dict", "optimizer_states", "lr_schedulers", "candidate_sampler", "global_step")
    return {
        **{key: state.get(key) for key in (*kept, "epoch")},
        "best": torch.load(out / "checkpoints" / "best.ckpt", weights_only=True)["state_dict"],
        "metrics": {key: value for key, value in metrics.items() if key not in TIMES},
    }


def list_differing(a: Any, b: Any, where: str = "") -> list[str]:
    """Return the places in which two nested values differ, to the last bit."""
    if isinstance(a, torch.Tensor) and isinstance(b, torch.Tensor):
        return [] if torch.equal(a, b) else [where]
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return [x for key in a for x in list_differing(a[key], b[key], f"{where}.{key}")]
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        pairs = enumerate(zip(a, b, strict=True))
        return [x for i, (one, other) in pairs for x in list_differing(one, other, f"{where}[{i}]")]
    return [] if a == b else [where]


if __name__ == "__main__":
    sys.exit(main())
