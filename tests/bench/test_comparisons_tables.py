"""Tables of the comparisons: what is planned, and what intervals say of planted errors."""

import re
from collections.abc import Callable
from itertools import product
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


def test_every_method_is_trained_on_every_size_and_the_ends_with_three_seeds(
    bench: ModuleType,
) -> None:
    planned = []
    for piece in bench.PLAN:
        for line in bench.list_lines(piece) if piece.table != "clutter" else []:
            model, sizes, seeds, sweep = (
                re.search(rf" {k}=(\S+)", line)[1]  # type: ignore[index]
                for k in ("model", "data.limit_train", "seed", "sweep")
            )
            for size, seed in product(sizes.split(","), seeds.split(",")):
                planned.append((sweep, model, int(size), int(seed)))
    assert len(planned) == len(set(planned))
    for model in bench.MODELS:
        assert {p[2] for p in planned if p[:2] == ("learning_curve", model)} == {*bench.SIZES}
        for size, seed in product((50, 200, 1000), range(3)):
            assert ("learning_curve", model, size, seed) in planned
        assert ("learning_time", model, 50, 0) in planned
    # a test comes after the training that it tests
    names = [piece.name for piece in bench.PLAN]
    assert names.index("many") < names.index("distractors")
    assert names.index("many_seeds") < names.index("distractors_seeds")


def test_a_piece_takes_as_long_as_its_steps_its_tests_and_its_runs(bench: ModuleType) -> None:
    one = bench.Piece("x", "learning_curve", (50,))
    minutes = bench.estimate_minutes(one, "keypoints")
    step, image = bench.COSTS["keypoints"]
    assert minutes * 60 == pytest.approx(12 + 300 * step + 120 * (image + 0.1))
    more = one._replace(sizes=(50, 100), seeds=(1, 2))
    assert bench.estimate_minutes(more, "keypoints") == pytest.approx(4 * minutes)


def test_an_interval_is_over_scenes_and_not_over_images(bench: ModuleType) -> None:
    errors = [5.0] * 20 + [500.0] * 20
    read = lambda text: [float(x) for x in re.findall(r"[\d.]+", text)]  # noqa: E731
    share, low, high = read(bench.bootstrap([rows(errors)], bench.measure_recall))
    _, wider_low, wider_high = read(bench.bootstrap([rows(errors, 10)], bench.measure_recall))
    assert share == 50
    assert 30 < low < 40 < 60 < high < 70  # a binomial's of 40: 50 +- 15.5
    assert (wider_low, wider_high) == (0, 100)  # four scenes
    assert bench.bootstrap([rows([5.0] * 8)], bench.measure_recall) == "100.0 [100, 100]"


def test_an_interval_is_over_seeds_too(bench: ModuleType) -> None:
    good, bad = rows([5.0] * 20), rows([500.0] * 20)
    assert bench.bootstrap([good, bad], bench.measure_recall) == "50.0 [0, 100] (2)"
    assert bench.bootstrap([good, good, good], bench.measure_recall) == "100.0 [100, 100] (3)"


def test_tables_have_a_dash_where_nothing_was_run(bench: ModuleType) -> None:
    tests = [bench.Tested("keypoints", 1000, 0, rows([0.0] * 4) + rows([500.0] * 4, 1, 0.4))]
    head, table = bench.tabulate(tests[:1], [50, 1000], bench.measure_recall)
    assert head == ["", "50", "1,000"]
    assert any(line.startswith("| `keypoints` | – | 50.0 [") for line in table)
    assert "| `pose_pf` | – | – |" in table
    head, seen = bench.tabulate_visibility(tests, 1000)
    assert "| `keypoints` | 0.0 [0, 0] | – | 100.0 [100, 100] |" in seen
    images = ["0.3 to 0.5 (4 images)", "0.5 to 0.8 (0 images)", "0.8 to 1 (4 images)"]
    assert head == ["", *images]


def test_cells_of_what_was_not_run_stay(bench: ModuleType) -> None:
    old = ["| `keypoints` | 1.0 [0, 3] | – |", "| `pose_pf` | 2.0 [1, 3] (3) | 5.0 [4, 6] |"]
    tests = [bench.Tested("keypoints", 1000, 0, rows([0.0] * 8))]
    _, table = bench.tabulate(tests, [50, 1000], bench.measure_recall, ["keypoints", "pixel_pf"])
    kept = bench.keep_cells([*table, "| `pose_pf` | – | – |"], old)
    assert kept == [
        "| `keypoints` | 1.0 [0, 3] | 100.0 [100, 100] |",
        "| `pixel_pf` | – | – |",
        "| `pose_pf` | 2.0 [1, 3] (3) | 5.0 [4, 6] |",
    ]


def test_detectors_are_judged_by_where_their_particles_lie(bench: ModuleType) -> None:
    seen = [
        row._replace(particles_on_object=share)
        for share, row in zip([0.5, 0.7], rows([0, 0]), strict=True)
    ]
    tests = [bench.Tested("downsized", 50, seed, seen) for seed in range(2)]
    _, table = bench.tabulate(tests, [50], bench.measure_on_object, bench.DETECTORS)
    assert table == ["| `cnn_patch` | – |", "| `downsized` | 60.0 [50, 70] (2) |"]
    _, posed = bench.tabulate(tests, [50], bench.measure_auc)
    assert not any("downsized" in row for row in posed)
