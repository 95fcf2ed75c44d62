"""Programs of bench/ that run in environments of their own, and answer one question at a time.

A question and its answer are a line of JSON each. `serve` is the program's side and `Peer` the
bench's. This module needs nothing but Python's own library, since the peers' environments import it
too.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
SOURCES = HERE.parent / "src"


class PeerError(RuntimeError):
    """A peer's program ended, or said that it failed."""


class Peer:
    """A program that waits for questions; while it waits it computes nothing.

    Args:
        program: A file of this folder, or the words of a command.
        python: The interpreter that runs it, of the environment that the peer is installed in.
        threads: Threads that its libraries may use.

    Raises:
        PeerError: The interpreter cannot be run, or the program does not start.
    """

    def __init__(self, program: str, python: str = sys.executable, threads: int = 1) -> None:
        self.name = program
        limits = (f"{library}_NUM_THREADS" for library in ("OMP", "OPENBLAS", "NUMBA"))
        env = os.environ | dict.fromkeys(limits, str(threads)) | {"PYTHONPATH": str(SOURCES)}
        try:
            words, pipe = [python, "-W", "ignore", str(HERE / program)], subprocess.PIPE
            self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, env=env, text=True)
        except OSError as error:
            raise PeerError(f"{program}: {python} cannot be run: {error}") from error
        self.about: dict[str, Any] = self._read()

    def ask(self, question: str, **settings: Any) -> Any:
        """Return the answer to a question.

        Raises:
            PeerError: The program failed or ended.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"question": question} | settings) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise PeerError(f"{self.name}: ended before it was asked") from error
        return self._read()["answer"]

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise PeerError(f"{self.name}: ended without an answer (its error is above)")
        told: dict[str, Any] = json.loads(line)
        if "error" in told:
            raise PeerError(f"{self.name}: {told['error']}")
        return told

    def close(self) -> None:
        """End the program."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.wait()

    def __enter__(self) -> "Peer":
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the program."""
        self.close()


def serve(about: Mapping[str, Any], answers: Mapping[str, Callable[..., Any]]) -> None:
    """Answer questions until there are no more.

    What libraries print goes to the standard error, so that only answers are read.

    Args:
        about: What the bench is told first, such as versions.
        answers: A function for each question; it takes the question's settings.
    """
    own = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    print(json.dumps(dict(about)), file=own, flush=True)
    for line in sys.stdin:
        settings = json.loads(line)
        try:
            told = {"answer": answers[settings.pop("question")](**settings)}
        except Exception as error:
            told = {"error": f"{type(error).__name__}: {error}"}
        print(json.dumps(told), file=own, flush=True)
