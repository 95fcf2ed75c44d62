"""What the programs of this folder share: how they read their command line, and run others."""

import argparse
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

HOME = Path(__file__).parents[1]


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help shows a program's description as it stands."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def run_command(words: Sequence[str], skip: bool = False) -> int:
    """Print a program of the project and its words, as they could be typed; run it, and return its
    status.

    skip: only print it.
    """
    print(f"$ python {shlex.join(words)}", flush=True)
    if skip:
        return 0
    return subprocess.run([sys.executable, *words], cwd=HOME, check=False).returncode
