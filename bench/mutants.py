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

What no right program could notice stays as it is: annotations, docstrings, messages of errors,
`strict=` of zip, and constants below 1e-5, which guard divisions.

mutmut and cosmic-ray do this for any project. mutmut makes every mutant there is of a copy of the
tree and has no drawing by a seed; it changes neither constants of modules and classes nor decorated
functions. cosmic-ray starts Python for each mutant, which is seconds of importing torch. Here a
process that has imported everything but this project is forked, and imports the changed module.
`forking.py` serves commands of the project, so that it has imported what must not be imported here.
"""

import argparse
import ast
import copy
import gc
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import math
import os
import pickle
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from types import CodeType, FrameType, ModuleType
from typing import Any, NamedTuple

import pytest

HOME = Path(__file__).parents[1]
PACKAGES = ("metrics", "geometry", "filters", "losses")
TESTS = (
    *(f"tests/{name}" for name in PACKAGES), "tests/laws", "tests/data/test_parts.py",
    "tests/cli/test_bop_scores.py",
)  # fmt: skip
KILLED, SURVIVED, SLOW, BROKEN = "killed", "survived", "timed out", "not importable"
_LIMIT = 20  # of processor time, to which five times that of the tests is added [s]
_NOT_IMPORTED = 90  # exit status
_MOST = 8.0  # of tests a mutant, the cheapest [s]: the slow ones are seldom those that notice
_LEAST = 1e-5  # a smaller constant guards a division
_QUIET = ("-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist")

_SWAPPED: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt), ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,), ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,), ast.Mult: (ast.Div,), ast.Div: (ast.Mult,), ast.FloorDiv: (ast.Mult,),
    ast.Mod: (ast.Mult,), ast.Pow: (ast.Mult,), ast.BitAnd: (ast.BitOr,), ast.BitOr: (ast.BitAnd,),
    ast.And: (ast.Or,), ast.Or: (ast.And,),
}  # fmt: skip
_PAIRS = (
    ("min", "max"), ("amin", "amax"), ("minimum", "maximum"), ("argmin", "argmax"),
    ("any", "all"), ("sin", "cos"), ("floor", "ceil"), ("sum", "mean"), ("zeros", "ones"),
    ("zeros_like", "ones_like"), ("isfinite", "isnan"),
)  # fmt: skip
_OPPOSITE = dict(_PAIRS) | {b: a for a, b in _PAIRS}


class Place(NamedTuple):
    """A project that is judged."""

    home: Path  # its folder; src/ and the tests are below it
    project: str  # the name of its package below src/

    def module(self, file: Path) -> str:
        """Return the name by which a file below src/ is imported."""
        parts = file.relative_to(self.home / "src").with_suffix("").parts
        return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


OURS = Place(HOME, "posefilter")


class Mutant(NamedTuple):
    """One changed place."""

    file: Path
    index: int  # of the node, in the order of ast.walk
    new: ast.AST  # what takes its place
    lines: frozenset[int]  # that run it; none: it runs when the module is imported
    line: int
    before: str
    after: str


class Reach(NamedTuple):
    """What each test reaches."""

    lines: dict[str, dict[str, set[int]]]  # of each test, by file
    seconds: dict[str, float]  # that each test takes
    imported: list[str]  # modules of others that the tests import


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


# ------------------------------------------------------------------------------------- mutants


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


def list_mutants(file: Path) -> list[Mutant]:
    """Return every mutant of a file."""
    tree = ast.parse(file.read_text())
    index = {id(node): number for number, node in enumerate(ast.walk(tree))}
    found = []
    for node, path in walk(tree, ()):
        for new in vary(node, path):
            before, after = show(node, new, path)
            if before != after:
                line = getattr(node, "lineno", 0)
                lines = find_lines(node, path)
                found.append(Mutant(file, index[id(node)], new, lines, line, before, after))
    return found


def walk(node: ast.AST, path: tuple[ast.AST, ...]) -> Iterator[tuple[ast.AST, tuple[ast.AST, ...]]]:
    """Return the nodes that may change, each with those around it, the outermost first."""
    yield node, path
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "type_params", "bases", "msg"):
            continue
        for child in value if isinstance(value, list) else [value]:
            plain = isinstance(child, ast.AST)
            guard = isinstance(child, ast.keyword) and child.arg == "strict"
            if plain and not guard and not isinstance(child, ast.Raise | ast.JoinedStr):
                yield from walk(child, (*path, node))


def vary(node: ast.AST, path: tuple[ast.AST, ...]) -> Iterator[ast.AST]:
    """Return what may take a node's place."""
    around = path[-1] if path else None
    match node:
        case ast.Compare(ops=ops):
            for at, op in enumerate(ops):
                for other in _SWAPPED[type(op)]:
                    yield with_change(
                        node, lambda new, at=at, o=other: new.ops.__setitem__(at, o())
                    )
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op):
            for other in _SWAPPED.get(type(op), ()):
                yield with_change(node, lambda new, o=other: setattr(new, "op", o()))
        case ast.UnaryOp(op=ast.Not() | ast.Invert() | ast.USub(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if value == 0 or _LEAST <= abs(value) < math.inf:
            yield ast.Constant(2 * value if value else 1.0)
        case ast.Return(value=ast.expr() as value) if _is_number(path):
            yield ast.Return(ast.UnaryOp(ast.USub(), value))
        case ast.Attribute(attr=name) if name in _OPPOSITE:
            yield with_change(node, lambda new: setattr(new, "attr", _OPPOSITE[name]))
        case ast.Name(id=name) if name in _OPPOSITE and isinstance(around, ast.Call):
            if around.func is node:
                yield ast.Name(_OPPOSITE[name], ast.Load())
        case ast.If(test=test) | ast.IfExp(test=test) | ast.While(test=test):
            negated = ast.UnaryOp(ast.Not(), test)
            yield with_change(node, lambda new: setattr(new, "test", negated))
        case ast.Expr(value=ast.Call()):
            yield ast.Pass()
    if isinstance(node, ast.Call):
        for at, keyword in enumerate(node.keywords):
            if keyword.arg not in (None, "strict"):
                yield with_change(node, lambda new, at=at: new.keywords.pop(at))
            if keyword.arg == "dim" and (other := _other_dim(keyword.value)) is not None:
                yield with_change(node, lambda new, at=at, o=other: _set(new.keywords[at], o))
            if keyword.arg in ("min", "max"):
                other = _OPPOSITE[keyword.arg]
                yield with_change(node, lambda new, at=at, o=other: _name(new.keywords[at], o))


def _is_number(path: tuple[ast.AST, ...]) -> bool:
    """Tell whether the function around returns a tensor or a number, by its annotation."""
    functions = [node for node in path if isinstance(node, ast.FunctionDef)]
    return bool(functions) and ast.unparse(functions[-1].returns or ast.Constant(0)) in (
        "Tensor", "float", "int", "torch.Tensor", "np.ndarray", "Array",
    )  # fmt: skip


def _other_dim(value: ast.AST) -> ast.expr | None:
    """Return the dimension before or after a constant one."""
    with suppress(ValueError, TypeError):
        dim = ast.literal_eval(value)  # type: ignore[arg-type]
        if isinstance(dim, int):
            return ast.Constant(dim - 1 if dim < 0 else dim + 1)
    return None


def _set(keyword: ast.keyword, value: ast.expr) -> None:
    keyword.value = value


def _name(keyword: ast.keyword, name: str) -> None:
    keyword.arg = name


def with_change(node: ast.AST, change: Callable[[Any], object]) -> ast.AST:
    """Return a changed copy of a node."""
    new = copy.deepcopy(node)
    change(new)
    return new


def show(node: ast.AST, new: ast.AST, path: tuple[ast.AST, ...]) -> tuple[str, str]:
    """Return how the smallest part that can be read looks before and after."""
    outer = node
    for around in reversed(path):
        small = isinstance(outer, ast.Constant | ast.Name | ast.UnaryOp | ast.Slice | ast.Tuple)
        if not small or not isinstance(around, ast.expr | ast.keyword | ast.stmt):
            break
        if isinstance(around, ast.FunctionDef | ast.ClassDef | ast.If | ast.For | ast.While):
            break
        outer = around
    if isinstance(node, ast.If | ast.While):
        return ast.unparse(node.test), ast.unparse(new.test)  # type: ignore[attr-defined]
    changed = graft(copy.deepcopy(outer), list(ast.walk(outer)).index(node), new)
    return ast.unparse(outer), ast.unparse(changed)


def graft(tree: ast.AST, index: int, new: ast.AST) -> ast.AST:
    """Return a tree, changed in place, with another node at an index of ast.walk."""
    nodes = list(ast.walk(tree))
    old = nodes[index]
    if old is tree:
        return new
    for around in nodes:
        for field, value in ast.iter_fields(around):
            if value is old:
                setattr(around, field, new)
            elif isinstance(value, list):
                value[:] = [new if one is old else one for one in value]
    return tree


def find_lines(node: ast.AST, path: tuple[ast.AST, ...]) -> frozenset[int]:
    """Return the lines of which one runs where a node does; none for what an import runs."""
    whole = (*path, node)
    functions = [n for n in whole if isinstance(n, ast.FunctionDef | ast.Lambda)]
    if not functions or any(isinstance(n, ast.arguments) for n in whole):
        return frozenset()
    statement = [n for n in whole if isinstance(n, ast.stmt)][-1]
    compound = isinstance(statement, ast.If | ast.For | ast.While | ast.With | ast.Try)
    inner = whole[min(whole.index(statement) + 1, len(whole) - 1)]
    if inner is statement and isinstance(statement, ast.If | ast.While):
        inner = statement.test
    part: Any = inner if compound and hasattr(inner, "lineno") else statement
    return frozenset(range(part.lineno, part.end_lineno + 1))


# --------------------------------------------------------------------------------------- trying


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
        if status := int(pytest.main([*_QUIET, f"--rootdir={place.home}", *several])):
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


def leave(work: Callable[[], int], limit: int | None, log: Path = Path(os.devnull)) -> None:
    """Do what a forked process has to do, and end it; what it prints goes into a file."""
    status = 1
    try:
        os.setsid()
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        sys.stdout = sys.stderr = log.open("w")
        for stream in (1, 2):
            os.dup2(sys.stdout.fileno(), stream)
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        status = work()
    except SystemExit as asked:
        status = asked.code if isinstance(asked.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(status)


def wait(number: int, seconds: float) -> int | None:
    """Return a process's exit status, minus a signal's number; None where it was killed here."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, code = os.waitpid(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(code)
        time.sleep(0.02)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    return None


# ---------------------------------------------------------------------------------------- reach


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
    quiet = [word for word in _QUIET if word != "-x"]
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
