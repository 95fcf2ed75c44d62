"""Compositions that several tests read."""

from functools import cache
from pathlib import Path

from posefilter.cli.command import compose_job
from posefilter.cli.job import Job

CONF = Path(__file__).parents[2] / "conf"


@cache
def compose_once(*overrides: str) -> Job:
    """Compose a training, once for all tests that only read it: a composition takes half a
    second.
    """
    return compose_job("train", CONF, list(overrides), Path("nowhere"))
