"""What a caller of the library gets wrong is told as on the command line."""

from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

import posefilter


def test_choices_that_do_not_fit_are_told_with_what_fits() -> None:
    with pytest.raises(posefilter.UserError) as told:
        posefilter.compose(["model=pose_pf", "loss=add"])
    assert "loss=add does not fit model=pose_pf" in str(told.value)
    assert str(told.value).endswith("; choose loss=contrastive")


def test_a_configuration_that_was_changed_is_told_by_its_classes() -> None:
    config = posefilter.compose(["model=pose_pf"])
    config.loss = posefilter.compose(["model=patch_pf", "loss=add"]).loss
    with pytest.raises(posefilter.UserError, match=r"Add\S* does not fit model=PosePF, as"):
        posefilter.build(config)


@pytest.mark.parametrize("given", ["model=patch_pf", {"model": "patch_pf"}, [1]])
def test_what_is_no_list_of_settings_is_told(given: Any) -> None:
    with pytest.raises(posefilter.UserError, match=r"must be a list, such as \['model=patch_pf'\]"):
        posefilter.compose(given)


def test_settings_may_come_from_a_generator() -> None:
    config = posefilter.compose(one for one in ["model=patch_pf"])  # type: ignore[arg-type]
    assert config.model["_target_"].endswith("PatchPF")
    with pytest.raises(posefilter.UserError, match="changes nothing of a trained filter"):
        posefilter.load("003_cracker_box", overrides=(one for one in ["seed=1"]))  # type: ignore[arg-type]


def test_a_plug_in_is_trusted_by_a_call_and_not_by_a_setting() -> None:
    told = r"^plugins=ownpf: in Python call posefilter\.trust\('ownpf'\) instead$"
    with pytest.raises(posefilter.UserError, match=told):
        posefilter.compose(["plugins=[ownpf]", "loss=own"])


@pytest.mark.parametrize("given", [None, {"data": {}}, [], OmegaConf.create({"seed": 0})])
def test_what_is_no_configuration_is_told(given: Any) -> None:
    for build in (posefilter.build, posefilter.build_data):
        with pytest.raises(posefilter.UserError, match=r"^config: .*posefilter\.compose returns"):
            build(given)


def test_a_number_outside_of_its_range_is_told_as_by_a_command() -> None:
    with pytest.raises(posefilter.UserError, match=r"filter\.particles=-5: must be"):
        posefilter.compose(["filter.particles=-5"])


def test_a_built_method_has_the_weights_of_the_configurations_seed() -> None:
    config = posefilter.compose(["model=cnn_patch", "seed=3"])
    before = torch.random.get_rng_state()
    one, same = (posefilter.build(config).state_dict() for _ in range(2))
    assert torch.equal(torch.random.get_rng_state(), before)  # the caller's draws go on
    config.seed = 4
    other = posefilter.build(config).state_dict()
    assert all(torch.equal(value, same[name]) for name, value in one.items())
    assert not all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize("typed", ["experiment=null", "model/net=null", "model.net=null"])
def test_a_choice_of_null_is_told_what_there_is(typed: str) -> None:
    with pytest.raises(
        posefilter.UserError, match=rf"{typed}: takes the name of a choice, .*; there are \w+"
    ):
        posefilter.compose([typed])


def test_a_likelihood_without_context_asks_the_network_for_no_features() -> None:
    method = posefilter.build(posefilter.compose(["model.likelihood.context=null"]))
    assert method.likelihood.context is None
    assert method.proposals.parts[-1] == 0
