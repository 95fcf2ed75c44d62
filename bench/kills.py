"""Kill trainings at random times, go on with them, and compare them with trainings that were not.

    python bench/kills.py [COUNT] [--seed SEED] [--models A,B] [--workers 0,2] [--minutes MINUTES]
        [--after SHARE]

Each training is a process of its own, forked from this one, and is killed by SIGKILL at a random
time of its length, in its later part with --after; it writes a checkpoint after every batch, so
that many kills fall into the writing of one. It is then gone on with by `resume=`, or started anew
where it had no checkpoint yet. Weights, optimizer, particles of the training's own and the test's
numbers must be the same bits as those of a training that was never killed. Prints the counts; the
exit status is 1 where one was not.
"""

import argparse
import json
import math
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import torch

HOME = Path(__file__).parents[1]
sys.path.insert(0, str(HOME / "bench"))

from forking import prepare, run, start, wait  # noqa: E402

MODELS = ("pose_pf", "patch_pf", "pixel_pf", "cnn_patch", "downsized")
_SMALL = (
    "debug=smoke", "console=json", "threads=1", "logger=none", "callbacks=checkpoints",
    "data.progress=false", "callbacks.last.minutes=0", "trainer.max_steps=6",
    "trainer.val_check_interval=3", "data.limit_test=4", "data.limit_val=2",
)  # fmt: skip
_TIMES = ("seconds_per_image", "training", "git", "overrides", "checkpoint")


class Whole(NamedTuple):
    """A training that was not killed."""

    seconds: float
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
    given = parser.parse_args(arguments)
    print(f"at most {given.count} kills, seed {given.seed}", flush=True)
    prepare()
    kinds = [(m, w) for w in given.workers.split(",") for m in given.models.split(",")]
    with tempfile.TemporaryDirectory() as folder:
        counts = kill_many(
            Path(folder), kinds[: given.count], given.count, given.seed, given.minutes, given.after
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
) -> Counter[str]:
    """Kill trainings of each kind in turn.

    Args:
        folder: An empty one, for the data and the runs.
        kinds: Methods, each with a number of loader processes.
        count: How many kills.
        seed: Decides when.
        minutes: After which no further training is begun.
        after: Share of a training's time before which it is not killed.

    Returns:
        How many ended how.
    """
    began = time.monotonic()
    frames = ["frames=24", "size=[160,120]", "distractors=[1,2]", "frames_per_scene=4"]
    data = [*frames, "object=carton", "workers=1", "console=json", f"out={folder / 'data'}"]
    assert run("generate", data, folder / "log").status == 0
    wholes: dict[tuple[str, str], Whole] = {}
    counts: Counter[str] = Counter()
    for number in range(count):
        if time.monotonic() - began > 60 * minutes:
            break
        kind = kinds[number % len(kinds)]
        settings = [*_SMALL, f"data.root={folder / 'data'}", f"model={kind[0]}"]
        settings.append(f"data.workers={kind[1]}")
        if kind not in wholes:
            wholes[kind] = train_whole(folder / f"whole_{kind[0]}_{kind[1]}", settings)
        part = after + (1 - after) * random.Random(f"{seed} {number}").random()
        found = kill_one(folder / f"{number:04d}", settings, wholes[kind], part)
        counts[found] += 1
        if found.startswith("NOT"):
            print(f"kill {number} {kind} at {part:.3f}: {found}")
    return counts


def train_whole(out: Path, settings: list[str]) -> Whole:
    """Train without a kill."""
    ended = run("train", [*settings, f"out={out}"], out.with_suffix(".log"))
    assert ended.status == 0, ended.err
    return Whole(ended.seconds, read_bits(out))


def kill_one(out: Path, settings: list[str], whole: Whole, part: float) -> str:
    """Kill a training, go on with it, and say what came of it.

    Args:
        out: Its folder.
        settings: What is typed.
        whole: The same training, not killed.
        part: When, as a share of the whole one's time.
    """
    log = out.with_suffix(".log")
    number = start("train", [*settings, f"out={out}"], log)
    time.sleep(part * whole.seconds)
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
        "metrics": {key: value for key, value in metrics.items() if key not in _TIMES},
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
