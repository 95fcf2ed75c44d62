"""Tests do not depend on those before them: what a command leaves in the log is taken out of it.
And of a log, what is said on the console.
"""

import logging
import sys

import pytest

from posefilter.cli.build import quiet
from posefilter.cli.console import settle_logging


@pytest.mark.parametrize("turn", [0, 1])
def test_a_log_line_finds_no_closed_stream(turn: int, capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    assert not [one for one in root.handlers if type(one) is logging.StreamHandler]
    root.addHandler(logging.StreamHandler(sys.stderr))  # as Hydra does for each command
    root.warning("turn %d", turn)
    assert capsys.readouterr().err == f"turn {turn}\n"


@pytest.mark.parametrize("is_follower", [False, True])
def test_of_several_processes_the_first_one_says_what_the_log_has(
    is_follower: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others warn alone; and none says what Lightning says twice of each."""
    monkeypatch.setattr("posefilter.cli.console.is_follower", lambda: is_follower)
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.addHandler(logging.StreamHandler(sys.stdout))  # as Hydra does for each command
    settle_logging("rich")
    quiet()
    logging.getLogger("posefilter.data.module").info("train: 16 frames")
    logging.getLogger("posefilter.data.module").warning("a broken frame")
    logging.getLogger("lightning.fabric.utilities.distributed").info("Initializing distributed")
    first = "" if is_follower else "train: 16 frames\n"
    assert capsys.readouterr().out == f"{first}a broken frame\n"
