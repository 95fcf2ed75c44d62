"""errors.csv: a row an image, from which the metrics come out again, and figures of the worst and
best images.
"""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from posefilter.callbacks.errors import ErrorTable
from posefilter.callbacks.gallery import ImageSelection, KeptImage
from posefilter.confidence.calibration import Assessment
from posefilter.data.frames import FrameRecord
from posefilter.figures.layout import CAPTION, cut_text, format_length
from posefilter.geometry.pose import make_pose
from posefilter.metrics.collect import PoseErrors
from posefilter.metrics.image_errors import FILE, ImageError, read_errors, write_errors
from posefilter.metrics.scores import summarize
from posefilter.models.base import Trained
from posefilter.types import ObjectModel

ROW = ImageError(
    1,
    7,
    3,
    "carton",
    "scene_1/000007",
    0.5,
    1.25,
    0.5,
    270.0,
    0.75,
    -3.5,
    0.125,
    0.9,
    0.8,
    12.5,
    0.25,
    1.0,
)


def object_model(diameter: float = 0.2) -> ObjectModel:
    points = torch.tensor(
        [[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)]
    )
    return ObjectModel(
        "box", points, torch.zeros(3), diameter / 2, diameter, torch.eye(4)[None], points
    )


def shifted(meters: list[float]) -> torch.Tensor:
    """Return poses that lie so far from the identity 1 m ahead; NaN where there is none."""
    places = torch.tensor([[x, 0.0, 1.0] for x in meters])
    return make_pose(torch.eye(3).expand(len(meters), 3, 3), places)


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    rows = [ROW, ROW._replace(add_mm=math.inf, im_id=8, image='a "b", c', visibility=0.1 + 0.2)]
    write_errors(tmp_path / FILE, rows)
    assert read_errors(tmp_path / FILE) == rows
    older = [line.rsplit(",", 4)[0] for line in (tmp_path / FILE).read_text().splitlines()]
    (tmp_path / FILE).write_text("\n".join(older) + "\n")  # as before there were probabilities
    read = read_errors(tmp_path / FILE)
    assert [row[:-5] for row in read] == [row[:-5] for row in rows]
    assert all(math.isnan(row.probability) for row in read)
    (tmp_path / FILE).write_text((tmp_path / FILE).read_text().replace("add_mm", "other", 1))
    with pytest.raises(ValueError, match="add_mm is missing"):
        read_errors(tmp_path / FILE)


def test_errors_of_a_batch_are_in_its_order() -> None:
    """Also where an image between others was missed, and where there are several objects."""
    errors = PoseErrors([object_model(0.2), object_model(0.4)])
    guess = shifted([0.01, float("nan"), 0.03, 0.02])
    errors.update(guess, shifted([0.0] * 4), torch.tensor([1, 0, 0, 1]))
    add, _, diameter, _ = errors.last()
    assert add.tolist() == pytest.approx([0.01, math.inf, 0.03, 0.02], abs=1e-6)
    assert diameter.tolist() == pytest.approx([0.4, 0.2, 0.2, 0.4])


class Method(torch.nn.Module):
    """What the callback uses of a method."""

    calibration = True
    trained = Trained(3, 0)


@pytest.fixture
def tested(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, PoseErrors]:
    """Return the folder of a test of two batches, and the metric that its metrics.json would
    have.
    """
    monkeypatch.setattr("posefilter.callbacks.errors.PoseEstimator", Method)
    monkeypatch.setattr(
        "posefilter.callbacks.errors.find_shape", lambda trainer, method: method.object_model.hull
    )
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    symmetric = object_model()._replace(symmetries=torch.stack([torch.eye(4), half_turn]))
    errors = PoseErrors([symmetric])
    records = [
        FrameRecord(f"scene_{i // 2}/{i:06d}", f"scene_{i // 2}", i // 2, i, 1, "box", 0, ())
        for i in range(6)
    ]
    data = SimpleNamespace(records=lambda split: records)
    trainer: Any = SimpleNamespace(datamodule=data, is_global_zero=True, loggers=[], global_step=3)
    method: Any = Method()
    method.object_model, method.capabilities = object_model(), {"pose"}
    at_truth = SimpleNamespace(log_density=torch.arange(3.0), rank=torch.full((3,), 0.5))
    judged = Assessment(*torch.full((2, 3), 0.5))
    method.scores = {
        "poses": errors,
        "credibility": SimpleNamespace(last=lambda: at_truth),
        "confidence": SimpleNamespace(last=lambda: judged),
    }
    method.seconds_per_image = [0.5]
    method.particle_pixels = lambda particles, batch: torch.full((len(batch.frame_id), 4, 2), 5.0)
    table = ErrorTable(tmp_path, best=2, worst=2)
    table.on_test_epoch_start(trainer, method)
    K = torch.tensor([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    for first, meters in ((0, [0.001, 0.05, 0.3]), (3, [0.018, float("nan"), 1.5])):
        truth, guess = shifted([0.0] * 3), shifted(meters)
        errors.update(guess, truth)
        batch = SimpleNamespace(
            rgb=torch.full((3, 3, 48, 64), 0.5),
            mask=torch.ones(3, 1, 48, 64, dtype=torch.bool),
            intrinsics=K.expand(3, 3, 3),
            camera_from_object=truth,
            frame_id=torch.arange(first, first + 3),
            visibility=torch.tensor([0.25, 0.5, 1.0]),
        )
        last = SimpleNamespace(log_weights=torch.zeros(3, 4))
        trace = SimpleNamespace(
            particles=[last], belief=SimpleNamespace(score=torch.arange(3.0), best=guess)
        )
        table.on_test_trace(trainer, method, trace, batch, 0)
    table.on_test_epoch_end(trainer, method)
    return tmp_path, errors


def test_metrics_come_out_of_the_rows_again(tested: tuple[Path, PoseErrors]) -> None:
    folder, errors = tested
    rows = read_errors(folder / FILE)
    assert [row.im_id for row in rows] == list(range(6))
    assert rows[3].image == "scene_1/000003"
    assert [row.visibility for row in rows] == [0.25, 0.5, 1.0] * 2
    expected = errors.compute()
    for name in ("add", "add_s", "add_up_to_symmetry"):
        own = torch.tensor([getattr(row, f"{name}_mm") for row in rows], dtype=torch.float64) / 1000
        diameter = torch.tensor([row.diameter_mm for row in rows], dtype=torch.float64) / 1000
        assert summarize(own, diameter) == pytest.approx(expected[name], rel=1e-12)
    assert sum(math.isinf(row.add_mm) for row in rows) == expected["missed"] == 1


def test_the_worst_and_the_best_of_the_test_are_drawn(tested: tuple[Path, PoseErrors]) -> None:
    files = sorted((tested[0] / "figures").iterdir())
    assert [file.name for file in files] == ["test_best.jpg", "test_worst.jpg"]
    assert all(np.asarray(Image.open(file)).std() > 10 for file in files)


def test_a_selection_keeps_the_extremes_whatever_their_order() -> None:
    kept = ImageSelection(first=1, best=2, worst=2)
    for error in (0.3, 0.1, 0.5, 0.2, 0.4):
        image = KeptImage(0, "", error, False, *(np.zeros(0),) * 6)
        kept.offer(error, lambda image=image: image)  # type: ignore[misc]
    found = {name: [one.error for one in images] for name, images in kept.kept.items()}
    assert found == {"first": [0.3], "best": [0.1, 0.2], "worst": [0.5, 0.4]}


@pytest.mark.parametrize("best", [0.1, math.inf])
def test_an_image_is_among_the_best_or_among_the_worst(best: float) -> None:
    """Of fewer images than both take, each is drawn once."""
    kept = ImageSelection(first=9, best=2, worst=3)
    for error in (0.3, best, 0.2):
        image = KeptImage(0, "", error, False, *(np.zeros(0),) * 6)
        kept.offer(error, lambda image=image: image)  # type: ignore[misc]
    chosen = kept.separate()
    found = {name: [one.error for one in images] for name, images in chosen.items()}
    ranked = sorted((0.3, best, 0.2))
    assert found == {"first": [0.3, best, 0.2], "best": ranked[:1], "worst": ranked[:0:-1]}


def test_lengths_are_in_meters_where_millimeters_get_long() -> None:
    lengths = (0.00123, 0.0356, 0.9994, 1.3561, 250.0, math.inf)
    assert [format_length(x) for x in lengths] == [
        "1.23 mm",
        "35.6 mm",
        "999 mm",
        "1.36 m",
        "250 m",
        "missed",
    ]


def test_a_long_name_keeps_its_end() -> None:
    assert cut_text("a/7", CAPTION, 300) == "a/7"
    cut = cut_text("scene_" * 20 + "000123", CAPTION, 200)
    assert cut.startswith("…")
    assert cut.endswith("000123")
