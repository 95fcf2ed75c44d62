"""Encoders of a whole image: any image's sides will do, and a cell stands for the same pixels
whatever they are.
"""

from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from posefilter.geometry.camera import intrinsics
from posefilter.nets.encoders import ResNetEncoder, UNetEncoder
from posefilter.nets.encoding import geometry
from posefilter.nets.proposals import ObjectCoordinateNet
from posefilter.nets.resnet import ResNet

K = intrinsics(150.0, 140.0, 49.5, 36.0)[None]
ENCODERS: dict[str, tuple[Callable[[], nn.Module], int]] = {
    "unet": (lambda: UNetEncoder((16, 24, 32, 32), 32), 4),
    "resnet18": (lambda: ResNetEncoder(ResNet("resnet18"), 32), 4),
    "coordinates": (lambda: ObjectCoordinateNet((16, 24, 32, 32), fragments=12, features=5), 8),
}


def scene(height: int, width: int, count: int = 1) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    return torch.rand(count, 3, height, width, generator=g), 0.5 + torch.rand(
        count, 1, height, width, generator=g
    )


def maps(encoder: nn.Module, rgb: Tensor, depth: Tensor) -> list[Tensor]:
    """Return each map that an encoder makes, as (B, h, w, F)."""
    said = encoder(rgb, depth, K.to(rgb).expand(len(rgb), 3, 3))
    if isinstance(encoder, ObjectCoordinateNet):
        return [said.logit[..., None], said.log_prob, said.position.flatten(3), said.features]
    return [said.levels[0].permute(0, 2, 3, 1), said.objectness[..., None]]


@pytest.mark.parametrize(("height", "width"), [(32, 33), (75, 100), (181, 320), (96, 120)])
@pytest.mark.parametrize("kind", ENCODERS)
def test_any_side_gives_as_many_cells_as_cover_it_and_teaches(
    kind: str, height: int, width: int
) -> None:
    make, stride = ENCODERS[kind]
    torch.manual_seed(0)
    encoder = make().train()
    found = maps(encoder, *scene(height, width, count=2))
    assert {tuple(x.shape[:3]) for x in found} == {(2, -(-height // stride), -(-width // stride))}
    sum(x.square().mean() for x in found).backward()
    gradients = [p.grad for p in encoder.parameters()]
    assert all(g is not None and torch.isfinite(g).all() for g in gradients)
    # every kernel has its say
    assert all(g.abs().max() > 0 for g in gradients if g is not None and g.dim() == 4)


@pytest.mark.parametrize("kind", ENCODERS)
def test_beyond_an_odd_side_lies_what_nothing_is_known_of(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An odd image is the even one with a row or column more, of the mean color and no depth: so no
    cell is shifted.
    """
    # too coarse to compare in
    monkeypatch.setattr("posefilter.nets.encoding.fast_bfloat16", lambda device: False)
    torch.manual_seed(0)
    encoder = ENCODERS[kind][0]().eval()
    rgb, depth = scene(75, 101)
    mean = encoder.trunk.mean if isinstance(encoder, ResNetEncoder) else torch.full((3, 1, 1), 0.5)
    whole = mean + F.pad(rgb - mean, (0, 1, 0, 1))
    with torch.no_grad():
        found = maps(encoder, rgb, depth)
        for x, y in zip(found, maps(encoder, whole, F.pad(depth, (0, 1, 0, 1))), strict=True):
            torch.testing.assert_close(x, y, atol=1e-5, rtol=1e-5)
        rolled = maps(encoder, whole.roll((1, 1), (2, 3)), F.pad(depth, (1, 0, 1, 0)))
    # padded before: another image
    assert max((x - y).abs().max() for x, y in zip(found, rolled, strict=True)) > 1e-3


def test_geometry_of_an_odd_image_is_that_of_the_even_part_and_a_half_known_rim() -> None:
    depth = scene(75, 101)[1]
    odd, even = geometry(depth, K), geometry(depth[..., :74, :100], K)
    assert odd.shape == (1, 7, 38, 51)
    torch.testing.assert_close(odd[:, 3:, :37, :50], even[:, 3:], atol=1e-6, rtol=0)
    reach = 2  # cells whose mean or difference a normal is made of
    torch.testing.assert_close(
        odd[:, :3, : 37 - reach, : 50 - reach], even[:, :3, :-reach, :-reach], atol=1e-6, rtol=0
    )
    near, share = odd[0, 3:5, -1, :50]
    torch.testing.assert_close(
        near, depth[0, 0, -1, :100].unflatten(0, (50, 2)).mean(1) - 1, atol=1e-6, rtol=0
    )
    assert (share == 0.5).all()


@pytest.mark.parametrize(
    ("kind", "want"),
    [
        (
            "unet",
            "relevance color enter down4 down8 down16 down32 to16 up16 to8 up8 to4 skip4 up4",
        ),
        ("coordinates", "color enter down4 down8 down16 down32 to16 up16 to8 up8 out"),
    ],
)
def test_parameters_keep_their_names_and_order(kind: str, want: str) -> None:
    names = [name.split(".")[0] for name, _ in ENCODERS[kind][0]().named_parameters()]
    # by which checkpoints load, and their optimizers go on
    assert list(dict.fromkeys(names)) == want.split()
