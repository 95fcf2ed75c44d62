"""Particle-steps a second of filter cores, on the task of filter_task.py.

`bench/peers.py filters` says how it is called. Every library runs in an environment of its own and
waits while another computes; they take turns, so that a machine whose speed drifts disturbs all
alike. Each also tells its estimate of the log evidence: the same for all, or they do not compute
the same.
"""

import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

from marked import format_row
from peer_process import Peer

HEAD = ("particles", "library", "million particle-steps a second", "posefilter over it")
HEAD += ("least", "most", "log evidence")
SIZES = {100: 200, 1_000: 100, 10_000: 20, 100_000: 5}  # particles: steps
OWN = "posefilter"


class Runner(NamedTuple):
    """A library, or a way of using one."""

    name: str
    peer: Peer
    settings: dict[str, Any]


def list_runners(own: Peer, pydpf: Peer | None, particles: Peer | None) -> list[Runner]:
    """Return what is compared, posefilter first."""
    runners = [Runner(OWN, own, {})]
    if pydpf is not None:
        for way, title in (("quaternions", "pydpf, lean"), ("matrices", "pydpf, matrices")):
            runners.append(Runner(title, pydpf, {"way": way}))
    if particles is not None:
        runners.append(Runner("particles", particles, {}))
    return runners


def measure(
    runners: Sequence[Runner], count: int, steps: int, repeats: int
) -> dict[str, list[dict[str, float]]]:
    """Return each runner's answers, `repeats` of them, taken by turns after one to warm up."""
    told: dict[str, list[dict[str, float]]] = {runner.name: [] for runner in runners}
    for repeat in range(repeats + 1):
        for runner in runners:
            settings = {"particles": count, "steps": steps, "seed": repeat} | runner.settings
            answer = runner.peer.ask("run", **settings)
            if repeat:
                told[runner.name].append(answer)
    return told


def make_lines(count: int, steps: int, told: dict[str, list[dict[str, float]]]) -> list[str]:
    """Return the table's lines of one number of particles: medians, and the pairs' ratios."""
    own = [answer["seconds"] for answer in told[OWN]]
    lines = []
    for name, answers in told.items():
        seconds = [answer["seconds"] for answer in answers]
        ratios = sorted(theirs / ours for theirs, ours in zip(seconds, own, strict=True))
        rate = count * steps / statistics.median(seconds) / 1e6
        cells = [f"{count:,}", name, f"{rate:.2f}"]
        if name == OWN:
            cells += ["1", "–", "–"]
        else:
            cells += [f"{x:.1f}" for x in (statistics.median(ratios), ratios[0], ratios[-1])]
        cells.append(f"{statistics.median(answer['evidence'] for answer in answers):.1f}")
        lines.append(format_row(cells))
    return lines
