"""Every method is a LightningModule wherever it is trained or built."""

import copy
import pickle
from pathlib import Path

import pytest
import torch
from lightning import LightningModule

import posefilter
from posefilter import models
from posefilter.cli.choices import list_choices
from posefilter.models.base import PoseEstimator
from posefilter.paths import find_conf


@pytest.mark.parametrize("name", models.__all__)
def test_each_method_is_a_lightning_module(name: str) -> None:
    kind = getattr(models, name)
    assert issubclass(kind, LightningModule)
    assert kind.__name__ == name
    assert getattr(models, name) is kind  # made once


@pytest.mark.parametrize("model", list_choices(find_conf() / "model"))
def test_so_is_what_is_built(model: str) -> None:
    method = posefilter.build(posefilter.compose([f"model={model}"]))
    assert isinstance(method, LightningModule)
    assert isinstance(method, tuple(getattr(models, name) for name in models.__all__))


class OwnPatch(models.CnnPatch):
    """A class of one's own."""


@pytest.mark.parametrize("kind", [models.CnnPatch, OwnPatch])
def test_it_is_pickled_by_its_class(kind: type[PoseEstimator], tmp_path: Path) -> None:
    method = posefilter.build(posefilter.compose(["model=cnn_patch"]))
    method.__class__ = kind
    torch.save(method, tmp_path / "method.pt")
    for again in (
        pickle.loads(pickle.dumps(method)),
        torch.load(tmp_path / "method.pt", weights_only=False),
        copy.deepcopy(method),
    ):
        assert type(again) is kind
        weights = again.state_dict()
        assert all(torch.equal(value, weights[key]) for key, value in method.state_dict().items())


def test_a_name_that_is_none_is_told() -> None:
    with pytest.raises(AttributeError, match="TurtlePF"):
        _ = models.TurtlePF
