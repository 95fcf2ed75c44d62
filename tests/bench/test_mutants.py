"""The score of the tests: a planted mutant is killed, one that means the same survives."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

CODE = '''"""A toy."""

import math

LIMIT = 2


def largest(numbers: list[float]) -> float:
    found = -math.inf
    for number in numbers:
        if number > found:
            found = number
    return found


def unseen(number: int) -> int:
    return number + 1
'''
SHORT = """LIMIT = 2


def largest(a: list[float]) -> float:
    return a[0] if a[0] > a[1] else max(a)
"""
TEST = """from toy.sizes.code import LIMIT, largest


def test_largest() -> None:
    assert largest([1.0, 3.0, 2.0]) == 3.0


def test_limit() -> None:
    assert LIMIT == 2
"""


@pytest.fixture
def mutants(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("bench/mutants.py")


@pytest.fixture
def toy(mutants: ModuleType, tmp_path: Path) -> tuple:
    """Return a project of one module and its test."""
    for name, text in (("toy/__init__.py", ""), ("toy/sizes/code.py", CODE)):
        file = tmp_path / "src" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    (tmp_path / "src" / "toy" / "sizes" / "__init__.py").touch()
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_toy_sizes.py").write_text(TEST)
    (tmp_path / "pytest.ini").touch()
    return mutants.Place(tmp_path, "toy")


@pytest.mark.slow
def test_a_planted_mutant_is_killed_and_an_equal_one_survives(
    mutants: ModuleType, toy: tuple, tmp_path: Path
) -> None:
    reach = mutants.find_reach(toy, ["tests"], tmp_path / "reach")
    assert len(reach.lines) == 2
    made = mutants.list_mutants(tmp_path / "src" / "toy" / "sizes" / "code.py")
    by_text = {(mutant.before, mutant.after): mutant for mutant in made}
    outcomes = {
        texts: mutants.try_one(toy, by_text[texts], reach)
        for texts in (
            ("number > found", "number <= found"),
            ("number > found", "number >= found"),  # of two equal numbers, either is the largest
            ("found = -math.inf", "found = math.inf"),
            ("return found", "return -found"),
            ("LIMIT = 2", "LIMIT = 3"),
            ("number + 1", "number - 1"),
        )
    }
    assert list(outcomes.values()) == [
        mutants.KILLED, mutants.SURVIVED, mutants.KILLED, mutants.KILLED, mutants.KILLED,
        mutants.SURVIVED,
    ]  # fmt: skip
    assert mutants.choose(by_text["number + 1", "number - 1"], reach) == []


def test_endless_and_broken_mutants_are_told_apart(
    mutants: ModuleType, toy: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "src" / "toy" / "sizes" / "code.py"
    file.write_text(CODE + "\n\nCHECKED = 1 / LIMIT\nwhile LIMIT > 2:\n    pass\n")
    reach = mutants.find_reach(toy, ["tests"], tmp_path / "reach")
    by_text = {(mutant.before, mutant.after): mutant for mutant in mutants.list_mutants(file)}
    monkeypatch.setattr(mutants, "_LIMIT", 1)
    endless = by_text["LIMIT > 2", "LIMIT >= 2"]
    assert mutants.try_one(toy, endless, reach) == mutants.SLOW
    file.write_text(CODE.replace("LIMIT = 2", "LIMIT = 2\nASKED = [0, 1][1]"))
    by_text = {(mutant.before, mutant.after): mutant for mutant in mutants.list_mutants(file)}
    broken = by_text["[0, 1][1]", "[0, 1][2]"]
    assert mutants.try_one(toy, broken, reach) == mutants.BROKEN


@pytest.mark.slow
def test_the_command_prints_its_score(
    mutants: ModuleType, toy: tuple, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "src" / "toy" / "sizes" / "code.py").write_text(SHORT)
    asked = ["400", "--seed", "3", "--packages", "sizes", "--tests", "tests"]
    assert mutants.main(asked, toy) == 0
    told = capsys.readouterr().out
    # the largest of three is the third: neither the first nor the comparison is needed
    assert "  src/toy/sizes/code.py:5  a[0] > a[1] -> a[0] >= a[1]\n" in told
    assert "LIMIT" not in told
    survived = int(told.split(" killed, ")[-1].split()[0])
    assert told.count(" -> ") == survived
    assert f"all: {len(mutants.draw(toy, ['sizes'], 400, 3)) - survived} killed" in told


def test_the_interval_is_wilsons(mutants: ModuleType) -> None:
    low, high = mutants.wilson(85, 100)
    assert (low, high) == pytest.approx((0.7672, 0.9069), abs=1e-4)
    assert mutants.wilson(0, 10)[0] == pytest.approx(0, abs=1e-12)
    assert mutants.wilson(0, 0) == (0, 1)


def test_what_no_program_could_notice_is_left_alone(mutants: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "quiet.py"
    file.write_text(
        '"""Doc."""\n\n\ndef ask(a: int | None, b: list[int]) -> None:\n'
        '    """Ask."""\n    if a is None:\n        raise ValueError("no" + str(3))\n'
        "    print(list(zip(b, b, strict=True)), 1e-9)\n"
    )
    changed = {mutant.before for mutant in mutants.list_mutants(file)}
    assert changed == {"a is None", "print(list(zip(b, b, strict=True)), 1e-09)"}


def test_what_no_test_on_a_cpu_could_notice_is_not_drawn(
    mutants: ModuleType, tmp_path: Path
) -> None:
    file = tmp_path / "code.py"
    file.write_text(
        "_CHUNK = 1 << 20\n\n\n"
        "def f(x, chunk=1 << 4):\n"
        "    rows = max(1, chunk // len(x))\n"
        "    return zeros(max(1, 3), device=x.device, meaning='in words', unit='mm')\n"
    )
    changes = {(mutant.before, mutant.after) for mutant in mutants.list_mutants(file)}
    assert {before.split("(")[0] for before, _ in changes} == {"max", "zeros"}
    without = [after for before, after in changes if before.startswith("zeros")]
    rest = ", device=x.device, meaning='in words'"
    assert sorted(without) == [f"ones(max(1, 3){rest}, unit='mm')", f"zeros(max(1, 3){rest})"]
    assert ("max(1, 3)", "max(2, 3)") in changes
