"""A checkpoint of an earlier version is refused in one line that names what has changed."""

import pytest

from posefilter.cli.recipe import check_recipe
from posefilter.errors import UserError


@pytest.mark.parametrize(
    ("recipe", "told"),
    [
        ({"choices": {"initialise": "uniform"}, "settings": {}}, "initialise is now filter/init"),
        ({"choices": {}, "settings": {"rung": "c2_glimpse"}}, "rung is now ablation"),
        ({"choices": {"deviation": "pose_pf/ours"}, "settings": {}}, "deviation is now preset"),
        ({"choices": {"place_gradient": "flows"}, "settings": {}}, "is now model.detach_position"),
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
