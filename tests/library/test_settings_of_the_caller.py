"""What a caller's settings of torch, lists of odd arrays, and odd images do to `predict`."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import posefilter
from posefilter.deploy.write import write_filter
from posefilter.errors import UserError
from posefilter.images import as_array, check_images

HOME = Path(__file__).parents[2]
FEW = ["filter.particles=30", "filter.initial_particles=40", "filter.steps=2", "filter/refine=none"]
K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])


@pytest.fixture(scope="module")
def small() -> posefilter.Estimator:
    return posefilter.load(str(HOME / "weights/003_cracker_box.ckpt"), overrides=FEW, device="cpu")


def make_image(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    g = np.random.default_rng(seed)
    depth = np.full((240, 320), 0.9, np.float32) + 0.01 * g.random((240, 320), np.float32)
    return g.integers(0, 255, (240, 320, 3), np.uint8), depth


def test_autocast_of_the_caller_changes_nothing(small: posefilter.Estimator) -> None:
    rgb, depth = make_image()
    plain = small.predict(rgb, depth, K)
    with torch.autocast("cpu", torch.bfloat16):
        under = small.predict(rgb, depth, K)
    assert np.array_equal(plain.pose, under.pose)


def test_autocast_of_the_caller_changes_no_track(small: posefilter.Estimator) -> None:
    plain, under = posefilter.Tracker(small), posefilter.Tracker(small)
    for seed in range(2):
        expected = plain.update(*make_image(seed), K)
        with torch.autocast("cpu", torch.bfloat16):
            found = under.update(*make_image(seed), K)
        assert np.array_equal(expected.pose, found.pose)


def test_another_default_type_is_refused(small: posefilter.Estimator, tmp_path: Path) -> None:
    tracker, method = posefilter.Tracker(small), small.methods[0]
    torch.set_default_dtype(torch.float64)
    try:
        with pytest.raises(UserError, match=r"set_default_dtype\(torch\.float64\)"):
            small.predict(*make_image(), K)
        with pytest.raises(UserError, match=r"set_default_dtype\(torch\.float64\)"):
            tracker.update(*make_image(), K)
        with pytest.raises(UserError, match=r"set_default_dtype\(torch\.float64\)"):
            write_filter(method, tmp_path, 320, 240, "torch")
    finally:
        torch.set_default_dtype(torch.float32)


def test_masks_and_gradients_within_a_list_count_as_alone() -> None:
    masked = np.ma.masked_array([[7.0, 0.9]], mask=[[True, False]])
    for many in ([masked, masked], (masked, masked)):
        assert as_array(many, "depth")[0].tolist() == [[0.0, 0.9]]
    sheet = torch.ones(2, 3, requires_grad=True)
    assert as_array([sheet, sheet.detach().bfloat16()], "depth").shape == (2, 2, 3)
    assert as_array(torch.eye(3).to_sparse(), "intrinsics").tolist() == np.eye(3).tolist()


def test_far_depth_that_fills_an_image_says_how_little_is_near() -> None:
    rgb, depth = make_image()
    depth[:] = 1e4
    depth[:20, :50] = 0.7
    with pytest.raises(UserError, match=r"median would be 1e\+04 m.*\(1\.3% of it is within 100"):
        check_images(rgb, depth, K)


@pytest.mark.parametrize("size", [(1500, 8), (900, 8)])
def test_a_narrow_image_is_not_enlarged_without_limit(
    small: posefilter.Estimator, size: tuple[int, int]
) -> None:
    rgb, depth = np.full((*size, 3), 90, np.uint8), np.full(size, 0.8, np.float32)
    rgb[::2] = 200
    narrow = np.array([[50.0, 0, size[1] / 2], [0, 50.0, size[0] / 2], [0, 0, 1]])
    with pytest.raises(UserError, match="would be enlarged to 320x"):
        small.predict(rgb, depth, narrow)


def test_the_image_without_depth_is_named(small: posefilter.Estimator) -> None:
    rgb, depth = make_image()
    few = np.zeros_like(depth)
    few[::8] = 0.9
    with pytest.raises(UserError, match=r"no pose can be proposed \(image 1 of 2"):
        small.predict(np.stack([rgb, rgb]), np.stack([depth, few]), K)


def test_a_seed_of_any_size_is_one(small: posefilter.Estimator) -> None:
    results = [small.predict(*make_image(), K, seed=seed) for seed in (1 << 64, (1 << 64) + 1)]
    assert all(np.isfinite(result.pose).all() for result in results)


def test_weights_that_change_through_data_count_from_the_next_evaluation() -> None:
    method: Any = posefilter.load(
        str(HOME / "weights/003_cracker_box.ckpt"), overrides=FEW, device="cpu"
    ).methods[0]
    layer = next(one for one in method.modules() if type(one).__name__ == "ConvNorm")
    channels = next(layer.parameters()).shape[1]
    image = torch.rand(1, channels, 16, 16)
    with torch.no_grad():
        before = layer(image)
        for parameter in layer.parameters():
            parameter.data.mul_(2.0)
        method.eval()
        assert not torch.equal(layer(image), before)
