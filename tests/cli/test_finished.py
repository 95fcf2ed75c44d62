"""When a sweep's job need not be run again."""

import json
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from posefilter.cli.comparing import differing
from posefilter.cli.job import Job
from posefilter.cli.reuse import finished
from posefilter.errors import UserError

TYPED = ["model=downsized", "seed=1", "console=json"]


def job(folder: Path, overrides: list[str], swept: bool = True) -> Job:
    return Job(OmegaConf.create({"console": "json"}), {}, overrides, folder, "train", swept)


@pytest.mark.parametrize(
    ("overrides", "done"),
    [
        (TYPED, True),
        (["seed=1", "model=downsized"], True),
        ([*TYPED, "threads=1", "out=elsewhere", "data.workers=2"], True),
        ([*TYPED, "model/encoder=none"], False),
        (["model=downsized", "seed=2", "console=json"], False),
    ],
    ids=["the same", "another order", "with other hands", "another piece", "another seed"],
)
def test_a_job_is_done_if_nothing_that_decides_its_result_differs(
    tmp_path: Path, overrides: list[str], done: bool
) -> None:
    (tmp_path / "metrics.json").write_text(json.dumps({"overrides": TYPED, "iou": 0.5}))
    if done:
        assert finished(job(tmp_path, overrides)) == {"overrides": TYPED, "iou": 0.5}
        return
    with pytest.raises(UserError, match="holds results of other settings"):
        finished(job(tmp_path, overrides))


def test_a_default_that_has_changed_since_is_reported() -> None:
    then = {
        "choices": {"model": "downsized", "optimizer": "adamw"},
        "settings": {"filter": {"steps": 6}, "threads": 1},
    }
    now = {
        "choices": {"model": "downsized", "optimizer": "muon"},
        "settings": {"filter": {"steps": 10}, "threads": 2},
    }
    assert differing(then, now) == ["filter.steps", "optimizer"]
    pieces = [
        {"settings": {"propagate": {"pieces": [{"factor": f}]}}, "choices": {"model": "downsized"}}
        for f in (0.4, 1.0)
    ]
    assert differing(*pieces) == ["propagate.pieces.0.factor"]
    assert (
        differing(
            then, then | {"choices": {**then["choices"], "a_new_group": "of the same settings"}}
        )
        == []
    )
    assert (
        differing(
            then,
            then
            | {"settings": {"filter": {"steps": 6}, "data": {"workers": 3}, "out": "elsewhere"}},
        )
        == []
    )


def test_a_single_run_is_always_run(tmp_path: Path) -> None:
    (tmp_path / "metrics.json").write_text(json.dumps({"overrides": TYPED}))
    assert finished(job(tmp_path, TYPED, swept=False)) is None
