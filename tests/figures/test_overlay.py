"""Overlays: what is drawn lies where the object is."""

import inspect
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch
from scipy.ndimage import distance_transform_edt

from posefilter.figures.band import draw_band
from posefilter.figures.belief import draw_belief
from posefilter.figures.canvas import AXES, ESTIMATE, TRUTH, View, close_up, full_view
from posefilter.figures.detections import draw_detections
from posefilter.figures.overlay import (
    draw_overlay,
    draw_poses,
    outline_object,
    render_silhouette,
    trace_outline,
    view_poses,
)
from posefilter.geometry.camera import project
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import exp_so3
from posefilter.meshes.mesh import Mesh
from posefilter.meshes.store import MeshStore, object_model

H, W = 120, 160
K = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
GREY = np.full((H, W, 3), 128, np.uint8)


@pytest.fixture(scope="module")
def carton() -> Mesh:
    return MeshStore("builtin").load(
        next(name for name in MeshStore("builtin").names() if "cracker" in name or "carton" in name)
    )


def pose(x: float = 0.02, z: float = 0.6) -> np.ndarray:
    return (
        make_pose(exp_so3(torch.tensor([0.5, 0.6, 0.1])), torch.tensor([x, 0.01, z]))
        .double()
        .numpy()
    )


def edge_distances(
    picture: np.ndarray, mask: np.ndarray, color: tuple[int, int, int]
) -> tuple[float, float]:
    """Return how far a drawn pixel is from the mask's edge at most, and an edge pixel from a drawn
    one.  [px]
    """
    drawn = (picture == color).all(-1)[: len(mask)]
    edge = np.zeros_like(mask)
    for line in trace_outline(mask):
        edge[line[:, 1], line[:, 0]] = True
    return float(distance_transform_edt(~edge)[drawn].max()), float(
        distance_transform_edt(~drawn)[edge].max()
    )


@pytest.mark.parametrize("kind", ["mesh", "hull"])
def test_outline_lies_on_the_edge_of_the_mask(carton: Mesh, kind: str) -> None:
    shape = carton if kind == "mesh" else object_model(carton, count=10).hull
    picture = draw_overlay(GREY, K, pose(), shape)
    shown = full_view(H, W, 640)
    mask = render_silhouette(carton, pose(), shown.camera(K), 480, 640)
    # the knobs of the axes have the outline's color: leave out what is far inside
    inside = picture.copy()
    inside[:480][distance_transform_edt(mask) > 12] = 0
    drawn_far, edge_far = edge_distances(inside, mask, ESTIMATE)
    assert drawn_far < 3
    assert edge_far < 3
    # canary: 2 cm are 20 px
    moved = render_silhouette(carton, pose(x=0.04), shown.camera(K), 480, 640)
    assert edge_distances(picture, moved, ESTIMATE)[1] > 12


def test_axes_start_at_the_center_of_the_box(carton: Mesh) -> None:
    picture = draw_overlay(GREY, K, pose(), carton)
    model = object_model(carton, count=10)
    shown = full_view(H, W, 640)
    for axis, color in enumerate(AXES):
        end = model.center.double() + 0.2 * model.radius * torch.eye(3, dtype=torch.float64)[axis]
        T = torch.from_numpy(pose())
        u, v = (
            project((T[:3, :3] @ end + T[:3, 3])[None], torch.from_numpy(shown.camera(K)))[0]
            .round()
            .int()
            .tolist()
        )
        near = picture[v - 2 : v + 3, u - 2 : u + 3].reshape(-1, 3)
        assert (near == color).all(-1).any()


def test_truth_is_drawn_where_it_is_given(carton: Mesh) -> None:
    assert not (draw_overlay(GREY, K, pose(), carton) == TRUTH).all(-1).any()
    assert (draw_overlay(GREY, K, pose(), carton, truth=pose(0.05)) == TRUTH).all(-1)[:480].any()


@pytest.mark.parametrize("kind", ["mesh", "hull"])
@pytest.mark.parametrize("bad", ["behind", "nan"])
def test_poses_that_cannot_be_seen_draw_nothing(carton: Mesh, kind: str, bad: str) -> None:
    shape = carton if kind == "mesh" else object_model(carton, count=10).hull
    T = pose(z=-1.0) if bad == "behind" else np.full((4, 4), np.nan)
    assert (draw_overlay(GREY, K, T, shape)[:480] == 128).all()


def test_hull_that_reaches_behind_the_camera_is_cut_at_the_near_plane() -> None:
    # below the camera
    beam = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (0.2, 0.3) for z in (-0.5, 1.5)])
    picture = draw_overlay(GREY, K, np.eye(4), beam)
    cx, cy = full_view(H, W, 640).place(np.array([79.5, 59.5]))
    v, u = np.nonzero((picture[:480] == ESTIMATE).all(-1))
    u, v = np.abs(u - cx), v - cy
    u, v = u[u > 8], v[u > 8]  # without the knob of the axis along the beam
    # of its far end; its edges run from there towards the viewer, u / v = 0.1 / 0.2
    top = 150 * 4 * 0.2 / 1.5
    sides = np.abs(u - v / 2) < 3
    assert (sides | (np.abs(v - top) < 3)).all()
    assert len(np.unique(v[sides])) >= 480 - cy - top - 3  # down to the frame's edge


def test_views_place_pixels_and_cameras_alike() -> None:
    view = View(10.5, 20.0, 3.5, 200, 150)
    points = torch.tensor([[0.1, -0.05, 0.7], [-0.2, 0.1, 1.1]], dtype=torch.float64)
    direct = project(points, torch.from_numpy(view.camera(K))).numpy()
    assert np.abs(direct - view.place(project(points, torch.from_numpy(K)).numpy())).max() < 1e-9
    dot = np.zeros((H, W, 3), np.uint8)
    dot[40, 30] = 255
    v, u = np.argwhere(view.show(dot)[..., 0] > 60).mean(0)
    assert np.abs([u, v] - view.place(np.array([30, 40]))).max() < 0.51
    assert (view.show(dot)[0, -1] == 0).all()
    assert (View(150.0, 0.0, 1.0, 40, 40).show(dot)[:, 20:] == 200).all()  # beyond the photograph


def test_whole_view_at_the_same_size_is_the_photograph() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (H, W, 3), dtype=np.uint8)
    assert (full_view(H, W, W).show(noise) == noise).all()


def test_close_up_holds_what_it_should(carton: Mesh) -> None:
    view = view_poses([pose(), pose(0.06)], carton, K, H, W, 480)
    for T in (pose(), pose(0.06)):
        mask = render_silhouette(carton, T, K, H, W)
        v, u = np.nonzero(mask)
        place = view.place(np.stack([u, v], 1))
        assert place.min() >= 0
        assert (place < [view.width, view.height]).all()
    assert view.scale > 3.5  # and enlarges
    assert close_up(np.array([[-500.0, -500.0], [900.0, 900.0]]), H, W, 480) == full_view(H, W, 480)


def test_a_coarse_outline_misses_the_fine_one_by_its_coarseness_at_most(carton: Mesh) -> None:
    fine, coarse = (
        outline_object(pose(), carton, K * [[4], [4], [1]], 480, 640, c) for c in (1, 3)
    )
    far = np.linalg.norm(np.concatenate(coarse)[:, None] - np.concatenate(fine)[None], axis=-1).min(
        1
    )
    assert far.max() <= 3
    inside = [
        cv2.fillPoly(np.zeros((480, 640), np.uint8), [x.astype(np.int32) for x in lines], 1)
        for lines in (fine, coarse)
    ]
    # no corner is lost, and nothing is shifted
    assert (inside[0] ^ inside[1]).sum() < 0.03 * inside[0].sum()
    assert sum(map(len, coarse)) < 40  # few and straight lines


@pytest.mark.parametrize(
    "draw", [draw_overlay, draw_poses, draw_belief, draw_band, draw_detections]
)
def test_pictures_take_the_image_and_its_intrinsics_first(draw: Callable[..., np.ndarray]) -> None:
    assert list(inspect.signature(draw).parameters)[:2] == ["rgb", "intrinsics"]
