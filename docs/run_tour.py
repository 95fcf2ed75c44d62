"""Run the commands of docs/tour.md as they stand, one after the other: `make tour`.

The tests run them at toy size.
"""

import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from unittest.mock import patch

HOME = Path(__file__).parents[1]
PAGE = HOME / "docs" / "tour.md"


def commands(text: str) -> list[list[str]]:
    """Return the words of each command in a page's shell blocks."""
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line) for line in lines if line.strip()]


def settings(words: Sequence[str]) -> dict[str, str]:
    """Return what a command sets, by key."""
    return dict(word.split("=", 1) for word in words[2:] if "=" in word)


def call(words: Sequence[str], more: Mapping[str, Sequence[str]]) -> int:
    """Run `python SCRIPT ...` in this process, with more settings by the script's name; return its
    exit status.
    """
    assert words[0] == "python", words
    script = HOME / words[1]
    with patch.object(sys, "argv", [str(script), *words[2:], *more.get(script.stem, ())]):
        try:
            runpy.run_path(str(script), run_name="__main__")
        except SystemExit as done:
            return done.code if isinstance(done.code, int) else int(done.code is not None)
    return 0


def go_on(words: Sequence[str], home: Path) -> list[str]:
    """Return what to type for a command where an earlier tour may have been: a training is gone on
    with, and a finished one left as it is (then it is nothing).

    The other commands go on by themselves, or write the same again.
    """
    run = settings(words).get("out", "")
    if words[1] != "train.py" or not (home / run / "checkpoints").is_dir():
        return list(words)
    if (home / run / "metrics.json").is_file():
        return []
    return [*words[:2], f"resume={run}"]


def main() -> int:
    """Run the whole tour in processes of their own, each command shown before it runs; stop at the
    first that fails. Called again, it resumes an earlier tour.
    """
    for page in commands(PAGE.read_text()):
        words = go_on(page, HOME)
        if not words:
            run = settings(page)["out"]
            print(f"\n{run}: trained before; delete {run} to train it again", flush=True)
            continue
        print(f"\n$ {shlex.join(words)}", flush=True)
        if status := subprocess.run([sys.executable, *words[1:]], cwd=HOME, check=False).returncode:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
