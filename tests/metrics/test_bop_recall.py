"""The average recall and the targets of the BOP challenge."""

import json
from pathlib import Path

import numpy as np
import pytest

from posefilter.errors import UserError
from posefilter.metrics.bop_recall import TargetErrors, compute_average_recall
from posefilter.metrics.bop_targets import Target, read_targets


def errors(mssd: list[list[float]], count: int | None = None) -> TargetErrors:
    """Return errors of which MSPD is 100 times the MSSD, and VSD the same at each misalignment."""
    surface = np.array(mssd, float).reshape(len(mssd), count or len(mssd[0]))
    return TargetErrors(np.repeat(surface[..., None], 10, 2), surface, 100 * surface)


def test_right_estimates_find_all_and_none_find_none() -> None:
    assert compute_average_recall([errors([[0.0, 9.0], [9.0, 0.0]]), errors([[0.0]])])["ar"] == 100
    missed = compute_average_recall([errors([], 2), errors([[0.0]])])
    assert missed["ar"] == pytest.approx(100 / 3)
    assert np.isnan(compute_average_recall([])["ar"])


def test_thresholds_are_the_challenges() -> None:
    found = compute_average_recall([errors([[0.12]])])
    # below 8 of 0.05 ... 0.5, and as 12 px below 8 of 5 ... 50
    assert found["ar_mssd"] == found["ar_mspd"] == found["ar_vsd"] == pytest.approx(80)
    one = errors([[0.12]])
    vsd = one.vsd.copy()
    vsd[..., :5] = 1.0  # wrong at the finer half of the misalignments
    found = compute_average_recall([one._replace(vsd=vsd)])
    assert found["ar_vsd"] == pytest.approx(40)
    assert found["ar"] == pytest.approx((40 + 80 + 80) / 3)


def test_two_estimates_of_one_instance_find_one() -> None:
    found = compute_average_recall([errors([[0.01, 0.9], [0.02, 0.9]])])
    assert found["ar"] == pytest.approx(50)


def test_matching_is_made_anew_for_each_threshold() -> None:
    """The first takes the second instance where that is near enough, whatever is left for others.

    Below 0.3 the first estimate has 0.1 to the second instance, the second estimate 0.2 to it and
    0.27 to the first: both are matched above 0.27, one below.
    """
    found = compute_average_recall([errors([[0.4, 0.1], [0.27, 0.2]])])
    # MSSD, thresholds 0.05 to 0.5: none at 0.05 and 0.1, one at 0.15 to 0.25, two from 0.3
    assert found["ar_mssd"] == pytest.approx(100 * (3 * 1 + 5 * 2) / 20)


def test_targets_are_read_as_written(tmp_path: Path) -> None:
    targets = [Target(48, 1, 5, 1), Target(48, 36, 14, 3)]
    content = json.dumps([one._asdict() for one in targets])
    (tmp_path / "targets.json").write_text(content)
    path = tmp_path / "targets.json"
    assert read_targets(str(path), tmp_path / "none") == (path, targets)
    assert read_targets("targets.json", tmp_path) == (path, targets)  # in the dataset's folder
    assert read_targets("targets.json", tmp_path / "test") == (path, targets)  # or a split's


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "not readable as JSON"),
        ("{}", "a list of targets"),
        ('[{"scene_id": 1, "im_id": 2, "obj_id": 3}]', "entry 0: scene_id"),
        ('[{"scene_id": 1, "im_id": 2}]', "entry 0: names an image and no object"),
        ('[{"scene_id": 1, "im_id": 2, "obj_id": 3, "inst_count": 0}]', "inst_count=0"),
        ('[{"scene_id": 1, "im_id": true, "obj_id": 3, "inst_count": 1}]', "whole numbers"),
        (
            '[{"scene_id": 1, "im_id": 2, "obj_id": 3, "inst_count": 1},'
            '{"scene_id": 1, "im_id": 2, "obj_id": 3, "inst_count": 2}]',
            "twice",
        ),
    ],
)
def test_other_files_are_refused_in_one_line(content: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "targets.json"
    path.write_text(content)
    with pytest.raises(UserError, match=told) as caught:
        read_targets(str(path), tmp_path)
    assert "\n" not in str(caught.value)
    with pytest.raises(UserError, match="no such file"):
        read_targets("none.json", tmp_path)
