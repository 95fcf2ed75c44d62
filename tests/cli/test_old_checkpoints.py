"""A checkpoint of an earlier version is refused in one line that names what has changed."""

import importlib

import pytest

from posefilter.cli.instantiate import accepted, locate
from posefilter.cli.recipe import check_recipe
from posefilter.cli.renamed import ARGUMENTS, CLASSES
from posefilter.errors import UserError

CHAIN = {
    "_target_": "posefilter.filters.refine.Chain",
    "components": [
        {"_target_": "posefilter.filters.refine.Rescore", "top_k": 20},
        {"_target_": "posefilter.filters.refine.MeanShift", "rounds": 8},
    ],
}

TRANSPORT = "posefilter.filters.transport.OptimalTransport"


@pytest.mark.parametrize(
    ("recipe", "told"),
    [
        ({"choices": {"initialise": "uniform"}, "settings": {}}, "initialise is now filter/init"),
        ({"choices": {}, "settings": {"rung": "c2_glimpse"}}, "rung is now ablation"),
        ({"choices": {"deviation": "pose_pf/ours"}, "settings": {}}, "deviation is now preset"),
        ({"choices": {"place_gradient": "flows"}, "settings": {}}, "is now model.detach_position"),
        (
            {"choices": {}, "settings": {"filter": {"resample": {"_target_": TRANSPORT}}}},
            f"({TRANSPORT} is now posefilter.filters.transport.SampledTransport)",
        ),
        (
            {"choices": {}, "settings": {"filter": {"refine": CHAIN}}},
            "(filter.refine.components[1].rounds is now iterations)",
        ),
    ],
)
def test_an_old_recipe_names_what_to_do(recipe: dict, told: str) -> None:
    with pytest.raises(UserError) as refusal:
        check_recipe(recipe, "checkpoint=old.ckpt")
    said = str(refusal.value)
    assert said.startswith("checkpoint=old.ckpt: was written by an earlier version")
    assert told in said
    assert said.endswith("train it again")
    assert "\n" not in said


def test_todays_recipe_is_not_taken_for_an_old_one() -> None:
    recipe = {"choices": {"filter/initialize": "uniform"}, "settings": {"filter": {"steps": 3}}}
    assert check_recipe(recipe, "checkpoint=new.ckpt") == recipe


@pytest.mark.parametrize("place", sorted(ARGUMENTS))
def test_a_class_takes_its_arguments_by_todays_names_alone(place: str) -> None:
    module, _, name = place.rpartition(".")
    known, _ = accepted(getattr(importlib.import_module(f"posefilter.{module}"), name))
    assert set(ARGUMENTS[place].values()) <= set(known)
    assert not set(ARGUMENTS[place]) & set(known)


@pytest.mark.parametrize("old", sorted(CLASSES))
def test_an_old_class_is_answered_by_the_new_one_which_is_there(old: str) -> None:
    with pytest.raises(UserError) as refusal:
        locate(f"posefilter.{old}", "filter.resample")
    assert str(refusal.value).endswith(
        f"_target_=posefilter.{old}: is now posefilter.{CLASSES[old]}"
    )
    assert locate(f"posefilter.{CLASSES[old]}", "filter.resample").__name__ in CLASSES[old]
