"""Contexts: shapes are the least of it; what is looked up must be what lies there."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from posefilter.errors import UserError
from posefilter.geometry.camera import intrinsics
from posefilter.nets.encoders import (
    FoveatedEncoder,
    NoEncoder,
    PyramidEncoder,
    ResNetEncoder,
    UNetEncoder,
)
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


def test_foveated_patches_read_only_the_pixels_that_they_say() -> None:
    rgb, depth = scene()
    torch.manual_seed(0)
    fovea = FoveatedEncoder((0.01, 0.04)).double()
    rgb, depth, camera = rgb.double(), depth.double(), K.double()
    pixels = torch.tensor([[[80.3, 60.9], [5.0, 118.0], [-3.0, 40.0]]]).double()
    with torch.no_grad():
        maps = fovea(rgb, depth, camera)
        before = fovea.sample_features(maps, pixels)
        index, z = fovea.place_patches(maps, pixels)
        u, v = index.flatten(0, 3).unbind(-1)
        inside = (u >= 0) & (u < 160) & (v >= 0) & (v < 120)
        read = torch.zeros(120, 160, dtype=torch.bool)
        read[v[inside], u[inside]] = True
        read[40, 0] = True  # by its depth the patches of the particle off the frame are placed
        assert 2 * 49 < read.sum() < 3 * 2 * 49  # two particles read in the frame, one in part
        others = fovea(torch.where(read, rgb, 0.5), torch.where(read, depth, 0.7), camera)
        assert torch.equal(fovea.sample_features(others, pixels), before)
        for n in range(3):
            seen = index[0, n].flatten(0, 1)
            u, v = seen[((seen >= 0) & (seen < torch.tensor([160, 120]))).all(-1)][0]
            changed = rgb.clone()
            changed[:, :, v, u] += 0.1
            moved = fovea.sample_features(fovea(changed, depth, camera), pixels) != before
            assert moved[0, n].any()
    torch.testing.assert_close(z[0, :2], depth[0, 0, [61, 118], [80, 5]], atol=0, rtol=0)
    assert z[0, 2] == depth[0, 0, 40, 0]  # off the frame, that of the nearest pixel


def test_foveated_patches_cover_the_same_part_of_a_surface_at_any_distance_and_size() -> None:
    fovea = FoveatedEncoder((0.01, 0.04), size=5)
    pixels = torch.tensor([[[80.0, 60.0]]])

    def spacings(depth: float, focal: float, size: tuple[int, int] = (120, 160)) -> list[int]:
        z = torch.full((1, 1, *size), depth)
        camera = intrinsics(focal, focal, 79.5, 59.5)[None]
        index, _ = fovea.place_patches(fovea(torch.rand(1, 3, *size), z, camera), pixels)
        steps = (index[0, 0, :, 1] - index[0, 0, :, 0])[:, 0]
        return steps.tolist()

    assert spacings(0.5, 150.0) == [3, 12]
    assert spacings(1.0, 150.0) == [2, 6]  # 1.5 px, rounded for each pixel
    assert spacings(1.0, 300.0, (240, 320)) == [3, 12]
    assert spacings(5.0, 150.0) == [1, 1]  # never less than a pixel


def test_foveated_patches_need_no_depth() -> None:
    rgb, depth = scene()
    fovea = FoveatedEncoder()
    depth[:, :, 30:90, 40:120] = 0
    pixels = torch.tensor([[[80.0, 60.0], [42.0, 60.0]]])
    _, z = fovea.place_patches(fovea(rgb, depth, K), pixels)
    known = depth[depth > 0]
    assert z[0, 0] == known.median()
    near = depth[0, 0, 57:64, 39]  # what is known within 3 px
    torch.testing.assert_close(z[0, 1], near.mean(), atol=1e-4, rtol=0)
    nothing = fovea.sample_features(fovea(rgb, torch.zeros_like(depth), K), pixels)
    assert nothing.shape == (1, 2, fovea.width)
    assert nothing.isfinite().all()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"spacings_m": ()}, r"model.encoder.spacings_m=\[\]: each must be positive, and one is"),
        ({"spacings_m": (0.01, 0.0)}, r"model.encoder.spacings_m=\[0.01, 0.0\]"),
        ({"size": 4}, "model.encoder.size=4: must be 5 or more"),
    ],
)
def test_foveated_patches_that_are_none_are_refused(more: dict, told: str) -> None:
    with pytest.raises(UserError, match=told):
        FoveatedEncoder(**more)


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
