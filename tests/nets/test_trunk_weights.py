"""The file that a trunk starts from: torchvision's is read, any other is refused in one line."""

from pathlib import Path
from typing import Any

import lightning
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from posefilter.errors import UserError
from posefilter.nets.resnet import ResNet, load_trunk

GEOMETRY = torch.ones(2, 7, 16, 16)


@pytest.fixture(scope="module")
def trunk() -> ResNet:
    return ResNet("resnet18")


def changed(trunk: nn.Module, **changes: Any) -> dict[str, Any]:
    """Return what such a file holds; None leaves a tensor out."""
    state = {k: v for k, v in trunk.state_dict().items() if not k.startswith("geometry.")}
    return {k: v for k, v in {**state, **changes}.items() if v is not None}


def test_torchvisions_file_is_read(trunk: ResNet, tmp_path: Path) -> None:
    state = {k: v + 1 for k, v in changed(trunk).items()}
    head = {"fc.weight": torch.zeros(1000, 512)}  # of the classifier, which is not needed
    torch.save({**state, **head}, tmp_path / "x.pth")
    other = ResNet("resnet18", weights=str(tmp_path / "x.pth"))
    own = other.state_dict()
    assert all(torch.equal(own[key], value) for key, value in state.items())


def test_a_file_without_counts_of_batches_is_read(trunk: ResNet, tmp_path: Path) -> None:
    """As torchvision's were before 2018: nothing in evaluation reads them."""
    state = {k: v for k, v in changed(trunk).items() if not k.endswith("num_batches_tracked")}
    torch.save(state, tmp_path / "x.pth")
    own = ResNet("resnet18", weights=str(tmp_path / "x.pth")).state_dict()
    assert all(torch.equal(own[key], value) for key, value in state.items())


FILES: dict[str, tuple[Any, str]] = {
    "no file": (None, "no such file"),
    "no weights": (b"hostile", r"not readable as weights \(\w+Error\)"),
    "cut": (b"PK\x03\x04" + bytes(100), r"not readable as weights \(\w+Error\)"),
    "a list": ([1], "should hold tensors by name"),
    "texts": ({"conv1.weight": "x"}, "should hold tensors by name"),
    "a tensor is missing": ({"conv1.weight": None}, r"lacks conv1\.weight"),
    "a tensor too many": ({"x": torch.zeros(1)}, "has the unexpected x"),
    "another shape": ({"conv1.weight": torch.zeros(1)}, r"conv1\.weight has shape \(1,\), not"),
}


@pytest.mark.parametrize("what", FILES)
def test_another_file_is_one_line(what: str, trunk: ResNet, tmp_path: Path) -> None:
    content, told = FILES[what]
    file = tmp_path / "x.pth"
    if isinstance(content, bytes):
        file.write_bytes(content)
    elif content is not None:
        whole = told == "should hold tensors by name"
        torch.save(content if whole else changed(trunk, **content), file)
    with pytest.raises(UserError, match=rf"^model\.encoder\.trunk\.weights=.*{told}") as caught:
        load_trunk(trunk, str(file))
    assert "\n" not in str(caught.value)


def test_a_trunk_of_fewer_stages_reads_a_whole_file_and_not_the_reverse(
    trunk: ResNet, tmp_path: Path
) -> None:
    torch.save(changed(trunk), tmp_path / "whole.pth")
    short = ResNet("resnet18", weights=str(tmp_path / "whole.pth"), stages=3).eval()
    assert not any(name.startswith("layer4.") for name in short.state_dict())
    rgb, geometry = torch.rand(1, 3, 64, 96), torch.zeros(1, 7, 32, 48)
    with torch.no_grad():
        for one, other in zip(short(rgb, geometry), trunk.eval()(rgb, geometry), strict=False):
            assert torch.equal(one, other)
    torch.save(changed(short), tmp_path / "short.pth")
    with pytest.raises(UserError, match=r"lacks layer4\.0"):
        load_trunk(trunk, str(tmp_path / "short.pth"))
    for stages in (0, 5):
        with pytest.raises(UserError, match=rf"trunk\.stages={stages}: must be 1 to 4"):
            ResNet(stages=stages)


class Frozen(lightning.LightningModule):
    """A trunk as part of a method that is trained, from images that differ from its statistics."""

    def __init__(self) -> None:
        super().__init__()
        self.trunk = ResNet(stages=1, frozen=True)

    def training_step(self, rgb: torch.Tensor, number: int) -> torch.Tensor:
        return self.trunk(rgb, GEOMETRY)[0].mean()

    def validation_step(self, rgb: torch.Tensor, number: int) -> None:
        assert not self.trunk.training

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD([p for p in self.parameters() if p.requires_grad], lr=0.1)


def test_a_frozen_trunk_keeps_its_statistics_in_a_training() -> None:
    """Lightning does not call `train` before the first step, and calls it after a validation."""
    method = Frozen()
    before = {key: value.clone() for key, value in method.trunk.state_dict().items()}
    images = DataLoader([0.1 * torch.rand(2, 3, 32, 32) for _ in range(2)], batch_size=None)
    trainer = lightning.Trainer(
        max_epochs=2, logger=False, enable_checkpointing=False, accelerator="cpu",
        enable_progress_bar=False, enable_model_summary=False, num_sanity_val_steps=0,
    )  # fmt: skip
    trainer.fit(method, images, images)
    assert trainer.global_step == 4
    for key, value in method.trunk.state_dict().items():
        assert torch.equal(value, before[key]) != key.startswith("geometry."), key
