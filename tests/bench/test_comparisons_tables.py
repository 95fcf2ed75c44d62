"""Tables of the comparisons: what is planned, and what intervals say of planted errors."""

import re
from collections.abc import Callable
from types import ModuleType

import pytest

from posefilter.metrics.image_errors import ImageError


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/comparisons.py")


def rows(errors_mm: list[float], per_scene: int = 1, seen: float = 1.0) -> list[ImageError]:
    return [
        ImageError(i // per_scene, i, 1, "carton", str(i), seen, e, e, 250.0, 1.0, 0.0, 0.1)
        for i, e in enumerate(errors_mm)
    ]


def test_every_method_is_trained_on_every_size(bench: ModuleType) -> None:
    planned = set()
    for line in bench.list_trainings():
        models, sizes = (re.search(rf" {k}=(\S+)", line) for k in ("model", "data.limit_train"))
        assert models
        assert sizes
        planned |= {(m, int(s)) for m in models[1].split(",") for s in sizes[1].split(",")}
    assert planned == {(m, s) for m in bench.MODELS for s in (50, 100, 200, 400, 1000)}


def test_an_interval_is_over_scenes_and_not_over_images(bench: ModuleType) -> None:
    errors = [5.0] * 20 + [500.0] * 20
    read = lambda text: [float(x) for x in re.findall(r"[\d.]+", text)]  # noqa: E731
    share, low, high = read(bench.bootstrap(rows(errors), bench.measure_recall))
    _, wider_low, wider_high = read(bench.bootstrap(rows(errors, 10), bench.measure_recall))
    assert share == 50
    assert 30 < low < 40 < 60 < high < 70  # a binomial's of 40: 50 +- 15.5
    assert (wider_low, wider_high) == (0, 100)  # four scenes
    assert bench.bootstrap(rows([5.0] * 8), bench.measure_recall) == "100.0 [100, 100]"


def test_tables_have_a_dash_where_nothing_was_run(bench: ModuleType) -> None:
    tests = [bench.Tested("keypoints", 1000, rows([0.0] * 4) + rows([500.0] * 4, 1, 0.4))]
    head, table = bench.tabulate(tests[:1], [50, 1000], bench.measure_recall)
    assert head == ["", "50", "1,000"]
    assert any(line.startswith("| `keypoints` | – | 50.0 [") for line in table)
    assert "| `pose_pf` | – | – |" in table
    head, seen = bench.tabulate_visibility(tests)
    assert "| `keypoints` | 0.0 [0, 0] | – | 100.0 [100, 100] |" in seen
    images = ["0.3 to 0.5 (4 images)", "0.5 to 0.8 (0 images)", "0.8 to 1 (4 images)"]
    assert head == ["", *images]
