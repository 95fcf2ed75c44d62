"""Crops against renders by the camera that they stand for, and what they leave out."""

import numpy as np
import pytest
import torch

from posefilter.geometry.camera import intrinsics
from posefilter.geometry.crops import crop_views, look_at
from posefilter.geometry.pose import make_pose
from posefilter.geometry.rotation import angle_between, random_rotation
from posefilter.meshes.store import MeshStore, object_model
from posefilter.rendering.embree import EmbreeRenderer
from posefilter.rendering.surfaces import Instance, Lights
from posefilter.rendering.views import render_views

SIDE, CENTER = 32, torch.tensor([0.28, -0.17, 0.75])
FLAT = Lights(ambient=1.0, directions=(), strengths=())


def test_looking_at_a_point_takes_the_least_turn() -> None:
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor(
        [0, 0, 2]
    )
    R = look_at(points)
    ahead = torch.nn.functional.normalize(points, dim=-1)
    torch.testing.assert_close(R[..., 2], ahead)
    torch.testing.assert_close(torch.det(R), torch.ones(50))
    torch.testing.assert_close(
        angle_between(R, torch.eye(3)), ahead[:, 2].acos(), atol=1e-3, rtol=0
    )
    assert torch.equal(look_at(torch.tensor([0.0, 0.0, 3.0])), torch.eye(3))


def picture(turn: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, float]:
    """Return color, depth and camera matrix of a photograph of the carton off the image's middle,
    and its radius.
    """
    mesh = MeshStore("builtin").load("carton")
    model = object_model(mesh)
    K = intrinsics(500.0, 480.0, 320.0, 240.0)
    R = look_at(CENTER) @ turn
    pose = make_pose(R, CENTER - R @ model.center).double().numpy()
    renderer = EmbreeRenderer()
    seen = renderer.render([Instance(mesh, pose)], K.double().numpy(), 480, 640, FLAT)
    rgb = torch.from_numpy(np.ascontiguousarray(seen.rgb)).permute(2, 0, 1).clamp(0, 1)
    return rgb[None], torch.from_numpy(seen.depth)[None, None], K[None], model.radius


def test_a_crop_is_what_a_camera_sees_that_looks_at_the_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("posefilter.rendering.views._LIGHTS", FLAT)
    mesh = MeshStore("builtin").load("carton")
    model = object_model(mesh)
    far = float(CENTER.norm())
    turns = random_rotation(4, generator=torch.Generator().manual_seed(1))
    views = render_views(mesh, turns, model.center, model.radius, far, SIDE).float()
    for turn, view in zip(turns, views, strict=True):
        rgb, depth, K, radius = picture(turn)
        crop = crop_views(rgb, depth, K, CENTER[None, None], radius, SIDE)[0, 0]
        # pixels of the outline may be either's
        inside = (crop[4] > 0) & (view[4] > 0)
        assert float(((crop[4] > 0) != (view[4] > 0)).float().mean()) < 0.04
        assert inside.sum() > 100
        assert float((crop[3] - view[3])[inside].abs().mean()) < 0.01
        assert float((crop[:3] - view[:3])[:, inside].abs().mean()) < 0.2  # of 2: print aliases
        apart = (crop - views).abs().mean((1, 2, 3))
        assert torch.equal(views[apart.argmin()], view)


def test_what_is_outside_of_the_ball_is_left_out_and_what_has_no_depth_is_not() -> None:
    K = intrinsics(50.0, 50.0, 31.5, 31.5)[None]
    rgb, depth = torch.full((1, 3, 64, 64), 0.75), torch.full((1, 1, 64, 64), 1.0)
    depth[..., 30:34] = 0  # a stripe
    here, behind = torch.tensor([0.0, 0, 1.02]), torch.tensor([0.0, 0, 1.5])
    crop, nothing = crop_views(rgb, depth, K, torch.stack([here, behind])[None], 0.2, 24)[0]
    stripe = crop[0, 12, 12]
    assert stripe == 0.5
    assert crop[4, 12, 12] == 0
    assert crop[3, 12, 12] == 0
    assert crop[3, 12, 4].item() == pytest.approx(-0.1, abs=1e-4)  # 2 cm nearer, of 20
    assert crop[:, 0, 0].abs().sum() == 0  # the ball's corner
    assert nothing[4].sum() == 0
    assert nothing[:3, :, 0].abs().sum() == 0


def test_out_of_the_frame_and_behind_the_camera_is_nothing() -> None:
    K = intrinsics(50.0, 50.0, 31.5, 31.5)[None]
    rgb, depth = torch.full((1, 3, 64, 64), 0.75), torch.full((1, 1, 64, 64), 1.0)
    centers = torch.tensor([[2.0, 0, 1.0], [0.0, 0, -1.0]])[None]
    assert crop_views(rgb, depth, K, centers, 0.2, 24).abs().sum() == 0
