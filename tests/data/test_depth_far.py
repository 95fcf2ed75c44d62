"""Depth that no camera measures is unknown, or in another unit."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from posefilter.cli.job import Job
from posefilter.cli.predict import read_inputs, read_photograph
from posefilter.errors import UserError
from posefilter.images import check_images, drop_unknown

RGB = np.full((40, 60, 3), 90, np.uint8)
K = np.array([[60.0, 0, 30], [0, 60, 20], [0, 0, 1]])


@pytest.mark.parametrize("far", [1000.0, 1e30, 1e300, np.inf, np.nan, -1.0])
def test_what_a_simulator_writes_where_there_is_nothing_is_unknown(far: float) -> None:
    depth = np.full((40, 60), far)
    depth[10:20, 10:30] = 0.8
    images, _ = check_images(RGB, depth, K)
    assert images.depth[0, 15, 20] == np.float32(0.8)
    assert np.unique(images.depth).tolist() == [0, np.float32(0.8)]


def test_depth_in_millimeters_is_still_said_to_be() -> None:
    depth = np.full((40, 60), 800.0)
    depth[0, :20] = 90.0  # a few pixels of noise
    with pytest.raises(UserError, match=r"the median would be 800 m; is it in meters\?"):
        check_images(RGB, depth, K)
    assert drop_unknown(np.full((4, 4), 1e300)).max() < np.inf


@pytest.mark.parametrize("form", ["masked", "last", "first"])
def test_depth_may_be_masked_or_have_a_channel(form: str) -> None:
    depth = np.full((40, 60), 0.8)
    depth[:20] = 50.0
    if form == "masked":
        images, _ = check_images(RGB, np.ma.masked_greater(depth, 10), K)
        assert np.unique(images.depth).tolist() == [0, np.float32(0.8)]
        return
    axis = -1 if form == "last" else 0
    images, _ = check_images(RGB, np.expand_dims(depth, axis), K)
    np.testing.assert_array_equal(images.depth[0], depth.astype(np.float32))


@pytest.mark.parametrize("name", ["far.npy", "far.tiff"])
def test_files_may_say_so_as_arrays_do(name: str, tmp_path: Path) -> None:
    depth = np.full((40, 60), 1e10, np.float32)
    depth[:15] = 0.8
    path, color = tmp_path / name, tmp_path / "a.png"
    if path.suffix == ".npy":
        np.save(path, depth)
    else:
        assert cv2.imwrite(str(path), depth)
    assert cv2.imwrite(str(color), RGB)
    _, read = read_photograph(str(color), str(path), 1000.0)
    assert np.unique(read).tolist() == [0, np.float32(0.8)]
    np.save(tmp_path / "mm.npy", np.full((40, 60), 800.0))
    with pytest.raises(UserError, match="its floats should be meters"):
        read_photograph(str(color), str(tmp_path / "mm.npy"), 1000.0)


def job_of(settings: dict[str, Any]) -> Job:
    """Return the command of a photograph."""
    return Job(OmegaConf.create(settings), {}, [], Path(), "predict", False)


def test_a_distortion_that_no_lens_has_is_named(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.full((40, 60), 0.8))
    assert cv2.imwrite(str(tmp_path / "a.png"), RGB)
    files = {"rgb": str(tmp_path / "a.png"), "depth": str(tmp_path / "depth.npy")}
    given = {**files, "depth_scale": 1000, "intrinsics": "60,60,30,20"}
    read_inputs(job_of({**given, "distortion": "0.1,0,0,0"}))
    with pytest.raises(UserError, match=r"^distortion=1e\+09,0,0,0: without it, .* % of the depth"):
        read_inputs(job_of({**given, "distortion": "1e9,0,0,0"}))
