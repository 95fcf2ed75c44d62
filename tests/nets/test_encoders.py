"""Contexts: shapes are the least of it; what is looked up must be what lies there."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from posefilter.errors import UserError
from posefilter.geometry.camera import intrinsics
from posefilter.nets.encoders import NoEncoder, PyramidEncoder, ResNetEncoder, UNetEncoder
from posefilter.nets.resnet import ResNet

K = intrinsics(150.0, 150.0, 79.5, 59.5)[None]


def scene(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.rand(1, 3, 120, 160, generator=g), 0.5 + torch.rand(1, 1, 120, 160, generator=g)


def test_pyramid_sees_block_means_under_the_particle() -> None:
    rgb, depth = scene()
    pyramid = PyramidEncoder(levels=3)
    # the center of cell (4, 5) of the level of stride 8
    pixels = torch.tensor([[[8 * 5 + 3.5, 8 * 4 + 3.5]]])
    features = pyramid.sample_features(pyramid(rgb, depth, K), pixels)
    assert features.shape == (1, 1, pyramid.width)
    # level 3, sample 4 of 9: the particle's own cell
    middle = features[0, 0, 2 * 45 + 4 * 5 : 2 * 45 + 5 * 5]
    block = rgb[0, :, 32:40, 40:48].mean((1, 2)) * 2 - 1
    torch.testing.assert_close(middle[:3], block, atol=1e-5, rtol=0)
    torch.testing.assert_close(middle[3], depth[0, 0, 32:40, 40:48].mean(), atol=1e-5, rtol=0)
    assert middle[4] == 1


def test_no_context_is_empty() -> None:
    rgb, depth = scene()
    none = NoEncoder()
    assert none.sample_features(none(rgb, depth, K), torch.zeros(1, 7, 2)).shape == (1, 7, 0)


@pytest.mark.parametrize(
    "make", [UNetEncoder, lambda: ResNetEncoder(ResNet("resnet18"))], ids=["unet", "resnet18"]
)
@pytest.mark.slow
def test_encoder_learns_where_the_red_square_is(make: Callable[[], nn.Module]) -> None:
    torch.manual_seed(0)
    encoder = make().train()
    optimizer = torch.optim.AdamW(encoder.parameters(), 2e-3)
    g = torch.Generator().manual_seed(1)

    def draw() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        rgb, depth = torch.rand(4, 3, 64, 96, generator=g) * 0.3, torch.ones(4, 1, 64, 96)
        on = torch.zeros(4, 16, 24)
        for b in range(4):
            i, j = (
                int(torch.randint(0, 12, (), generator=g)),
                int(torch.randint(0, 20, (), generator=g)),
            )
            rgb[b, 0, 4 * i : 4 * i + 16, 4 * j : 4 * j + 16] = 1
            on[b, i : i + 4, j : j + 4] = 1
        return rgb, depth, on

    for _ in range(25):
        rgb, depth, on = draw()
        said = encoder(rgb, depth, K.expand(4, 3, 3))
        loss = nn.functional.binary_cross_entropy_with_logits(
            said.objectness, on, pos_weight=torch.tensor(10.0)
        )
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    rgb, depth, on = draw()
    objectness = encoder(rgb, depth, K.expand(4, 3, 3)).objectness
    assert objectness[on > 0].mean() > objectness[on == 0].mean() + 2


def test_resnet_has_the_parameter_names_and_shapes_of_torchvision() -> None:
    state = ResNet("resnet34").state_dict()
    assert state["conv1.weight"].shape == (64, 3, 7, 7)
    assert state["layer2.0.downsample.0.weight"].shape == (128, 64, 1, 1)
    assert state["layer3.5.conv2.weight"].shape == (256, 256, 3, 3)
    assert "layer1.0.downsample.0.weight" not in state
    counted = sum(
        v.numel() for k, v in ResNet("resnet18").named_parameters() if not k.startswith("geometry.")
    )
    # torchvision's published count, less its classifier
    assert counted == 11_689_512 - (512 * 1000 + 1000)


def test_resnet_loads_a_weight_file_and_starts_as_it_was_trained(tmp_path: Path) -> None:
    torch.manual_seed(0)
    teacher = ResNet("resnet18")
    state = {
        k: torch.randn_like(v) * 0.02 if v.is_floating_point() else v
        for k, v in teacher.state_dict().items()
    }
    state = {
        k: v.abs() + 0.5 if k.endswith("running_var") else v
        for k, v in state.items()
        if "geometry" not in k
    }
    state |= {"fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}
    torch.save(state, tmp_path / "resnet18.pth")
    loaded = ResNet("resnet18", weights=str(tmp_path / "resnet18.pth"), frozen=True).train()
    own = loaded.state_dict()
    assert all(torch.equal(own[k], v) for k, v in state.items() if not k.startswith("fc."))
    rgb, _ = scene()
    plain = loaded(rgb, torch.zeros(1, 7, 60, 80))[0]
    # the geometry stem starts silent
    assert torch.equal(plain, loaded(rgb, torch.randn(1, 7, 60, 80))[0])
    assert [n for n, p in loaded.named_parameters() if p.requires_grad] == [
        "geometry.weight",
        "geometry.bias",
    ]
    # frozen statistics
    assert torch.equal(loaded.state_dict()["bn1.running_mean"], state["bn1.running_mean"])


def test_resnet_weight_mistakes_end_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        ResNet("resnet18", weights=str(tmp_path / "none.pth"))
    torch.save(
        {k: v for k, v in ResNet("resnet34").state_dict().items() if "geometry" not in k},
        tmp_path / "34.pth",
    )
    with pytest.raises(UserError, match=r"layer1\.2"):
        ResNet("resnet18", weights=str(tmp_path / "34.pth"))
    with pytest.raises(UserError, match="resnet18 or resnet34"):
        ResNet("resnet50")


@pytest.mark.parametrize("size", [(240, 320), (241, 321)])
def test_wide_images_are_downsampled_and_sampled_at_the_same_positions(
    size: tuple[int, int],
) -> None:
    g = torch.Generator().manual_seed(3)
    rgb, depth = torch.rand(1, 3, *size, generator=g), 0.5 + torch.rand(1, 1, *size, generator=g)
    depth[:, :, 40:50, 60:90] = 0  # a hole wider than a cell, and one narrower
    depth[:, :, 100, 201] = 0
    wide = intrinsics(300.0, 300.0, 159.5, 119.5)[None]
    torch.manual_seed(0)
    encoder = UNetEncoder(max_width_px=192).eval()
    small_rgb = torch.nn.functional.avg_pool2d(rgb, 2)
    known = torch.nn.functional.avg_pool2d((depth > 0).float(), 2)
    small_depth = torch.nn.functional.avg_pool2d(depth, 2) / known.clamp_min(1e-6)
    pixels = torch.tensor([[[0.0, 0.0], [100.5, 60.5], [313.0, 7.0]]])
    with torch.no_grad():
        seen = encoder(rgb, depth, wide)
        # of 160, which is not too wide
        small = encoder(small_rgb, small_depth, intrinsics(150.0, 150.0, 79.5, 59.5)[None])
        assert (seen.strides, small.strides) == ((8,), (4,))
        found = (
            encoder.sample_features(seen, pixels),
            encoder.sample_features(small, (pixels - 0.5) / 2),
        )
    torch.testing.assert_close(*found, atol=1e-5, rtol=1e-5)


def test_images_that_are_not_too_wide_keep_their_size() -> None:
    torch.manual_seed(0)
    bounded, free = UNetEncoder(max_width_px=160).eval(), UNetEncoder().eval()
    free.load_state_dict(bounded.state_dict())
    with torch.no_grad():
        assert torch.equal(bounded(*scene(), K).levels[0], free(*scene(), K).levels[0])
    with pytest.raises(UserError, match=r"model.encoder.max_width_px=16"):
        UNetEncoder(max_width_px=16)
