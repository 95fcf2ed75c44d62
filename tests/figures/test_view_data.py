"""What the 3-D view shows is what the filter did: checked number by number, without the library
that draws it.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import toy
from views import FIRST, SHARES, STEPS, H, N, W, box, hypotheses_of_belief, run, two_images

from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.figures.view_data import ViewData, collect_view_data, make_mesh
from posefilter.geometry.spaces import PixelSpace, PoseSpace
from posefilter.meshes.builtin import catalog as builtin

SPACE = PoseSpace((0.0, 0.0, 0.105), 0.136)
CONF = Path(__file__).parents[2] / "conf"


def second(pixels: bool = False, **changes: torch.Tensor) -> ViewData:
    """Return what is shown of the second image."""
    trace = run(pixels)
    trace = trace._replace(belief=trace.belief._replace(**changes))
    return collect_view_data(
        trace, two_images(), box(), PixelSpace() if pixels else SPACE, box().hull, image=1
    )


def test_cloud_is_the_depth_back_projected_in_the_photographs_colors() -> None:
    shown, batch = second(), two_images()
    cloud = shown.cloud
    K, found = batch.intrinsics[1].double().numpy(), 0
    for v in range(H):
        for u in range(W):
            z = float(batch.depth[1, 0, v, u])
            if z > 0:
                ray = np.linalg.inv(K) @ [u, v, 1.0]
                assert np.allclose(cloud.points[found], ray * z, atol=1e-9)
                assert np.allclose(cloud.colors[found], batch.rgb[1, :, v, u] * 255, atol=0.51)
                assert cloud.footprints[found] == pytest.approx(z / 10)
                found += 1
    assert found == len(cloud.points) == len(cloud.colors) < H * W
    assert shown.rgb.shape == (H, W, 3)


def test_every_step_is_shown_and_the_belief_after_them() -> None:
    shown, trace = second(), run(pixels=False)
    assert len(shown.moments) == STEPS + 1
    assert [len(m.weights) for m in shown.moments] == [FIRST, N, N, N]
    assert [m.sigma for m in shown.moments] == [
        pytest.approx(40.0),
        pytest.approx(20.0),
        pytest.approx(10.0),
        None,
    ]
    assert shown.unit == "mm"
    said = [(particles.log_weights, particles.state) for particles in trace.particles]
    said.append((trace.belief.log_weights, trace.belief.poses))
    for moment, (log_weights, poses) in zip(shown.moments, said, strict=True):
        weights = log_weights[1].exp().double().numpy()
        assert np.allclose(moment.weights, weights / weights.sum(), atol=1e-7)
        assert moment.effective == pytest.approx(1 / (weights**2).sum() / len(weights), rel=1e-5)
        assert np.allclose(moment.poses, poses[1])
        for i in (0, len(weights) - 1):
            center = poses[1, i].double().numpy() @ [0, 0, 0.105, 1]
            assert np.allclose(moment.centers[i], center[:3], atol=1e-6)
            ahead = shown.K @ center[:3]
            assert np.allclose(moment.pixels[i], ahead[:2] / ahead[2], atol=1e-4)


def test_pixels_are_shown_where_they_are_and_their_poses_too() -> None:
    shown, trace = second(pixels=True), run(pixels=True)
    assert shown.unit == "px"
    assert [m.sigma for m in shown.moments][:STEPS] == pytest.approx([0.04, 0.02, 0.01])
    for moment, particles, output in zip(
        shown.moments, trace.particles, trace.outputs, strict=False
    ):
        assert np.allclose(moment.pixels, particles.state[1])
        assert np.allclose(moment.poses, output.pose[1])
    assert np.allclose(shown.moments[-1].pixels, trace.particles[-1].state[1])
    assert np.allclose(shown.moments[-1].poses, trace.belief.poses[1])


def test_a_calibrated_belief_is_shown_where_its_own_poses_are() -> None:
    trace = run(pixels=True)
    few = trace.belief._replace(
        poses=trace.belief.poses[:, :5], log_weights=torch.full((2, 5), 0.2).log()
    )
    given = (trace._replace(belief=few), two_images(), box(), PixelSpace(), box().hull)
    last = collect_view_data(*given, image=1, draws=0).moments[-1]
    ahead = last.centers @ two_images().intrinsics[1].double().numpy().T
    assert last.pixels.shape == (5, 2)
    assert np.allclose(last.pixels, ahead[:, :2] / ahead[:, 2:])


def test_hypotheses_have_their_shares_and_the_estimate_stands_for_its_own() -> None:
    shown, at = second(), hypotheses_of_belief().double()
    # as refined, not as some particle has it
    assert np.allclose(shown.estimate.pose, run(False).belief.best[1])
    assert shown.estimate.weight == pytest.approx(SHARES[0], abs=1e-6)
    assert [other.weight for other in shown.others] == pytest.approx(SHARES[1:3], abs=1e-6)
    for other, pose in zip(shown.others, at[1:3], strict=True):
        assert float(SPACE.distance(torch.from_numpy(other.pose), pose)) < 0.005
    assert shown.left_out == pytest.approx(SHARES[3], abs=1e-6)


def test_an_estimate_that_no_particle_is_near_has_no_weight() -> None:
    away = torch.eye(4).expand(2, 4, 4).clone()
    away[:, 2, 3] = 3.0
    shown = second(best=away)
    assert shown.estimate.weight == 0
    assert [other.weight for other in shown.others] == pytest.approx(SHARES[:3], abs=1e-6)


def test_without_a_mesh_the_hull_is_shown_closed_and_outwards() -> None:
    mesh = second().mesh
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    # signed volume: outwards
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(0.06 * 0.16 * 0.21)
    assert ((mesh.corner_normals[:, 0] * (a - mesh.bounds.mean(0))).sum(1) > 0).all()
    flat = make_mesh(toy.square().hull, "square")
    assert np.allclose(np.abs(flat.vertices).max(0), [0.1, 0.1, 0])
    mug = builtin.build("mug")
    assert make_mesh(mug, "mug") is mug


@pytest.mark.parametrize("model", ["pose_pf", "pixel_pf", "patch_pf"])
def test_every_method_with_a_pose_can_be_shown(model: str, tmp_path: Path) -> None:
    few = ["filter.particles=12", "filter.steps=3", "filter/refine=none"]
    few += ["filter.initial_particles=16"] if model == "pose_pf" else []
    job = compose_job("train", CONF, [f"model={model}", *few], tmp_path)
    method = build_method(recipe(job), toy.square()).eval()
    batch = toy.scenes(1)
    with torch.no_grad():
        trace = method.predict_step(batch, 0)
    shown = collect_view_data(
        trace, batch, method.object_model, method.space, method.object_model.hull
    )
    assert len(shown.moments) == 4
    for moment, particles, output in zip(
        shown.moments, trace.particles, trace.outputs, strict=False
    ):
        assert np.allclose(moment.poses, output.pose[0], atol=1e-6)
        assert np.allclose(moment.pixels, method.particle_pixels(particles, batch)[0], atol=1e-2)
    assert np.allclose(shown.estimate.pose, trace.belief.best[0])
    assert shown.estimate.weight + sum(
        m.weight for m in shown.others
    ) + shown.left_out == pytest.approx(1)
    assert len(shown.cloud.points) == toy.H * toy.W
