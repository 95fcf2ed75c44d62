"""Weights that are exported can be read again, or are not written."""

from pathlib import Path
from typing import Any

import pytest
import torch

from posefilter.cli.checkpoints import read_checkpoint
from posefilter.cli.export import strip, write_weights
from posefilter.errors import UserError
from posefilter.models.quantization import unpack_object

FAR = torch.tensor([0.0, 0.0, 0.6])  # [m] of the object from its origin


@pytest.fixture
def checkpoint() -> dict[str, Any]:
    """Weights of an object far from its origin, as of a scan in the frame of its room."""
    out = read_checkpoint("003_cracker_box")
    model = unpack_object(out["object_model"])
    texture = model.texture.float()
    texture[:, :3] += FAR
    moved = {key: getattr(model, key) + FAR for key in ("points", "center", "hull")}
    return {**out, "object_model": {**model._asdict(), **moved, "texture": texture}}


def test_an_object_far_from_its_origin_is_read_again(
    checkpoint: dict[str, Any], tmp_path: Path
) -> None:
    out = tmp_path / "far.ckpt"
    write_weights(strip(checkpoint, 500, quantize=True), out, 40)
    again = unpack_object(read_checkpoint(out)["object_model"])
    wanted = checkpoint["object_model"]
    torch.testing.assert_close(again.points, wanted["points"][::4], atol=1e-4, rtol=0)
    torch.testing.assert_close(again.texture[:, :3], wanted["texture"][:, :3], atol=2e-4, rtol=0)


def test_what_nobody_could_read_is_not_written(checkpoint: dict[str, Any], tmp_path: Path) -> None:
    out, stripped = tmp_path / "far.ckpt", strip(checkpoint, 500, quantize=True)
    for wrong in (torch.zeros(2), torch.full((3,), float("nan")), 1):
        stripped["object_model"]["points_from"] = wrong
        with pytest.raises(UserError, match="its object's points_from should"):
            write_weights(stripped, out, 40)
    assert not any(tmp_path.iterdir())
