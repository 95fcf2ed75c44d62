"""Programs that run as `python -c` would, each in a process that is forked from one which has
imported the command line, and so neither torch nor anything else that takes seconds.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

HOME = Path(__file__).parents[2]
_SERVER = """
import json, os, sys, traceback
import posefilter.cli.command, posefilter.cli.main

for line in sys.stdin:
    program, folder, out, err = json.loads(line)
    number = os.fork()
    if not number:
        status = 1
        try:
            os.chdir(folder)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            for name, stream in ((out, 1), (err, 2)):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            exec(compile(program, "<string>", "exec"), {"__name__": "__main__"})
            status = 0
        except SystemExit as asked:
            status = asked.code if isinstance(asked.code, int) else 1 if asked.code else 0
            if status and not isinstance(asked.code, int):
                print(asked.code, file=sys.stderr)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]), flush=True)
"""


class Done(NamedTuple):
    """What a program left."""

    returncode: int
    stdout: str
    stderr: str


class Cold:
    """The process that is forked from, its pipes, and a folder for what programs print."""

    def __init__(self, process: subprocess.Popen[str], printed: Path) -> None:
        self._process = process
        self._printed = [printed / name for name in ("out", "err")]

    def run(self, program: str, folder: Path) -> Done:
        """Run a program in a process of its own.

        Args:
            program: Its text.
            folder: Where it starts.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        asked = json.dumps([program, str(folder), *map(str, self._printed)])
        print(asked, file=self._process.stdin, flush=True)
        status = int(self._process.stdout.readline())
        return Done(status, *(file.read_text() for file in self._printed))


@pytest.fixture(scope="session")
def cold(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cold]:
    """Start the process that is forked from; end it at the end."""
    environment = {**os.environ, "PYTHONPATH": str(HOME / "src")}  # wherever it is started
    with subprocess.Popen(
        [sys.executable, "-c", _SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        yield Cold(process, tmp_path_factory.mktemp("printed"))
        assert process.stdin is not None
        process.stdin.close()
