"""The one figure by which the best checkpoint is chosen."""

import pytest

from posefilter.metrics.results import compute_checkpoint_score


def detector(on: float, iou: float) -> dict[str, object]:
    """Return results without poses."""
    return {"add": None, "particles_on_object": on, "iou": iou}


def test_a_detector_is_scored_by_particles_and_box_alike() -> None:
    assert compute_checkpoint_score(detector(1.0, 0.5)) == pytest.approx(75.0)
    assert compute_checkpoint_score(detector(0.5, 1.0)) == pytest.approx(75.0)


def test_among_checkpoints_with_all_particles_on_the_object_the_better_box_wins() -> None:
    assert compute_checkpoint_score(detector(1.0, 0.9)) > compute_checkpoint_score(
        detector(1.0, 0.4)
    )


def test_a_method_with_poses_is_scored_by_them() -> None:
    assert compute_checkpoint_score(detector(1.0, 1.0) | {"add": {"auc": 12.5}}) == 12.5


def test_a_symmetric_object_is_scored_up_to_its_symmetries() -> None:
    turned = {"add": {"auc": 12.5}, "add_up_to_symmetry": {"auc": 97.0}}
    assert compute_checkpoint_score(detector(1.0, 1.0) | turned) == 97
    assert (
        compute_checkpoint_score(detector(1.0, 1.0) | turned | {"add_up_to_symmetry": None}) == 12.5
    )
