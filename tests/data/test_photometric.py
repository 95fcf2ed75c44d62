"""Color models of cameras: each step obeys its law, and changes nothing but color."""

import dataclasses

import numpy as np
import pytest

from posefilter.data.augmentation import Augment, ColorJitter
from posefilter.data.frames import Sample
from posefilter.data.photometric import (
    ColorResponse,
    Highlights,
    Jpeg,
    MotionBlur,
    Sticker,
    Vignette,
    hue_rotation,
    mixing_matrix,
    respond,
    tint_gains,
    vignette,
)
from posefilter.errors import UserError
from posefilter.synthetic.sensor import motion_kernel

OFF = [
    ColorResponse(hue_deg=0, mixing=0, tint=0, gamma=0),
    ColorResponse(hue_deg=0, mixing=0, tint=0, gamma=0, target="object"),
    ColorResponse(probability=0),
    Vignette(0),
    Highlights(0, probability=1),
    Highlights(probability=0),
    MotionBlur(0, probability=1),
    MotionBlur(probability=0),
    Jpeg(probability=0),
    Sticker(probability=0),
    ColorJitter(0),
]
ON = [
    ColorResponse(),
    ColorResponse(target="object"),
    Vignette(),
    Highlights(probability=1),
    MotionBlur(0.2, probability=1),
    Jpeg(probability=1),
    Sticker(probability=1),
]


def sample(seed: int = 0) -> Sample:
    """Return an image of random colors, a square of it the object."""
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    mask = np.zeros((48, 64), bool)
    mask[10:30, 20:50] = True
    depth = rng.uniform(0.5, 1, (48, 64)).astype(np.float32)
    return Sample(
        rgb, depth, mask, np.eye(3, dtype=np.float32), np.eye(4, dtype=np.float32), 0, 0, 1.0
    )


def apply(step: Augment, x: Sample, seed: int = 1) -> Sample:
    return step(x, lambda rng: sample(9), np.random.default_rng(seed))


@pytest.mark.parametrize("step", OFF, ids=repr)
def test_strength_zero_is_the_identity_bit_for_bit(step: Augment) -> None:
    for seed in range(5):
        np.testing.assert_array_equal(apply(step, sample(seed), seed).rgb, sample(seed).rgb)


@pytest.mark.parametrize("step", ON, ids=repr)
def test_only_color_changes_and_the_seed_decides_how(step: Augment) -> None:
    before = sample()
    a, b, c = apply(step, before, 1), apply(step, before, 1), apply(step, before, 2)
    np.testing.assert_array_equal(a.rgb, b.rgb)
    assert not np.array_equal(a.rgb, c.rgb)
    assert not np.array_equal(a.rgb, before.rgb)
    assert a.rgb.dtype == np.uint8
    np.testing.assert_array_equal(before.rgb, sample().rgb)  # the cache's own pixels are left alone
    for field in dataclasses.fields(Sample):
        if field.name != "rgb":
            np.testing.assert_array_equal(getattr(a, field.name), getattr(before, field.name))


@pytest.mark.parametrize(
    ("on", "off"),
    [(ColorResponse(), OFF[0]), (ColorResponse(), OFF[2]), (Jpeg(), Jpeg(probability=0))],
)
def test_what_is_drawn_does_not_depend_on_the_strength(on: Augment, off: Augment) -> None:
    after = []
    for step in (on, off):
        rng = np.random.default_rng(3)
        step(sample(), lambda r: sample(9), rng)
        after.append(rng.random())
    assert after[0] == after[1]


def test_a_rotation_of_hue_keeps_gray_and_the_mean_of_the_channels() -> None:
    for angle in (-2.0, 0.1, 0.25, 3.0):
        turn = hue_rotation(angle)
        np.testing.assert_allclose(turn @ np.ones(3), np.ones(3), atol=1e-12)
        np.testing.assert_allclose(np.ones(3) @ turn, np.ones(3), atol=1e-12)
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
    red = np.array([1.0, 0, 0])
    # red, green, blue in turn
    np.testing.assert_allclose(hue_rotation(2 * np.pi / 3) @ red, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(hue_rotation(0.3) @ hue_rotation(0.5), hue_rotation(0.8), atol=1e-12)


def test_mixing_channels_keeps_gray_gray() -> None:
    rng = np.random.default_rng(0)
    entries = rng.normal(size=6) * 0.12
    matrix = mixing_matrix(entries)
    np.testing.assert_allclose(matrix @ np.ones(3), np.ones(3), atol=1e-12)
    np.testing.assert_array_equal(matrix[~np.eye(3, dtype=bool)], entries)
    gray = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, -1)
    for angle in (0.0, 0.2):
        out = respond(gray, matrix @ hue_rotation(angle), 1.0)
        np.testing.assert_array_equal(out, gray)
    tinted = respond(gray, np.diag(tint_gains(rng.normal(size=3) * 0.12)), 1.0)
    assert (tinted != gray).any()  # the law above can fail


def test_a_tint_changes_no_exposure() -> None:
    gains = tint_gains(np.array([0.2, -0.1, 0.35]))
    assert np.prod(gains) == pytest.approx(1)
    assert gains[0] / gains[1] == pytest.approx(np.exp(0.3))


def test_gamma_keeps_black_and_white_and_the_order_of_grays() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, -1)
    for exponent in (0.6, 1.8):
        out = respond(ramp, np.eye(3), exponent)[0, :, 0].astype(int)
        assert (out[0], out[-1]) == (0, 255)
        assert (np.diff(out) >= 0).all()
        assert (out[128] > 128) == (exponent < 1)


def test_the_object_changes_apart_from_its_surroundings() -> None:
    before, after = sample(), apply(ColorResponse(target="object"), sample())
    np.testing.assert_array_equal(after.rgb[~before.mask], before.rgb[~before.mask])
    assert (after.rgb[before.mask] != before.rgb[before.mask]).mean() > 0.5
    hidden = dataclasses.replace(before, mask=np.zeros_like(before.mask))
    np.testing.assert_array_equal(apply(ColorResponse(target="object"), hidden).rgb, before.rgb)


def test_the_drawn_hues_have_the_given_spread() -> None:
    """The standard deviation of hue is measured on a saturated color, to within its sampling error
    (3 sigma).
    """
    color = np.array([150, 110, 90], np.uint8)
    flat = dataclasses.replace(sample(), rgb=np.broadcast_to(color, (48, 64, 3)).copy())
    step = ColorResponse(hue_deg=14, mixing=0, tint=0, gamma=0)
    angles = [hue_of(apply(step, flat, seed).rgb[0, 0]) - hue_of(color) for seed in range(400)]
    spread = np.rad2deg(np.std((np.array(angles) + np.pi) % (2 * np.pi) - np.pi))
    # and half a degree for the rounding to bytes
    assert abs(spread - 14) < 3 * 14 / np.sqrt(2 * 400) + 0.5


def hue_of(color: np.ndarray) -> float:
    """Return the angle about the gray axis [rad]."""
    r, g, b = (float(x) for x in color)
    return float(np.arctan2(np.sqrt(3) * (g - b), 2 * r - g - b))


def test_a_vignette_darkens_corners_and_not_the_middle() -> None:
    gain = vignette(49, 65, 0.3)
    assert gain[24, 32] == 1
    np.testing.assert_allclose(gain[[0, 0, -1, -1], [0, -1, 0, -1]], 0.7, rtol=1e-6)
    assert (np.diff(gain[24, 32:]) < 0).all()


def test_highlights_clip_and_never_darken() -> None:
    before = sample()
    clipped = 0
    for seed in range(10):
        after = apply(Highlights(gain=0.5, probability=1), before, seed)
        assert (after.rgb >= before.rgb).all()
        clipped += bool((after.rgb == 255).sum() > (before.rgb == 255).sum())
    assert clipped >= 5


def test_motion_blur_keeps_a_constant_image_and_smooths_another() -> None:
    flat = dataclasses.replace(sample(), rgb=np.full((48, 64, 3), 77, np.uint8))
    for seed in range(5):
        assert (
            np.abs(apply(MotionBlur(0.2, probability=1), flat, seed).rgb.astype(int) - 77).max()
            <= 1
        )
    assert apply(MotionBlur(0.2, probability=1), sample()).rgb.std() < 0.9 * sample().rgb.std()


@pytest.mark.parametrize("length", [2, 3, 4, 5, 6, 8])
def test_motion_blur_is_as_long_as_asked_for_and_leaves_the_image_in_its_place(length: int) -> None:
    """A color that moved against depth and mask would be wrong by as much as it moved."""
    for seed in range(20):
        kernel = motion_kernel(np.random.default_rng(seed), length)
        at = np.mgrid[: len(kernel), : len(kernel)] - (len(kernel) - 1) / 2
        assert np.abs((kernel * at).sum((1, 2))).max() < 0.05
        along = np.linalg.eigvalsh(np.einsum("yx,iyx,jyx->ij", kernel, at, at))[1]
        assert 0.7 * length < np.sqrt(12 * along) < 1.5 * length  # of an even line


def test_a_jpeg_of_high_quality_is_closer_than_one_of_low() -> None:
    smooth = dataclasses.replace(
        sample(),
        rgb=np.repeat(np.arange(48, dtype=np.uint8)[:, None, None] * 5, 64, 1).repeat(3, -1),
    )
    error = []
    for quality in (95, 10):
        out = apply(Jpeg((quality, quality), probability=1), smooth).rgb.astype(int)
        error.append(np.abs(out - smooth.rgb).mean())
    assert error[0] < error[1] < 20


def test_a_sticker_stays_on_the_object_and_within_its_size() -> None:
    before = sample()
    area = before.mask.sum()
    for seed in range(20):
        changed = (apply(Sticker(1.0, (0.2, 0.4)), before, seed).rgb != before.rgb).any(-1)
        assert changed.any()
        assert not (changed & ~before.mask).any()
        assert changed.sum() <= 0.4**2 * area * 1.3  # a rectangle of whole pixels


def test_a_white_sticker_without_print_is_of_one_light_color() -> None:
    step = Sticker(1.0, (0.3, 0.4), white=1.0, printed=0.0)
    after = apply(step, sample(), 4).rgb
    label = after[(after != sample().rgb).any(-1)]
    assert (label == label[0]).all()
    assert label.min() > 140


def test_the_gain_is_shared_by_the_channels_and_within_its_range() -> None:
    gray = dataclasses.replace(sample(), rgb=np.full((48, 64, 3), 100, np.uint8))
    step = ColorResponse(hue_deg=0, mixing=0, tint=0, gamma=0, gain=(0.5, 2.0))
    values = [apply(step, gray, seed).rgb for seed in range(200)]
    assert all(np.ptp(x) == 0 for x in values)
    gains = np.array([x[0, 0, 0] / 100 for x in values])
    assert gains.min() == pytest.approx(0.5, abs=0.03)
    assert gains.max() == pytest.approx(2.0, abs=0.06)
    assert np.log(gains).mean() == pytest.approx(0, abs=0.08)


def test_an_unknown_target_is_refused() -> None:
    with pytest.raises(UserError, match="choose image or object"):
        ColorResponse(target="scene")
