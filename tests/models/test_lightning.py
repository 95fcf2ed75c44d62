"""Every method is a LightningModule wherever it is trained or built."""

import pytest
from lightning import LightningModule

import posefilter
from posefilter import models
from posefilter.cli.choices import list_choices
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


def test_a_name_that_is_none_is_told() -> None:
    with pytest.raises(AttributeError, match="TurtlePF"):
        _ = models.TurtlePF
