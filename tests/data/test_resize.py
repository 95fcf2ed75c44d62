"""Resizing: depth and masks stay exact beside a camera that is resized with them."""

import numpy as np
import pytest
import torch
from dataset_trees import HEIGHT, WIDTH, K

from posefilter.data.resize import network_size, resize_depth, resize_mask
from posefilter.errors import UserError
from posefilter.geometry.camera import resize_intrinsics


@pytest.mark.parametrize("size", [(60, 80), (40, 53), (96, 128), (240, 320)])
def test_depth_of_an_oblique_plane_stays_exact(size):
    def plane(camera, height, width):
        v, u = np.mgrid[:height, :width]
        rays = np.stack(
            [
                (u - camera[0, 2]) / camera[0, 0],
                (v - camera[1, 2]) / camera[1, 1],
                np.ones(u.shape),
            ],
            -1,
        )
        return 0.6 / (rays @ np.array([0.5, -0.4, 0.75]))

    old = plane(K, HEIGHT, WIDTH).astype(np.float32)
    camera = resize_intrinsics(torch.from_numpy(K), size[1] / WIDTH, size[0] / HEIGHT).numpy()
    error = np.abs(resize_depth(old, *size) - plane(camera, *size))[1:-1, 1:-1]
    assert error.max() < 1e-4


def test_depth_is_not_mixed_across_edges_or_holes():
    depth = np.full((8, 8), 0.5, np.float32)
    depth[:, 3:] = 1.0
    depth[5:, :] = 0
    assert set(np.unique(resize_depth(depth, 4, 4)).tolist()) <= {0.0, 0.5, 1.0}
    assert set(np.unique(resize_depth(depth, 5, 7)).tolist()) <= {0.0, 0.5, 1.0}


def test_masks_keep_their_area():
    v, u = np.mgrid[:120, :160]
    disc = (u - 81.3) ** 2 + (v - 55.8) ** 2 < 37.0**2
    for height, width in ((60, 80), (40, 53), (45, 60)):
        small = resize_mask(disc, height, width)
        assert small.sum() / (height * width) == pytest.approx(disc.mean(), rel=0.01)
        rows, columns = np.nonzero(small)
        before = np.mean(np.nonzero(disc), axis=1)
        expected = (before + 0.5) * [height / 120, width / 160] - 0.5
        np.testing.assert_allclose([rows.mean(), columns.mean()], expected, atol=0.07)


def test_sizes():
    assert network_size(480, 640, 320, None) == (240, 320)
    assert network_size(540, 960, None, 270) == (270, 480)
    assert network_size(480, 640, None, None) == (480, 640)
    with pytest.raises(UserError, match="stretch"):
        network_size(480, 640, 320, 320)
