"""Settings of a trained method that are changed at test time."""

from pathlib import Path
from typing import Any

import pytest

from posefilter.cli.checkpoints import is_calibrated_filter
from posefilter.cli.command import compose_job
from posefilter.cli.components import changed, changes
from posefilter.errors import UserError

CONF = Path(__file__).parents[2] / "conf"
TRAINED: dict[str, Any] = {
    "filter": {
        "particles": 50,
        "refine": {"_target_": "Compose", "components": [{"a": 1}, {"b": 2}]},
    }
}


def change(typed: str, folder: Path) -> dict[str, Any]:
    """Return what `evaluate.py checkpoint=... TYPED` makes of TRAINED."""
    job = compose_job("evaluate", CONF, [f"++{typed}"], folder)
    return changed(TRAINED, changes(job.cfg))


def test_one_of_a_list_is_changed_and_the_others_stay(tmp_path: Path) -> None:
    found = change("filter.refine.components.1.b=9", tmp_path)["filter"]
    assert found["refine"] == {"_target_": "Compose", "components": [{"a": 1}, {"b": 9}]}
    assert found["particles"] == 50
    assert TRAINED["filter"]["refine"]["components"][1] == {"b": 2}


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        ("filter.refine.components.2.b=9", r"filter\.refine\.components\.2: the checkpoint's"),
        ("filter.refine.components.1.c=9", r"filter\.refine\.components\.1\.c: the checkpoint's"),
        (
            "filter.particle=9",
            r"filter\.particle: .* has no such setting; did you mean 'particles'",
        ),
    ],
)
def test_what_is_not_there_is_named(typed: str, told: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=told):
        change(typed, tmp_path)


def test_a_setting_that_earlier_recipes_leave_out_is_taken(tmp_path: Path) -> None:
    assert change("filter.max_searches=1", tmp_path)["filter"]["max_searches"] == 1
    assert change("filter.magnified_width=0.4", tmp_path)["filter"]["magnified_width"] == 0.4
    with pytest.raises(UserError, match=r"filter\.look: the checkpoint's"):
        change("filter.look=1", tmp_path)


def test_another_class_of_the_method_keeps_what_it_is_made_of(tmp_path: Path) -> None:
    """It may have settings of its own: `model._target_=...PartsPF model.translation_mm=9`."""
    trained = {"model": {"_target_": "PosePF", "pixels": 32, "likelihood": {"_target_": "A"}}}
    typed = ["++model._target_=PartsPF", "++model.translation_mm=9"]
    found = changed(trained, changes(compose_job("evaluate", CONF, typed, tmp_path).cfg))["model"]
    own = {"_target_": "PartsPF", "translation_mm": 9, "pixels": 32}
    assert found == {**own, "likelihood": {"_target_": "A"}}
    with pytest.raises(UserError, match=r"model\.translation_mm: the checkpoint's"):
        changed(trained, {"model": {"translation_mm": 9}})


def test_a_calibration_holds_for_fewer_searches_and_for_what_is_left_out() -> None:
    own = {"filter": {"particles": 50, "max_searches": 3}}
    assert is_calibrated_filter({"filter": {"particles": 50, "magnified_width": None}}, own)
    assert is_calibrated_filter({"filter": {"particles": 50, "max_searches": 1}}, own)
    others: list[dict[str, Any]] = [{"max_searches": 4}, {"magnified_width": 0.4}, {"particles": 9}]
    for other in others:
        assert not is_calibrated_filter({"filter": {"particles": 50, **other}}, own)
    assert is_calibrated_filter({"model": 1}, {"model": 1})
