"""Kill a sweep at random times, start it again each time, and see that each job is done once.

    python bench/killed_sweeps.py [--jobs COUNT] [--kills COUNT] [--seed SEED] [--model MODEL]
        [--vary KEY=A,B]

A sweep of small trainings, seeds by two values of a setting, is run once without a kill. Another is
killed by SIGKILL, with its children, at random times of the processor time that the first took, and
each time started again by the same command; after the last kill it is left to its end. A job that
was done keeps every file as it was; one that was cut short, or never begun, comes to the same
weights and numbers as in the first sweep. Prints the counts; the exit status is 1 where that is not
so. By default the two values differ for testing alone, so that every other job takes over what
another has learned; with `--vary optimizer.lr=1e-3,1e-4` each is trained.
"""

import argparse
import csv
import json
import math
import os
import random
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from forking import Ended, prepare, start, wait, warm
from kills import SMALL, TIMES, follow, list_differing, make_data

VARY = "filter.particles=8,4"
_AGAIN = (".hydra", "train.log")  # of a job that is done: written by Hydra at each start
_LONGEST = 600  # of a start [s]


def main(arguments: list[str] | None = None) -> int:
    """Kill a sweep so many times; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=20, help="an even number")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model", default="cnn_patch")
    parser.add_argument("--vary", default=VARY, help="a setting and two values of it")
    given = parser.parse_args(arguments)
    print(f"{given.jobs} jobs, {given.kills} kills, seed {given.seed}", flush=True)
    prepare()
    with tempfile.TemporaryDirectory() as folder:
        counts, wrong = kill_sweep(
            Path(folder), given.jobs, given.kills, given.seed, given.model, given.vary
        )
    for what, count in counts.items():
        print(f"{count:5d}  {what}")
    for line in wrong:
        print(f"WRONG: {line}")
    return 1 if wrong else 0


def kill_sweep(
    folder: Path, jobs: int, kills: int, seed: int, model: str, vary: str = VARY
) -> tuple[Counter[str], list[str]]:
    """Run a sweep, kill another of the same settings, and compare the two.

    Args:
        folder: An empty one, for the sweeps.
        jobs: How many; an even number.
        kills: How many.
        seed: Decides when.
        model: The method that each job trains.
        vary: A setting and two values of it.

    Returns:
        What the kills met and what became of the jobs, counted; and what is not as it should be.
    """
    data = make_data(folder / "data", folder / "log")
    common = [*SMALL, f"data.root={data}", f"model={model}", "logger=tensorboard"]
    once = ["trainer.max_steps=1", "-m", "seed=0", f"out={folder / 'warm'}"]
    warm({"train": [*common, *once]})
    sweep = [*common, "-m", f"seed=range(0,{jobs // 2})", vary]
    whole, out = folder / "whole", folder / "killed"
    seconds, ended = run_until([*sweep, f"out={whole}"], math.inf, folder / "log")
    assert ended.status == 0, ended.err
    print(f"without a kill: {seconds:.1f} s of processor time", flush=True)
    rng = random.Random(seed)
    counts: Counter[str] = Counter()
    wrong: list[str] = []
    before: dict[str, dict[str, tuple[int, int]]] = {}  # the files of jobs that are done
    for number in range(kills + 1):
        # up to twice an even share of what is left, so that kills fall all along the sweep
        share = seconds * (1 - len(before) / jobs) / (kills + 1 - number)
        until = rng.uniform(0, 2 * share) if number < kills else math.inf
        _, ended = run_until([*sweep, f"out={out}"], until, folder / "log")
        done = list_done(out)
        for job, files in before.items():
            if done.get(job) != files:
                wrong.append(f"start {number}: {job} was done, and is not as it was")
        if ended.status == -signal.SIGKILL:
            counts[f"killed {tell_state(out)}"] += 1
            print(f"kill {number + 1} after {until:.1f} s: {len(done)} jobs done", flush=True)
        elif ended.status != 0:
            wrong.append(f"start {number}: status {ended.status}: {ended.err.strip()[-300:]}")
        said = [json.loads(line).get("event") for line in ended.out.splitlines()[:-1]]
        if ended.status == 0 and said.count("skipped") != len(before):
            wrong.append(f"the last start skipped {said.count('skipped')} of {len(before)} jobs")
        before = done
    same = [job for job in before if not list_unequal(whole / job, out / job)]
    ends = {
        "jobs that are done": len(before),
        "jobs of summary.csv without an error": count_rows(out / "summary.csv"),
        "jobs that came to the same bits as without a kill": len(same),
    }
    wrong += [f"{count} {what}" for what, count in ends.items() if count != jobs]
    wrong += [f"left: {file.relative_to(out)}" for file in list_left(out)]
    return counts + Counter(ends), wrong


def run_until(typed: list[str], until: float, log: Path) -> tuple[float, Ended]:
    """Run a sweep, kill it and its children when it has used so much processor time [s], and
    return what it has used and how it ended.
    """
    number = start("train", typed, log)
    used = follow(number, until)
    if used >= until:
        os.killpg(number, signal.SIGKILL)
    return used, wait(number, log, _LONGEST)


def list_done(out: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Return the jobs that are done, and the times and sizes of each one's files."""
    found = {}
    for file in sorted(out.glob("*/metrics.json")):
        job = file.parent
        paths = [path for path in job.rglob("*") if path.is_file()]
        states = {
            str(path.relative_to(job)): (path.stat().st_mtime_ns, path.stat().st_size)
            for path in paths
            if path.relative_to(job).parts[0] not in _AGAIN and not path.name.startswith(".")
        }
        found[job.name] = states
    return found


def tell_state(out: Path) -> str:
    """Return what a sweep was at when it was killed."""
    begun = [job for job in out.glob("*/") if not (job / "metrics.json").is_file()]
    if any(out.rglob(".*.part")):
        return "while it wrote a file"
    if any((job / "checkpoints" / "last.ckpt").is_file() for job in begun):
        return "after a job's first checkpoint"
    return "before a job's first checkpoint" if begun else "between two jobs, or before the first"


def count_rows(summary: Path) -> int:
    """Return how many jobs a summary lists as done."""
    with summary.open() as file:
        return sum(not row.get("error") for row in csv.DictReader(file))


def list_unequal(a: Path, b: Path) -> list[str]:
    """Return the places in which two jobs' weights, optimizers or numbers differ."""
    return list_differing(read_job(a), read_job(b))


def read_job(folder: Path) -> dict[str, Any]:
    """Return what must be the same of two jobs; one that took over has no last checkpoint."""
    metrics = json.loads((folder / "metrics.json").read_text())
    states: dict[str, Any] = {"metrics": {k: v for k, v in metrics.items() if k not in TIMES}}
    for name in ("best", "last"):
        file = folder / "checkpoints" / f"{name}.ckpt"
        if file.is_file():
            state = torch.load(file, weights_only=True)
            kept = ("state_dict", "optimizer_states", "lr_schedulers", "global_step")
            states[name] = {key: state.get(key) for key in kept}
    return states


def list_left(out: Path) -> list[Path]:
    """Return the hidden files of killed processes that are still there."""
    return [file for file in out.rglob(".*") if file.name != ".hydra"]


if __name__ == "__main__":
    sys.exit(main())
