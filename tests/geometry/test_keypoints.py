"""Maps of a planted box give back its pose; broken ones give none."""

import numpy as np
import pytest
import torch
from torch import Tensor

from posefilter.geometry.camera import intrinsics
from posefilter.geometry.keypoints import (
    box_keypoints,
    draw_gaussians,
    find_peaks,
    project_keypoints,
    solve_pnp,
)
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import random_rotation

K = intrinsics(270.0, 270.0, 79.5, 59.5)
BOX = box_keypoints(torch.tensor([[-0.1, -0.05, 0.0], [0.1, 0.05, 0.3], [0.0, 0.0, 0.1]]))
STRIDE = 4


def planted(count: int = 8) -> tuple[Tensor, Tensor]:
    """Return poses (count, 4, 4), and the pixels of keypoints in the frame (count, 9, 2)."""
    g = torch.Generator().manual_seed(0)
    turn = random_rotation(count, generator=g)
    center = torch.tensor([0.0, 0.0, 1.1]) - (turn @ BOX[-1])
    pose = make_pose(turn, center)
    pixels, ahead = project_keypoints(pose[:, None], BOX, K.expand(count, 3, 3))
    assert bool(ahead.all())
    return pose, pixels[:, 0]


def test_the_box_has_eight_corners_and_its_center() -> None:
    assert len({tuple(row) for row in BOX[:8].tolist()}) == 8
    torch.testing.assert_close(BOX[:8].mean(0), BOX[8])
    torch.testing.assert_close(BOX.amin(0), torch.tensor([-0.1, -0.05, 0.0]))
    torch.testing.assert_close(BOX.amax(0), torch.tensor([0.1, 0.05, 0.3]))


def test_peaks_of_gaussians_are_where_they_were_drawn() -> None:
    _, pixels = planted()
    maps = draw_gaussians(pixels, torch.ones(8, 9, dtype=torch.bool), 30, 40, STRIDE, 1.5)
    found, heights = find_peaks(maps, 1, STRIDE)
    torch.testing.assert_close(found[:, :, 0], pixels, atol=0.02, rtol=0)
    assert heights.min() > 0.85  # at most half a cell off


@pytest.mark.parametrize(("column", "row"), [(38, 28), (1, 1), (38, 1)])
def test_only_the_outermost_cells_have_peaks_in_their_middles(column: int, row: int) -> None:
    one = torch.ones(1, 1, dtype=torch.bool)
    inside = torch.tensor([[[column + 0.3, row - 0.2]]]) * STRIDE + (STRIDE - 1) / 2
    maps = draw_gaussians(inside, one, 30, 40, STRIDE, 1.5)
    torch.testing.assert_close(find_peaks(maps, 1, STRIDE)[0][:, :, 0], inside, atol=0.01, rtol=0)
    edge = torch.tensor([39 if column > 1 else 0, 29 if row > 1 else 0])
    middle = (edge * STRIDE + (STRIDE - 1) / 2).view(1, 1, 2)
    maps = draw_gaussians(middle + 0.8, one, 30, 40, STRIDE, 1.5)
    torch.testing.assert_close(find_peaks(maps, 1, STRIDE)[0][:, :, 0], middle)


def test_peaks_are_sorted_and_flat_maps_have_none() -> None:
    at = torch.tensor([[[20.0, 20.0]], [[100.0, 80.0]]])
    there = torch.ones(2, 1, dtype=torch.bool)
    low, high = draw_gaussians(at, there, 30, 40, STRIDE, 1.5)[:, :, None]
    pixels, heights = find_peaks(0.5 * low + high, 2, STRIDE)
    torch.testing.assert_close(pixels[0, 0], at[[1, 0], 0], atol=0.05, rtol=0)
    ratio = heights[0, 0, 1] / heights[0, 0, 0]
    torch.testing.assert_close(ratio, torch.tensor(0.5), atol=0.1, rtol=0)
    assert find_peaks(torch.zeros(1, 1, 8, 8), 2, STRIDE)[1].tolist() == [[[0.0, 0.0]]]


def test_maps_of_a_planted_box_give_back_its_pose() -> None:
    pose, pixels = planted()
    maps = draw_gaussians(pixels, torch.ones(8, 9, dtype=torch.bool), 30, 40, STRIDE, 1.5)
    peaks = find_peaks(maps, 1, STRIDE)[0][:, :, 0]
    for truth, image in zip(pose, peaks, strict=True):
        found = solve_pnp(BOX.numpy(), image.numpy(), K.numpy(), 2.0)
        assert found is not None
        np.testing.assert_allclose(found, truth.numpy(), atol=2e-3)


def test_ransac_leaves_wrong_keypoints_out() -> None:
    pose, pixels = planted(1)
    wrong = pixels[0].clone()
    wrong[:3] += torch.tensor([30.0, -25.0])
    found = solve_pnp(BOX.numpy(), wrong.numpy(), K.numpy(), 2.0)
    assert found is not None
    np.testing.assert_allclose(found, pose[0].numpy(), atol=2e-3)
    all_of_them = solve_pnp(BOX.numpy(), wrong.numpy(), K.numpy())
    assert all_of_them is None or np.abs(all_of_them - pose[0].numpy()).max() > 0.02


@pytest.mark.parametrize("pixels", [np.zeros((3, 2)), np.full((9, 2), np.nan), np.zeros((9, 2))])
def test_no_pose_is_made_up(pixels: np.ndarray) -> None:
    found = solve_pnp(BOX.numpy()[: len(pixels)], pixels, K.numpy(), 2.0)
    assert found is None or np.isfinite(found).all()


def test_a_keypoint_that_is_not_there_has_an_empty_map() -> None:
    there = torch.tensor([[True, False]])
    maps = draw_gaussians(torch.full((1, 2, 2), 50.0), there, 30, 40, STRIDE, 1.5)
    assert maps[0, 0].max() > 0.8
    assert maps[0, 1].max() == 0


def test_a_pose_behind_the_camera_or_beyond_100_m_is_none() -> None:
    """Pixels of a box before the camera, seen by one whose focal length is too long."""
    _, pixels = planted(1)
    assert solve_pnp(BOX.numpy(), pixels[0].numpy(), K.numpy()) is not None
    long = K.numpy() * np.array([[200.0], [200.0], [1.0]])
    long[:2, 2] = K.numpy()[:2, 2]
    assert solve_pnp(BOX.numpy(), pixels[0].numpy(), long) is None  # 220 m away
    half = K.numpy() * np.array([[60.0], [60.0], [1.0]])
    half[:2, 2] = K.numpy()[:2, 2]
    found = solve_pnp(BOX.numpy(), pixels[0].numpy(), half)
    assert found is not None
    assert 50 < found[2, 3] < 80


def test_four_keypoints_make_a_pose_and_three_do_not() -> None:
    pose, pixels = planted(1)
    some = [0, 3, 5, 6]
    found = solve_pnp(BOX[some].numpy(), pixels[0, some].numpy(), K.numpy())
    assert found is not None
    np.testing.assert_allclose(found, pose[0].numpy(), atol=5e-3)
    assert solve_pnp(BOX[:3].numpy(), pixels[0, :3].numpy(), K.numpy()) is None


def test_a_keypoint_at_the_cameras_plane_is_not_before_it() -> None:
    poses = torch.eye(4)[None, None].repeat(1, 3, 1, 1)
    poses[0, :, 2, 3] = torch.tensor([0.005, 0.011, 2.0])
    where, ahead = project_keypoints(poses, torch.tensor([[0.1, 0.0, 0.0]]), K[None])
    assert ahead[0, :, 0].tolist() == [False, True, True]
    assert where[0, 2, 0].tolist() == pytest.approx([79.5 + 270 * 0.05, 59.5])


def test_a_map_has_height_one_at_its_point_and_falls_as_a_gaussian() -> None:
    """A sigma of 1.5 cells of 4 px is 6 px."""
    middle = torch.tensor([[[5 * 4 + 1.5, 3 * 4 + 1.5]]])
    maps = draw_gaussians(middle, torch.ones(1, 1, dtype=torch.bool), 8, 10, STRIDE, 1.5)[0, 0]
    assert maps.shape == (8, 10)
    assert maps[3, 5] == 1
    assert float(maps[3, 8]) == pytest.approx(np.exp(-0.5 * (12 / 6) ** 2))
    assert float(maps[7, 5]) == pytest.approx(np.exp(-0.5 * (16 / 6) ** 2))


def test_the_corners_lie_along_the_objects_axes() -> None:
    found = box_keypoints(torch.tensor([[-1.0, 0.0, 2.0], [1.0, 3.0, 4.0], [0.0, 1.0, 3.0]]))
    corners = [[x, y, z] for x in (-1, 1) for y in (0, 3) for z in (2, 4)]
    assert found[:8].tolist() == corners
    assert found[8].tolist() == [0, 1.5, 3]
