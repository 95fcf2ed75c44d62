"""What validation and test ask of a method of one's own: no truth in its images, a miss where it
gives no pose, and a box.
"""

import json
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tests.models.test_pose_pf import working
from tests.models.test_rehearsal import Own, build
from tests.models.toy import scenes, square

from posefilter.errors import UserError
from posefilter.filters.estimate import Argmax
from posefilter.metrics.results import flatten
from posefilter.models.base import PoseEstimator
from posefilter.types import BeliefBatch


class Lost(Argmax):
    """It has no answer to the first image."""

    def __call__(self, *args: Any) -> BeliefBatch:
        belief = super().__call__(*args)
        best = belief.best.clone()
        best[0] = torch.nan
        return belief._replace(best=best)


def test_an_estimate_that_is_no_number_is_a_miss() -> None:
    method = working().eval()
    method.filter.estimate = Lost()
    with torch.no_grad():
        method.validation_step(scenes(3), 0)
    metrics = method.compute_metrics()
    assert metrics["instances"] == 3
    assert metrics["missed"] == 1
    assert 0 <= metrics["belief"]["truth_outscored"] <= 0.67
    assert metrics["iou"] <= 0.67
    for name in ("iou", "particles_on_object"):
        assert metrics[name] == metrics[name]


def test_the_time_of_an_image_is_the_mean_over_images_and_not_over_batches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    method, clock = build(Own).eval(), iter([0.0, 3.0, 3.0, 6.0])
    monkeypatch.setattr("posefilter.models.base.time", SimpleNamespace(perf_counter=clock.__next__))
    with torch.no_grad():
        method.validation_step(scenes(3), 0)  # a second an image
        method.validation_step(scenes(1), 1)  # three
    assert method.seconds_per_image == [1, 1, 1, 3]
    assert method.compute_metrics()["seconds_per_image"] == 1.5


class Peeks(Own):
    """Its images are the mask and the place of the truth."""

    def encode(self, batch: Any) -> Any:
        self.asked = (batch.mask.clone(), batch.camera_from_object.clone())
        return super().encode(batch)


@pytest.mark.parametrize("step", ["validation_step", "test_step", "predict_step"])
def test_the_truth_does_not_reach_a_methods_images(step: str) -> None:
    method, batch = build(Peeks).eval(), scenes(2)
    with torch.no_grad():
        getattr(method, step)(batch, 0)
    mask, pose = method.asked  # type: ignore[misc]
    assert not bool(mask.any())
    assert torch.equal(pose, torch.eye(4).expand(2, 4, 4))
    method.train().training_step(batch, 0)
    mask, pose = method.asked  # type: ignore[misc]
    assert torch.equal(mask, batch.mask)
    assert torch.equal(pose, batch.camera_from_object)


def test_a_score_of_the_truth_sees_no_truth_either(monkeypatch: pytest.MonkeyPatch) -> None:
    method, seen = working().eval(), []
    encode = type(method).encode
    monkeypatch.setattr(
        type(method), "encode", lambda self, batch: seen.append(batch) or encode(self, batch)
    )
    with torch.no_grad():
        method.validation_step(scenes(2), 0)
    assert len(seen) == 1  # once a batch
    assert not any(bool(batch.mask.any()) for batch in seen)
    nothing = torch.eye(4).expand(2, 4, 4)
    assert all(torch.equal(batch.camera_from_object, nothing) for batch in seen)


def test_the_truth_is_outscored_where_the_estimate_scores_higher(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    method, batch = working().eval(), scenes(4)
    with torch.no_grad():
        trace = method.predict_step(batch, 0)
    best = batch.camera_from_object.clone()
    best[1:3, 0, 3] += 1.0  # wrong
    trace = trace._replace(belief=trace.belief._replace(best=best))
    scores = torch.tensor([[1.0, 0], [1, 0], [0, 1], [0, 1]])  # of the estimate and of the truth
    monkeypatch.setattr(type(method), "_score", lambda *_: scores)
    method.update_metrics(trace, batch)
    found = method.compute_metrics()["belief"]
    assert found["truth_outscored"] == 0.5
    assert found["truth_outscored_by_wrong"] == 0.25
    assert found["truth_outscored_by_misplaced"] == 0.25


def test_an_equivalent_pose_that_scores_higher_is_no_wrong_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    method, batch = working().eval(), scenes(2)
    half_turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0]))
    with torch.no_grad():
        trace = method.predict_step(batch, 0)
    trace = trace._replace(belief=trace.belief._replace(best=batch.camera_from_object @ half_turn))
    monkeypatch.setattr(type(method), "_score", lambda *_: torch.tensor([[1.0, 0], [0, 1]]))
    plain = method.object_model
    for symmetries, expected in (([torch.eye(4)], 0.5), ([torch.eye(4), half_turn], 0.0)):
        method.set_object(plain._replace(symmetries=torch.stack(symmetries)))
        method.update_metrics(trace, batch)
        found = method.compute_metrics()["belief"]
        assert (found["truth_outscored"], found["truth_outscored_by_wrong"]) == (0.5, expected)


def test_draws_are_of_seed_stage_epoch_and_number_and_in_training_of_the_process() -> None:
    method = working()

    def first(
        stage: str, number: int, rank: int = 0, processes: int = 1, epoch: int = 0, seed: int = 0
    ) -> int:
        method.seed = seed
        method.__dict__["_trainer"] = SimpleNamespace(world_size=processes, global_rank=rank)
        method.__dict__["current_epoch"] = epoch
        return method.generator(stage, number).initial_seed()

    train = {first("train", n, r, 2, e, s) for n, r, e, s in product((0, 1), repeat=4)}
    assert len(train) == 16
    assert len({first(s, 0) for s in ("train", "validate", "test", "predict")}) == 4
    for stage in ("validate", "test", "predict"):
        assert first(stage, 3, 1, 2, 5) == first(stage, 3)


def test_a_method_without_pose_and_box_is_refused() -> None:
    class NoBox(Own):
        box = PoseEstimator.box

    class HasPose(NoBox):
        provides = ("pixel_space", "rollout", "displacement", "pose")

    with pytest.raises(UserError, match=r"NoBox: `provides` lacks pose, so .* box\(\) of its own"):
        build(NoBox)
    assert build(HasPose).object_model.name == square().name


@pytest.mark.parametrize("value", [torch.tensor(0.25), np.float32(0.25), np.array(0.25), 0.25])
def test_a_metric_of_torchmetrics_is_logged_and_written(value: Any) -> None:
    """Its `compute` returns a tensor of no dimension."""

    class Measures(Own):
        def compute_metrics(self) -> dict[str, Any]:
            return super().compute_metrics() | {"own": {"spread": value}, "name": "text"}

    method = build(Measures).eval()
    with torch.no_grad():
        method.validation_step(scenes(2), 0)
    found = method.collect_results()
    assert json.loads(json.dumps(found))["own"] == {"spread": 0.25}
    assert flatten(found)["own/spread"] == 0.25
    assert found["name"] == "text"
