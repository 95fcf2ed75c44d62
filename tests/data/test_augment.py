"""Augmentation stays true: after any of it the known surface still fits the pose, the intrinsics
and the mask.
"""

import dataclasses

import numpy as np
import pytest
from tests.models.toy import SIDE, scenes

from posefilter.data.augmentation import (
    Augment,
    ColorJitter,
    Compose,
    DepthNoise,
    PasteOccluder,
    RandomCrop,
    RandomErasing,
    RollAndZoom,
)
from posefilter.data.cache import MemoryCache
from posefilter.data.dataset import FrameDataset
from posefilter.data.frames import FrameRecord, Sample
from posefilter.errors import UserError


def sample(i: int = 0) -> Sample:
    """Return a toy scene as a sample: a square whose color tells the place on it."""
    b = scenes(4)
    rgb = (b.rgb[i].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    return Sample(
        rgb,
        b.depth[i, 0].numpy(),
        b.mask[i, 0].numpy(),
        b.intrinsics[i].numpy(),
        b.camera_from_object[i].numpy(),
        0,
        i,
        1.0,
    )


def misfit(x: Sample) -> tuple[float, float]:
    """Return how far the mask's points lie off the square's plane [m], and how far their color is
    from their place.
    """
    rows, cols = np.nonzero(x.mask & (x.depth > 0))
    K = x.intrinsics
    z = x.depth[rows, cols]
    points = np.stack([(cols - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], -1)
    local = (points - x.camera_from_object[:3, 3]) @ x.camera_from_object[:3, :3]
    said = x.rgb[rows, cols, :2] / 255.0
    return float(np.abs(local[:, 2]).max()), float(
        np.median(np.abs(said - (local[:, :2] / SIDE + 0.5)))
    )


def apply(step: Augment, seed: int, x: Sample | None = None) -> Sample:
    return step(
        x or sample(), lambda rng: sample(int(rng.integers(4))), np.random.default_rng(seed)
    )


@pytest.mark.parametrize(
    "step",
    [
        RollAndZoom(uniform_roll_probability=1.0),
        RandomCrop((32, 32)),
        PasteOccluder(1.0),
        RandomErasing(),
        RollAndZoom(zoom=(0.7, 2.2), pivot="object"),
        RollAndZoom(pivot="object", object_size=(0.3, 0.5), object_size_probability=1.0),
        Compose([RollAndZoom(), RandomCrop((32, 48))]),
    ],
)
def test_geometry_stays_true(step: Augment) -> None:
    changed = 0
    for seed in range(12):
        out = apply(step, seed)
        if not out.mask.any():
            continue
        off_plane, off_color = misfit(out)
        # depth is the nearest pixel's: on a plane tilted by up to 0.4 rad, half a pixel (7 mm) is
        # worth 3 mm
        assert off_plane < 0.009
        assert off_color < 0.06
        changed += not np.array_equal(out.rgb, sample().rgb)
    assert changed >= 6


def test_the_check_above_can_fail() -> None:
    out = apply(RollAndZoom(uniform_roll_probability=1.0), 3)
    assert misfit(dataclasses.replace(out, camera_from_object=sample().camera_from_object))[1] > 0.1


def test_a_zoom_about_the_object_leaves_its_middle_where_it_is() -> None:
    def shift(pivot: str) -> float:
        zoomed = apply(RollAndZoom(0.0, 0.0, (0.6, 0.6), pivot=pivot), 0, off_center)
        assert zoomed.mask.sum() < 0.5 * off_center.mask.sum()
        middles = [np.argwhere(x.mask).mean(0) for x in (off_center, zoomed)]
        return float(np.abs(middles[0] - middles[1]).max())

    off_center = apply(RandomCrop((48, 48), uniform_probability=0.0), 2)
    assert shift("object") < 0.5 < 1.0 < shift("center")
    with pytest.raises(UserError, match="pivot=corner"):
        RollAndZoom(pivot="corner")


def test_an_object_is_magnified_to_the_size_that_is_asked_for() -> None:
    step = RollAndZoom(
        0.0, 0.0, (0.7, 2.6), pivot="object", object_size=(0.3, 0.4), object_size_probability=1.0
    )
    x = sample()
    small = apply(RollAndZoom(0.0, 0.0, (0.4, 0.4)), 0)
    for start in (x, small, dataclasses.replace(x, visibility=float("nan"))):
        sizes = [
            np.sqrt(apply(step, seed, start).mask.sum()) / start.mask.shape[1] for seed in range(20)
        ]
        assert 0.29 < min(sizes) < max(sizes) < 0.41
    # what is hidden counts: half of the object is as large as an object of half the area
    half = [apply(step, 0, dataclasses.replace(x, visibility=share)) for share in (1.0, 0.5)]
    assert half[1].mask.sum() == pytest.approx(half[0].mask.sum() / 2, rel=0.05)
    empty = dataclasses.replace(x, mask=np.zeros_like(x.mask))
    assert apply(step, 0, empty).rgb.shape == x.rgb.shape
    with pytest.raises(UserError, match="object_size"):
        RollAndZoom(object_size=(0.4, 0.3))


@pytest.mark.parametrize(
    "step", [RandomCrop((32, 32), 0.0), RollAndZoom(0.5, 0.0, (1.5, 2.0), keep=0.1)]
)
def test_what_a_step_cuts_off_is_no_longer_visible(step: Augment) -> None:
    before = dataclasses.replace(sample(), visibility=0.8)
    shares = [apply(step, seed, before).visibility for seed in range(20)]
    assert min(shares) < 0.7
    assert max(shares) <= 0.8
    smaller = apply(RollAndZoom(0.0, 0.0, (0.5, 0.5)), 0, before)
    assert smaller.mask.sum() < 0.3 * before.mask.sum()
    assert smaller.visibility == pytest.approx(0.8, rel=0.05), "smaller, and as visible"


def test_a_window_shifts_the_principal_point() -> None:
    out = apply(RandomCrop((32, 32), uniform_probability=0.0), 0)
    assert out.rgb.shape == (32, 32, 3)
    assert out.mask.any()
    left, top = sample().intrinsics[:2, 2] - out.intrinsics[:2, 2]
    cut = sample().rgb[int(top) : int(top) + 32, int(left) : int(left) + 32]
    np.testing.assert_array_equal(out.rgb, cut)


def test_an_occluder_is_in_front_and_leaves_enough() -> None:
    hidden = 0
    for seed in range(20):
        out, before = apply(PasteOccluder(1.0, keep=0.3), seed), sample()
        lost = before.mask & ~out.mask
        hidden += bool(lost.any())
        assert out.mask.sum() >= 0.3 * before.mask.sum()
        assert (out.depth[lost] < before.depth[lost]).all()
        assert out.visibility == pytest.approx(out.mask.sum() / before.mask.sum())
    assert hidden > 5


def test_an_occluder_of_a_deep_object_is_in_front_of_its_surface_and_of_what_is_beside() -> None:
    x = sample()
    near = x.depth.copy()
    near[x.mask] = 0.75 * x.camera_from_object[2, 3]  # far before the object's origin
    deep, hidden = dataclasses.replace(x, depth=near), 0
    for seed in range(20):
        out = PasteOccluder(1.0)(deep, lambda rng: deep, np.random.default_rng(seed))
        lost = deep.mask & ~out.mask
        hidden += bool(lost.any())
        changed = (out.depth != deep.depth) & (deep.depth > 0)
        assert (out.depth[lost] < deep.depth[lost]).all()
        assert (out.depth[changed] < deep.depth[changed]).all()
    assert hidden > 5


def test_an_occluder_of_an_image_of_another_size_fits() -> None:
    x = sample()
    small = dataclasses.replace(x, rgb=x.rgb[::2, ::3].copy())
    pasted = 0
    for seed in range(20):
        out = PasteOccluder(1.0)(x, lambda rng: small, np.random.default_rng(seed))
        assert out.rgb.shape == x.rgb.shape
        pasted += not np.array_equal(out.rgb, x.rgb)
    assert pasted > 5


def test_noise_leaves_holes_alone_and_stays_small() -> None:
    x = sample()
    x.depth[5:9, 5:20] = 0
    out = apply(DepthNoise(), 1, x)
    assert (out.depth[5:9, 5:20] == 0).all()
    known = x.depth > 0
    assert 0 < np.abs(out.depth[known] - x.depth[known]).max() < 0.05


FLAWS = {
    "returned a NoneType, not a posefilter": lambda x: None,
    "rgb is float": lambda x: dataclasses.replace(x, rgb=x.rgb / 255),
    "rgb is uint8 .*channels first": lambda x: dataclasses.replace(x, rgb=x.rgb.transpose(2, 0, 1)),
    "mask is bool": lambda x: dataclasses.replace(x, mask=x.mask[:5]),
    "camera_from_object holds NaN": lambda x: dataclasses.replace(
        x, camera_from_object=np.nan * x.camera_from_object
    ),
    "depth is negative": lambda x: dataclasses.replace(x, depth=x.depth - 9),
}


@pytest.mark.parametrize("told", FLAWS)
def test_what_no_sample_can_be_is_refused(told: str) -> None:
    """Colors of 0 to 1 would be divided by 255 again, and learned as black."""
    cache, record = MemoryCache(), FrameRecord("a/0", "a", 0, 0, 1, "square", 0, ())
    cache.keep(record, sample())
    made = FrameDataset([record], cache, lambda x, draw, rng: FLAWS[told](x))
    with pytest.raises(UserError, match=rf"^data\.augment: {told}"):
        made[0]
    same = FrameDataset([record], cache, lambda x, draw, rng: x)
    assert same[0].rgb.max() > 0.5


def test_color_keeps_the_geometry_and_the_same_seed_the_same_image() -> None:
    a, b, c = apply(ColorJitter(), 1), apply(ColorJitter(), 1), apply(ColorJitter(), 2)
    np.testing.assert_array_equal(a.rgb, b.rgb)
    assert not np.array_equal(a.rgb, c.rgb)
    np.testing.assert_array_equal(a.depth, sample().depth)


@pytest.mark.parametrize("origin", [-2.0, 0.0, 7.0])
def test_an_occluder_is_before_the_object_wherever_its_meshs_origin_is(origin: float) -> None:
    """`origin` [m]: how far along the object's z axis the mesh's origin was moved."""
    own = sample()
    moved = np.eye(4)
    moved[2, 3] = origin
    shifted = dataclasses.replace(own, camera_from_object=own.camera_from_object @ moved)
    for seed in range(10):
        here, there = (apply(PasteOccluder(1.0), seed, one) for one in (own, shifted))
        np.testing.assert_array_equal(here.depth, there.depth)
        assert (there.depth >= 0).all()
