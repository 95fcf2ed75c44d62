"""The band of the outline: where it lies, and how often it holds the outline."""

import cv2
import numpy as np
import pytest
import torch

from posefilter.figures.band import draw_band, find_band, measure_cover
from posefilter.figures.canvas import View, full_view
from posefilter.figures.overlay import render_silhouette, trace_outline
from posefilter.geometry.pose import make_pose, move_about
from posefilter.geometry.rotation import exp_so3
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore, object_model

H, W = 120, 160
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
VIEW = full_view(H, W, 640)
GREY = np.full((H, W, 3), 128, np.uint8)
EVEN = np.full(400, 1 / 400)


@pytest.fixture(scope="module")
def carton() -> Mesh:
    return MeshStore("builtin").load("carton")


def draw_poses(count: int, deviation: float, seed: int = 0) -> np.ndarray:
    """Draw poses round one, their shifts and turns about the frame's origin normal."""
    pose = make_pose(exp_so3(torch.tensor([0.5, 0.6, 0.1])), torch.tensor([0.02, 0.01, 0.6]))
    noise = torch.randn(count, 6, generator=torch.Generator().manual_seed(seed)).double()
    twist = deviation * noise * torch.tensor([1.0, 1, 1, 5, 5, 5])
    return move_about(pose.double().expand(count, 4, 4), twist, torch.zeros(3).double()).numpy()


def share_in_band(cover: np.ndarray, poses: np.ndarray, shape: Mesh, level: float) -> float:
    """Return the share of the outlines' points that lie between the band's edges."""
    surely, maybe = find_band(cover, level)
    inside = total = 0
    for pose in poses:
        mask = render_silhouette(shape, pose, VIEW.camera(K), VIEW.height, VIEW.width)
        # the silhouette ends between its outermost pixels and those beyond
        inner = np.concatenate(trace_outline(mask))
        outer = np.concatenate(trace_outline(cv2.dilate(mask.astype(np.uint8), np.ones((3, 3)))))
        inside += int(maybe[inner[:, 1], inner[:, 0]].sum())
        inside += int((~surely[outer[:, 1], outer[:, 0]]).sum())
        total += len(inner) + len(outer)
    # a point is outside on one side or on the other, and each side was asked for every point
    return 1 - 2 * (total - inside) / total


@pytest.mark.parametrize("level", [0.5, 0.95])
def test_a_right_belief_s_band_holds_its_level_of_the_outlines_points(
    carton: Mesh, level: float
) -> None:
    cover = measure_cover(draw_poses(400, 0.004), EVEN, carton, K, VIEW)
    held = share_in_band(cover, draw_poses(60, 0.004, seed=1), carton, level)
    assert held == pytest.approx(level, abs=0.07)


def test_a_belief_that_is_too_sure_holds_less(carton: Mesh) -> None:
    cover = measure_cover(draw_poses(400, 0.002), EVEN, carton, K, VIEW)
    assert share_in_band(cover, draw_poses(60, 0.006, seed=1), carton, 0.95) < 0.75


def test_the_band_is_as_wide_as_the_central_interval_of_a_shift(carton: Mesh) -> None:
    deviation, z = 0.01, 0.6
    poses = np.tile(np.eye(4), (400, 1, 1))
    at = torch.linspace(0.5 / 400, 1 - 0.5 / 400, 400).double()
    poses[:, 0, 3] = deviation * (2**0.5) * torch.erfinv(2 * at - 1).numpy()
    poses[:, 2, 3] = z
    hull = object_model(carton, count=10).hull
    surely, maybe = find_band(measure_cover(poses, EVEN, hull, K, VIEW), 0.9)
    row = VIEW.height // 2
    middle = np.flatnonzero(surely[row])[0] - np.flatnonzero(maybe[row])[0]
    front = z - float(np.abs(hull[:, 2].numpy()).max())
    expected = 2 * 1.645 * deviation * VIEW.camera(K)[0, 0]
    assert expected / z * 0.97 < middle < expected / front * 1.03


def test_weights_count_and_a_sure_belief_has_no_band(carton: Mesh) -> None:
    poses = draw_poses(2, 0.05)
    cover = measure_cover(poses, np.array([1.0, 0.0]), carton, K, VIEW)
    assert set(np.unique(cover)) == {0.0, 1.0}
    surely, maybe = find_band(cover, 0.95)
    own = render_silhouette(carton, poses[0], VIEW.camera(K), VIEW.height, VIEW.width)
    assert (surely == maybe).all()
    assert (surely == own).all()


def test_hull_and_mesh_of_a_box_agree(carton: Mesh) -> None:
    poses, hull = draw_poses(60, 0.004), object_model(carton, count=10).hull
    even = np.full(60, 1 / 60)
    both = [measure_cover(poses, even, shape, K, VIEW) for shape in (carton, hull)]
    assert np.abs(both[0] - both[1]).mean() < 0.004


def test_poses_behind_the_camera_draw_nothing(carton: Mesh) -> None:
    behind = draw_poses(3, 0.001)
    behind[:, 2, 3] *= -1
    hull = object_model(carton, count=10).hull
    small = View(-0.5, -0.5, 1.0, W, H)
    assert not measure_cover(behind, np.ones(3), hull, K, small).any()
    picture = draw_band(GREY, K, behind, np.ones(3), hull)
    assert (picture[:480] == 128).all()
