"""Depth that no camera measures is unknown, or in another unit."""

import numpy as np
import pytest

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
