"""Tests do not depend on those before them: what a command leaves in the log is taken out of it."""

import logging
import sys

import pytest


@pytest.mark.parametrize("turn", [0, 1])
def test_a_log_line_finds_no_closed_stream(turn: int, capsys: pytest.CaptureFixture[str]) -> None:
    root = logging.getLogger()
    assert not [one for one in root.handlers if type(one) is logging.StreamHandler]
    root.addHandler(logging.StreamHandler(sys.stderr))  # as Hydra does for each command
    root.warning("turn %d", turn)
    assert capsys.readouterr().err == f"turn {turn}\n"
