"""Names in files of others are shown, and not obeyed: no letter of them moves a terminal's cursor,
clears it, or turns a line round.
"""

import json
import logging
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from posefilter.checking.check import format_report
from posefilter.cli.command import run_command
from posefilter.cli.console import say, settle_logging
from posefilter.errors import BadData, UserError, printable
from posefilter.forms import NUMBER, Each, check_form
from posefilter.locks import hold
from posefilter.report.gather import read_run
from posefilter.report.sweeps import read_sweep

HOME = Path(__file__).parents[2]
OWNED = "\x1b]0;owned\x07\x9b2J\u202e\nsecond line"
SHOWN = r"\x1b]0;owned\x07\x9b2J\u202e\nsecond line"


@pytest.mark.parametrize(
    ("text", "shown"),
    [(OWNED, SHOWN), ("süß 名前\u3000\xa0.ckpt", "süß 名前\u3000\xa0.ckpt"), ("\udcff", r"\udcff"),
     ("a\\x1b", "a\\x1b"), ("", "")],
)  # fmt: skip
def test_what_a_terminal_obeys_is_shown_by_its_number(text: str, shown: str) -> None:
    assert printable(text) == shown


def plain(error: UserError) -> str:
    """Return a message, in which nothing but the ends of its lines is obeyed."""
    text = str(error)
    assert text.replace("\n", "").isprintable()
    return text


def test_errors_of_the_library_are_shown(tmp_path: Path) -> None:
    assert plain(BadData(Path(OWNED), "missing", OWNED)) == f"{SHOWN}: missing ({SHOWN})"
    assert plain(UserError(OWNED)) == SHOWN.replace(r"\n", "\n")
    with pytest.raises(UserError) as caught:
        check_form({OWNED: {OWNED: "x"}}, Each(Each(NUMBER)), tmp_path)
    assert plain(caught.value) == f"{tmp_path}: its {SHOWN}.{SHOWN} should be a number, and is 'x'"


RUNS: dict[str, Callable[[Path], object]] = {"metrics.json": read_run, "a/metrics.json": read_sweep}


@pytest.mark.parametrize("name", RUNS)
def test_names_within_a_runs_files_are_shown(
    name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(json.dumps({"by_visibility": {OWNED: 1}, "overrides": {OWNED: 1}}))
    with pytest.raises(UserError) as caught:
        RUNS[name](tmp_path)
    assert "\n" not in plain(caught.value)
    given = f"run={tmp_path}" if name == "metrics.json" else f"sweep={tmp_path}"
    assert run_command("report", HOME, [given]) == 2
    assert capfd.readouterr().err.strip().isprintable()


def test_what_is_said_and_logged_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    say("text", "warning", f"warning: {OWNED}")
    assert capsys.readouterr().out == f"warning: {SHOWN}\n".replace(r"\n", "\n")
    report = {"objects": [], "problems": [OWNED], "left_out": []}
    assert f"  - {SHOWN}" in format_report(report)
    handler, log = logging.StreamHandler(sys.stdout), logging.getLogger()
    log.addHandler(handler)
    try:
        settle_logging("text")
        log.warning("%s", OWNED)
    finally:
        log.removeHandler(handler)
    assert capsys.readouterr().out == f"{SHOWN}\n".replace(r"\n", "\n")


def test_who_holds_a_folder_is_shown(tmp_path: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from posefilter.locks import hold, LOCK\n"
        "folder = Path(sys.argv[1]); hold(folder)\n"
        "lock = (folder / LOCK).open('w'); lock.write(sys.argv[2]); lock.flush()\n"
        "print('held', flush=True); sys.stdin.read()"
    )
    words = [sys.executable, "-c", code, str(tmp_path), OWNED]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, env=os.environ, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(UserError) as caught:
            hold(tmp_path)
        other.communicate("")
    assert SHOWN in plain(caught.value)
