"""Which test reaches which line of a project, for `mutants.py`."""

import importlib
import os
import pickle
import sys
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any, NamedTuple

import pytest
from forked import leave, wait

QUIET = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")


class Place(NamedTuple):
    """A project that is judged."""

    home: Path  # its folder; src/ and the tests are below it
    project: str  # the name of its package below src/

    def module(self, file: Path) -> str:
        """Return the name by which a file below src/ is imported."""
        parts = file.relative_to(self.home / "src").with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


class Reach(NamedTuple):
    """What each test reaches."""

    lines: dict[str, dict[str, set[int]]]  # of each test, by file
    seconds: dict[str, float]  # that each test takes
    imported: list[str]  # modules of others that the tests import


def find_reach(place: Place, tests: Sequence[str], file: Path) -> Reach:
    """Run all tests as they are, in a forked process, and note the lines that each reaches."""
    number = os.fork()
    log = file.with_suffix(".log")
    if not number:
        leave(lambda: watch_tests(place, tests, file), None, log)
    status = wait(number, 3600)
    reach = Reach(*pickle.loads(file.read_bytes())) if file.is_file() else Reach({}, {}, [])
    if status or not reach.lines:
        print(log.read_text()[-3000:])
        raise SystemExit("the tests must pass as they are")
    return reach


def watch_tests(place: Place, tests: Sequence[str], file: Path) -> int:
    """Run all tests, and write what each reaches."""
    forget(place)
    watcher = Watcher(f"{place.home}/src/")
    quiet = [word for word in QUIET if word != "-x"]
    status = pytest.main([*quiet, f"--rootdir={place.home}", *tests], plugins=[watcher])
    others = [n for n, module in list(sys.modules.items()) if not is_own(place, n, module)]
    lines = {test: dict(found) for test, found in watcher.lines.items()}
    for test in watcher.failed:
        lines.pop(test, None)
    seconds = {test: watcher.seconds[test] for test in lines}
    file.write_bytes(pickle.dumps((lines, seconds, others)))
    return int(status)


class Watcher:
    """Notes the lines of the project that each test runs, and how long the test takes."""

    def __init__(self, below: str) -> None:
        self.below = below
        self.lines: dict[str, dict[str, set[int]]] = {}
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self._here: dict[str, set[int]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self._here = self.lines[item.nodeid] = defaultdict(set)
        began = time.process_time()
        sys.settrace(self._enter)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            self.seconds[item.nodeid] = time.process_time() - began

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed or report.skipped:
            self.failed.add(report.nodeid)

    def _enter(self, frame: FrameType, event: str, argument: object) -> Any:
        if not frame.f_code.co_filename.startswith(self.below):
            return None
        lines = self._here[frame.f_code.co_filename]

        def note(frame: FrameType, event: str, argument: object) -> Any:
            lines.add(frame.f_lineno)
            return note

        return note


def forget(place: Place) -> None:
    """Forget the project and its tests where they are imported, and find the project in src/."""
    for name, module in list(sys.modules.items()):
        if is_own(place, name, module):
            del sys.modules[name]
    sys.path[:0] = [str(place.home), str(place.home / "src")]
    importlib.invalidate_caches()
    os.chdir(place.home)


def is_own(place: Place, name: str, module: ModuleType) -> bool:
    """Tell whether a module is of the project or of its tests."""
    if name.split(".")[0] in (place.project, "tests", "conftest"):
        return True
    file = getattr(module, "__file__", None) or ""
    return name != "__main__" and file.startswith(f"{place.home}/tests")
