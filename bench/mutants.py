"""Measure the tests: change one place of the code at a time, and count how often a test fails.

    python bench/mutants.py [COUNT] [--seed SEED] [--minutes MINUTES]
        [--packages NAME ...] [--tests PATH ...]

Each mutant is one changed place of a module: an operator, a constant, a sign, a condition, a
`dim=`, a function for its opposite, a keyword or a call that is left out. COUNT of them are drawn,
an even share of each package. For each, the tests that reach its line run, the cheap ones first,
until one fails. Which test reaches which line is found out first, by one run of all tests as they
are.

Prints how many were killed, survived, took too long (which counts as killed) and could not be
imported (which are left out), the score with its 95 % interval by Wilson, and the survivors.

What no test of right behavior could notice stays as it is: annotations, docstrings, texts for
readers, `strict=` of zip, `repr=`, constants below 1e-5, which guard divisions, sizes of chunks and
other powers of two written as shifts, which only bound memory, and `device=`, which a CPU ignores.

mutmut and cosmic-ray do this for any project. mutmut makes every mutant there is of a copy of the
tree and has no drawing by a seed; it changes neither constants of modules and classes nor decorated
functions. cosmic-ray starts Python for each mutant, which is seconds of importing torch. Here a
process that has imported everything but this project is forked, and imports the changed module.
`forking.py` serves commands of the project, so that it has imported what must not be imported here;
`forked.py` has what both need.
"""

import argparse
import ast
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import math
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from types import CodeType, ModuleType

import pytest
from changing import Mutant, graft, list_mutants
from forked import leave, wait
from programs import HOME
from reached import QUIET, Place, Reach, find_reach, forget

PACKAGES = ("metrics", "geometry", "filters", "losses")
TESTS = (
    *(f"tests/{name}" for name in PACKAGES), "tests/laws", "tests/data/test_parts.py",
    "tests/cli/test_bop_scores.py", "tests/report/test_image_errors.py",
    "tests/nets/test_proposals.py",
)  # fmt: skip
KILLED, SURVIVED, SLOW, BROKEN = "killed", "survived", "timed out", "not importable"
_LIMIT = 20  # of processor time, to which five times that of the tests is added [s]
_NOT_IMPORTED = 90  # exit status
_MOST = 8.0  # of tests a mutant, the cheapest [s]: the slow ones are seldom those that notice

OURS = Place(HOME, "posefilter")


def main(arguments: Sequence[str] | None = None, place: Place = OURS) -> int:
    """Draw mutants, try them, print the score and the survivors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("count", type=int, nargs="?", default=150)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--packages", nargs="+", default=PACKAGES)
    parser.add_argument("--tests", nargs="+", default=TESTS)
    parser.add_argument("--minutes", type=float, default=math.inf, help="after which it stops")
    options = parser.parse_args(arguments)
    os.environ["OMP_NUM_THREADS"] = "1"  # a forked process would miss the threads
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        reach = find_reach(place, options.tests, Path(folder) / "reach")
    import_all(reach.imported)
    total = sum(reach.seconds.values())
    print(f"{len(reach.lines)} tests, {total:.0f} s as they are")
    mutants = draw(place, options.packages, options.count, options.seed)
    print(f"{len(mutants)} mutants, seed {options.seed}", flush=True)
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for number, mutant in enumerate(random.Random(options.seed).sample(mutants, len(mutants))):
        if time.monotonic() - began > 60 * options.minutes:
            print(f"stopped after {number}, which are drawn as well")
            break
        if number % 25 == 0 and number:
            print(f"{number}: {tell(sum(counts.values(), Counter()))}")
        outcome = try_one(place, mutant, reach)
        counts[mutant.file.parent.name][outcome] += 1
        if outcome == SURVIVED:
            print(describe(place, mutant, reach), flush=True)
    for name in options.packages:
        print(f"{name}: {tell(counts[name])}")
    print(f"all: {tell(sum(counts.values(), Counter()))}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = used.ru_utime + used.ru_stime
    print(f"{spent:.0f} s of processor time, the run of the tests as they are included")
    return 0


def tell(counts: Counter[str]) -> str:
    """Return counts and the score in one line."""
    killed, tried = counts[KILLED] + counts[SLOW], counts.total() - counts[BROKEN]
    low, high = wilson(killed, tried)
    words = ", ".join(f"{counts[name]} {name}" for name in (KILLED, SURVIVED, SLOW, BROKEN))
    score = killed / tried if tried else math.nan
    return f"{words}; score {100 * score:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def wilson(hits: int, tried: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's interval of a probability, for hits of tried draws."""
    if not tried:
        return 0.0, 1.0
    share, more = hits / tried, z * z / tried
    middle = (share + more / 2) / (1 + more)
    half = z * math.sqrt(share * (1 - share) / tried + more / tried / 4) / (1 + more)
    return middle - half, middle + half


def describe(place: Place, mutant: Mutant, reach: Reach) -> str:
    """Return a survivor in one line."""
    where = mutant.file.relative_to(place.home)
    seen = "" if choose(mutant, reach) else "  (no test reaches it)"
    return f"  {where}:{mutant.line}  {mutant.before} -> {mutant.after}{seen}"


def draw(place: Place, packages: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Draw mutants, an even share of each package, the first of them getting what is left."""
    chosen = []
    for number, name in enumerate(packages):
        folder = place.home / "src" / place.project / name
        all_of_it = [m for file in sorted(folder.rglob("*.py")) for m in list_mutants(file)]
        share = count // len(packages) + (number < count % len(packages))
        rng = random.Random(f"{seed} {name}")
        chosen += rng.sample(all_of_it, min(share, len(all_of_it)))
    return chosen


def try_one(place: Place, mutant: Mutant, reach: Reach) -> str:
    """Run the tests that reach a mutant, in a forked process, until one fails."""
    tests = choose(mutant, reach)
    if not tests:
        return SURVIVED
    usual = sum(reach.seconds[test] for test in tests)
    limit = math.ceil(_LIMIT + 5 * usual)
    number = os.fork()
    if not number:
        leave(lambda: run_tests(place, mutant, tests), limit)
    status = wait(number, 10 * limit)
    if status in (None, -signal.SIGXCPU, -signal.SIGKILL):
        return SLOW
    return {0: SURVIVED, _NOT_IMPORTED: BROKEN}.get(status, KILLED)


def choose(mutant: Mutant, reach: Reach) -> list[str]:
    """Return tests that reach a mutant, by file: those of its package first, cheap files first."""
    name = str(mutant.file)
    # what an import runs is seen by tests that reach nothing of the module: by those beside others
    files = {test.split("::")[0] for test, reached in reach.lines.items() if name in reached}
    found = []
    for test, reached in reach.lines.items():
        seen = (
            reached.get(name, set()) & mutant.lines
            if mutant.lines
            else test.split("::")[0] in files
        )
        if seen:
            found.append((test, reach.seconds[test]))
    costs: Counter[str] = Counter()
    for test, seconds in found:
        costs[test.split("::")[0]] += seconds  # type: ignore[assignment]
    package = f"/{mutant.file.parent.name}/"

    def key(entry: tuple[str, float]) -> tuple[bool, float, str, float]:
        file = entry[0].split("::")[0]
        return package not in file, costs[file], file, entry[1]

    order = sorted(found, key=key)
    sums = accumulate(seconds for _, seconds in order)
    return [test for (test, _), spent in zip(order, sums, strict=True) if spent <= _MOST]


def run_tests(place: Place, mutant: Mutant, tests: Sequence[str]) -> int:
    """Import the changed module, run tests file by file; return the exit status."""
    tree = graft(ast.parse(mutant.file.read_text()), mutant.index, mutant.new)
    code = compile(ast.fix_missing_locations(tree), str(mutant.file), "exec")
    forget(place)
    name = place.module(mutant.file)
    sys.meta_path.insert(0, Changed(name, mutant.file, code))
    try:
        importlib.import_module(name)
    except Exception:
        return _NOT_IMPORTED
    files: dict[str, list[str]] = {}
    for test in tests:
        files.setdefault(test.split("::")[0], []).append(test)
    for several in files.values():
        if status := int(pytest.main([*QUIET, f"--rootdir={place.home}", *several])):
            return status
    return 0


class Changed(importlib.abc.MetaPathFinder):
    """Finds one module, and runs other code for it."""

    def __init__(self, name: str, file: Path, code: CodeType) -> None:
        self.name, self.file, self.code = name, file, code

    def find_spec(
        self, name: str, path: object = None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self.name:
            return None
        loader = _Loader(name, str(self.file))
        loader.changed = self.code
        return importlib.util.spec_from_file_location(name, self.file, loader=loader)


class _Loader(importlib.machinery.SourceFileLoader):
    changed: CodeType

    def get_code(self, fullname: str) -> CodeType:
        return self.changed


def import_all(names: Sequence[str]) -> None:
    """Import what tests import of others, so that each forked process has it."""
    for name in names:
        if name.split(".")[0] not in ("__main__", "_pytest", "pytest", "py"):
            with suppress(BaseException):
                importlib.import_module(name)
    if (torch := sys.modules.get("torch")) is not None:
        torch.set_num_threads(1)
    gc.collect()
    gc.freeze()  # a forked process need not look at what is there
    if (cv2 := sys.modules.get("cv2")) is not None:
        cv2.setNumThreads(1)


if __name__ == "__main__":
    sys.exit(main())
