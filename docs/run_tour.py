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


def main() -> int:
    """Run the whole tour in processes of their own, each command shown before it runs; stop at the
    first that fails.
    """
    for words in commands(PAGE.read_text()):
        print(f"\n$ {shlex.join(words)}", flush=True)
        if status := subprocess.run([sys.executable, *words[1:]], cwd=HOME, check=False).returncode:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main())
