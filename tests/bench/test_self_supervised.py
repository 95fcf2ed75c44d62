"""Weights that are learned without labels: two views show the same point where they say so, the
loss tells matched features from others, and what is written is what a trunk loads.
"""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from posefilter.geometry.lookup import sample
from posefilter.nets.resnet import ResNet


@pytest.fixture
def bench(load_script: Callable[[str], ModuleType]) -> ModuleType:
    """Return the script."""
    return load_script("bench/self_supervised.py")


def textures(count: int, height: int = 120, width: int = 160) -> Tensor:
    """Return smooth random images (count, 3, height, width)."""
    coarse = torch.rand(count, 3, height // 8, width // 8, generator=Generator().manual_seed(7))
    return F.interpolate(coarse, size=(height, width), mode="bicubic").clamp(0, 1)


def test_corresponding_points_of_two_views_are_of_one_point_of_the_frame(
    bench: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame whose color is its position tells where each pixel of a view comes from."""
    monkeypatch.setattr(bench, "recolor", lambda rgb, generator: rgb)
    v, u = torch.meshgrid(torch.arange(120.0), torch.arange(160.0), indexing="ij")
    frames = torch.stack([u, v, torch.zeros_like(u)]).expand(6, -1, -1, -1)
    g = Generator().manual_seed(0)
    first, second = (bench.draw_views(frames, g) for _ in range(2))
    here, there, seen = bench.draw_points(first, second, (120, 160), g)
    at = bench.map_points(first.frame_from_view, here)
    # bilinear sampling keeps a linear image, but for views' pixels beyond the frame
    inner = seen & ((at > 2) & (at < torch.tensor([157.0, 117.0]))).all(-1)
    assert inner.float().mean() > 0.3
    for view, points in ((first, here), (second, there)):
        found = sample(view.rgb, points)[..., :2]
        torch.testing.assert_close(found[inner], at[inner], atol=2e-3, rtol=0)
    size = torch.tensor([bench.SIZE[1] - 1, bench.SIZE[0] - 1])
    assert ((there[seen] >= 0) & (there[seen] <= size)).all()
    assert ((at[seen] >= 0) & (at[seen] <= torch.tensor([159, 119]))).all()


def test_a_map_and_its_inverse_cancel(bench: ModuleType) -> None:
    g = Generator().manual_seed(0)
    affine = bench.draw_affine(50, 120, 160, g)
    points = 100 * torch.rand(50, 9, 2, generator=g)
    back = bench.map_points(bench.invert(affine), bench.map_points(affine, points))
    torch.testing.assert_close(back, points, atol=1e-3, rtol=0)
    zoom = affine[:, :, :2].det().rsqrt()  # view's pixels a pixel of the frame
    assert zoom.min() >= bench.ZOOM[0] - 1e-4
    assert zoom.max() <= bench.ZOOM[1] + 1e-4
    middle = torch.tensor([[[63.5, 47.5]]]).expand(50, -1, -1)
    middle = bench.map_points(affine, middle)[:, 0]
    assert ((middle > torch.tensor([39, 29])) & (middle < torch.tensor([120, 90]))).all()


def test_matched_features_have_a_smaller_loss_than_shuffled_ones(bench: ModuleType) -> None:
    g = Generator().manual_seed(0)
    first = torch.randn(4, 32, 16, generator=g)
    seen = torch.rand(4, 32, generator=g) > 0.2
    matched, found = bench.compare(first, 3 * first, seen)  # length is no part of it
    shuffled, few = bench.compare(first, first[:, torch.randperm(32, generator=g)], seen)
    assert found == 1
    assert few < 0.2
    assert matched < 0.1 * shuffled
    # of features that are all alike nothing is known: as many nats as there are points
    alike, _ = bench.compare(torch.ones(1, 32, 16), torch.ones(1, 32, 16), torch.ones(1, 32) > 0)
    torch.testing.assert_close(alike, torch.tensor(32.0).log())
    # points that are not in both views count for nothing, on either side
    other = torch.where(seen[..., None], first, torch.randn(4, 32, 16, generator=g))
    torch.testing.assert_close(bench.compare(other, 3 * first, seen)[0], matched)
    torch.testing.assert_close(bench.compare(first, 3 * other, seen)[0], matched)


def test_other_frames_are_no_negatives(bench: ModuleType) -> None:
    g = Generator().manual_seed(0)
    features, seen = torch.randn(1, 32, 16, generator=g), torch.ones(2, 32, dtype=torch.bool)
    one, _ = bench.compare(features, features, seen[:1])
    twice = features.expand(2, -1, -1)  # the same points in another frame
    torch.testing.assert_close(bench.compare(twice, twice, seen)[0], one)


def test_color_changes_keep_the_range_and_repeat(bench: ModuleType) -> None:
    rgb = textures(64, 24, 32)
    changed, again = (bench.recolor(rgb, Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(changed, again)
    assert changed.min() >= 0
    assert changed.max() <= 1
    assert (changed - rgb).abs().mean() > 0.05


@pytest.mark.slow
def test_a_trunk_learns_and_its_file_gives_the_same_features(
    bench: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name, value in {"SIZE": (64, 80), "POINTS": 48, "WARMUP": 5, "EVERY": 1000}.items():
        monkeypatch.setattr(bench, name, value)
    frames = [SimpleNamespace(rgb=rgb) for rgb in textures(8)]

    def learn(steps: int) -> tuple[ResNet, list[float]]:
        torch.manual_seed(0)
        trunk, found = ResNet(stages=2), []
        validate = bench.validate
        with monkeypatch.context() as patch:
            patch.setattr(bench, "validate", lambda *a: found.append(validate(*a)) or found[-1])
            bench.learn(trunk, frames, frames, steps, Generator().manual_seed(1))
        return trunk, found

    trunk, found = learn(30)
    assert found[-1] > found[0] + 10
    few, again = (learn(2)[0].state_dict() for _ in range(2))
    assert all(torch.equal(value, again[key]) for key, value in few.items())

    bench.write_trunk(trunk, tmp_path / "trunk.pt")
    state = torch.load(tmp_path / "trunk.pt", weights_only=True)
    assert not any(key.startswith(("geometry.", "lateral", "trunk.")) for key in state)
    loaded = ResNet(stages=2, weights=str(tmp_path / "trunk.pt"), frozen=True).train()
    rgb, geometry = textures(2), torch.randn(2, 7, 60, 80)  # which counts for nothing yet
    with torch.no_grad():
        for one, other in zip(trunk.eval()(rgb, 0 * geometry), loaded(rgb, geometry), strict=True):
            assert torch.equal(one, other)
    for key, value in trunk.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[key]), key
