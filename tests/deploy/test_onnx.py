"""What is exported answers as the method does, in programs without torch and posefilter."""

import ast
import io
import json
import logging
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import posefilter
from posefilter.cli import run_command
from posefilter.cli.checkpoints import build_method, recipe
from posefilter.cli.command import compose_job
from posefilter.deploy.resizing import Resize
from posefilter.deploy.settings import describe_alignment, describe_filter, describe_rotations
from posefilter.deploy.write import make_graphs, to_program, write_filter
from posefilter.errors import UserError
from posefilter.filters.icp import PointToPlaneIcp
from posefilter.filters.texture import TextureRotations, list_rotations
from posefilter.filters.texture_alignment import TextureAlignment
from posefilter.geometry.camera import project
from posefilter.geometry.pose import fit_rigid, is_rigid, make_pose, move_about
from posefilter.geometry.rotation import random_rotation
from posefilter.geometry.spaces import PoseSpace
from posefilter.images import check_images, make_batch
from posefilter.models.base import PoseEstimator
from posefilter.models.zoom import find_place, magnify, measure_zoom
from posefilter.types import BeliefBatch, Particles
from printed_objects import load, look

pytestmark = pytest.mark.slow

HOME = Path(__file__).parents[2]
ENCODING = (
    HOME / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0003_0"
)  # one mode: random numbers do not choose


def read_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color (H, W, 3) uint8, depth (H, W) float32 [m] and K (3, 3) of a scene that ships."""
    stem = min(ENCODING.glob("*.left.jpg")).name.removesuffix(".left.jpg")
    rgb = np.ascontiguousarray(cv2.imread(str(ENCODING / f"{stem}.left.jpg"))[..., ::-1])
    depth = cv2.imread(str(ENCODING / f"{stem}.left.depth.png"), cv2.IMREAD_UNCHANGED) / 10000
    (camera,) = json.loads((ENCODING / "_camera_settings.json").read_text())["camera_settings"][:1]
    own = camera["intrinsic_settings"]
    K = np.array([[own["fx"], 0, own["cx"]], [0, own["fy"], own["cy"]], [0, 0, 1]])
    return rgb, depth.astype(np.float32), K


def shrink_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the scene that ships at half its size, in an image that is blank elsewhere."""
    rgb, depth, K = read_scene()
    half = make_batch(check_images(rgb, depth, K)[0], depth.shape[1] // 2, None)
    small, z = (255 * half.rgb[0]).round().byte().movedim(0, 2).numpy(), half.depth[0, 0].numpy()
    high, wide = z.shape
    top, left = high // 4, wide // 2  # of the place in an image of 2 high x 2 wide
    room = (top, high - top), (left, wide - left)
    K = half.intrinsics[0].numpy() + np.array([[0, 0, left], [0, 0, top], [0, 0, 0]])
    return np.pad(small, (*room, (0, 0))), np.pad(z, room), K


@pytest.fixture(scope="module")
def poses(load_script: Callable[[str], ModuleType]) -> ModuleType:
    pytest.importorskip("onnxruntime", reason="needs the extra export")
    return load_script("examples/onnx/poses.py")


@pytest.fixture(scope="module")
def pixels(poses: ModuleType, load_script: Callable[[str], ModuleType]) -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(HOME / "examples" / "onnx"))
        return load_script("examples/onnx/pixels.py")


@pytest.fixture(scope="module")
def estimator() -> posefilter.Estimator:
    return posefilter.load(
        "003_cracker_box", device="cpu", overrides=["filter.magnified_width=null"]
    )


@pytest.fixture(scope="module")
def zoomed() -> posefilter.Estimator:
    return posefilter.load(
        "003_cracker_box", device="cpu", overrides=["filter.magnified_width=0.4"]
    )


@pytest.fixture(scope="module")
def exported(estimator: posefilter.Estimator, poses: ModuleType, tmp_path_factory) -> Path:
    pytest.importorskip("onnxscript", reason="needs the extra export")
    folder: Path = tmp_path_factory.mktemp("exported")
    height, width = read_scene()[1].shape
    write_filter(estimator.methods[0], folder, width, height, "onnx")
    return folder


def make_pixel_method(*overrides: str) -> PoseEstimator:
    """Return an untrained patch_pf of the cracker box, in test mode."""
    job = compose_job("train", HOME / "conf", ["model=patch_pf", *overrides], Path())
    torch.manual_seed(0)
    model = posefilter.load("003_cracker_box", device="cpu").object_models[0]
    return build_method(recipe(job), model, lightning=False).eval()


def test_networks_are_those_of_torch(
    exported: Path, estimator: posefilter.Estimator, poses: ModuleType, monkeypatch
) -> None:
    compare_networks(exported, estimator, poses, monkeypatch)


def test_the_surface_term_is_exported(poses: ModuleType, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("onnxscript", reason="needs the extra export")
    drill = posefilter.load("035_power_drill", device="cpu")
    assert drill.methods[0].likelihood.surface is not None
    height, width = read_scene()[1].shape
    write_filter(drill.methods[0], tmp_path, width, height, "onnx")
    compare_networks(tmp_path, drill, poses, monkeypatch)


def compare_networks(
    exported: Path, estimator: posefilter.Estimator, poses: ModuleType, monkeypatch
) -> None:
    """Assert that what was exported gives what torch gives."""
    monkeypatch.setattr("posefilter.nets.encoding.fast_bfloat16", lambda device: False)
    rgb, depth, K = read_scene()
    graphs = make_graphs(estimator.methods[0], depth.shape[1], depth.shape[0])
    images = torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(K).float()
    own = poses.PoseFilter(exported)
    names = [one.name for one in own.encode.get_outputs()]
    with torch.no_grad():
        truth = graphs.encode.network(*images)
    given = {"rgb": rgb, "depth": depth, "intrinsics": np.float32(K)}
    encoding = dict(zip(names, own.encode.run(names, given), strict=True))
    for name, value in zip(names, truth, strict=True):
        assert np.abs(encoding[name] - value.numpy()).max() < 1e-3 * max(
            1, float(value.abs().max())
        )
    draw = np.random.default_rng(0)
    for count, points, sigma in ((1, 7, 0.04), (200, 64, 0.01)):
        states = poses.draw_poses(
            *(encoding[name] for name in ("point", "weight", "share", "position")),
            own.center, own.radius, count, draw,
        )  # fmt: skip
        scores = own.score(encoding, states, sigma, points, np.random.default_rng(1))
        noise = poses.draw_points(
            points, own.settings["quasi_monte_carlo"], np.random.default_rng(1)
        )
        tensors = [torch.from_numpy(one) for one in (states, noise)]
        with torch.no_grad():
            same = graphs.measure.network(tensors[0], torch.tensor(sigma), tensors[1], *truth[:5])
        assert scores.std() > 0 or count == 1
        assert np.abs(scores - same.numpy()).max() < 2e-2  # of scores of up to hundreds


def test_the_example_aligns_as_torch_does(
    estimator: posefilter.Estimator, poses: ModuleType
) -> None:
    rgb, depth, K = read_scene()
    method = estimator.methods[0]
    batch = make_batch(check_images(rgb, depth, K)[0], None, None)
    icp = PointToPlaneIcp(iterations=6, prior=0.01)
    own = poses.PoseFilter.__new__(poses.PoseFilter)
    own.center, own.radius = method.object_model.center.numpy(), float(method.object_model.radius)
    surface = icp.choose_points(method.object_model.points).numpy()
    found = torch.from_numpy(estimator.predict(rgb, depth, K).pose).float()
    image = {"depth": batch.depth[0, 0].numpy(), "intrinsics": batch.intrinsics[0].numpy()}
    for number in range(3):
        noise = torch.randn(6, generator=torch.Generator().manual_seed(number))
        start = method.space.move(found, 0.006 * noise)[None]
        given = BeliefBatch(start[:, None], torch.zeros(1, 1), start, torch.zeros(1))
        theirs = icp(given, method.encode(batch), method, torch.Generator()).best[0].numpy()
        ours = own.align(image, start[0].numpy(), surface, **vars(icp))
        assert np.abs(theirs - start[0].numpy()).max() > 8e-3
        assert np.abs(ours - theirs).max() < 1e-3  # pixels are rounded in another precision


@pytest.mark.parametrize("name", ["soup_can", "carton"])
def test_the_example_lays_the_print_on_the_image_as_torch_does(
    name: str, poses: ModuleType
) -> None:
    model, align = load(name), TextureAlignment(min_gain=0.0)
    own = poses.PoseFilter.__new__(poses.PoseFilter)
    own.center, own.radius = model.center.numpy(), float(model.radius)
    own.settings = {"diameter": model.diameter}
    described = describe_alignment(align, model)
    space = PoseSpace(tuple(model.center.tolist()), model.radius)
    method: Any = SimpleNamespace(object_model=model)
    moved = 0
    for seed in range(4):
        g = torch.Generator().manual_seed(seed)
        R = random_rotation(1, generator=g)[0]
        truth = make_pose(R, torch.tensor([0.0, 0, 4.5 * model.radius]) - R @ model.center)
        encoding = look(name, truth)
        noise = space.noise_scale(torch.tensor(0.004)) * torch.randn(1, 6, generator=g)
        start = space.move(truth[None], noise)
        given = BeliefBatch(start[:, None], torch.zeros(1, 1), start, torch.zeros(1))
        theirs = align(given, encoding, method, torch.Generator()).best[0].numpy()
        image = {
            "rgb": 255 * encoding.measured_color[0].movedim(0, 2).numpy(),
            "depth": encoding.measured_depth[0].numpy(),
            "intrinsics": encoding.intrinsics[0].numpy(),
        }
        ours = own.align_print(image, start[0].numpy(), **described)
        moved += not np.array_equal(theirs, start[0].numpy())
        assert np.abs(ours - theirs).max() < 1e-3  # pixels are rounded in another precision
    assert moved >= 3


@pytest.mark.parametrize("name", ["soup_can", "carton"])
def test_the_example_turns_as_torch_does(name: str, poses: ModuleType) -> None:
    model, turn = load(name), TextureRotations()
    turns, coarse = list_rotations(model)
    assert (len(coarse) > 12) == (name == "soup_can")  # both ways through the stages
    R = random_rotation(1, generator=torch.Generator().manual_seed(2))[0]
    truth = make_pose(R, torch.tensor([0.0, 0, 4.5 * model.radius]) - R @ model.center)
    encoding = look(name, truth)
    wrong = truth @ turns[len(turns) // 3]
    given = BeliefBatch(wrong.expand(1, 20, 4, 4), torch.zeros(1, 20), wrong[None], torch.zeros(1))
    method: Any = SimpleNamespace(object_model=model)
    theirs = turn(given, encoding, method, torch.Generator()).best[0].numpy()
    own = poses.PoseFilter.__new__(poses.PoseFilter)
    own.center, own.radius = model.center.numpy(), float(model.radius)
    own.settings = {"diameter": model.diameter}
    own.score = lambda encoding, states, *_: np.zeros(len(states))
    image = {
        "rgb": 255 * encoding.measured_color[0].movedim(0, 2).numpy(),
        "depth": encoding.measured_depth[0].numpy(),
        "intrinsics": encoding.intrinsics[0].numpy(),
    }
    (described,) = describe_rotations(turn, model)
    ours, particles = own.turn(
        None, image, wrong.numpy(), given.poses[0].numpy(), np.random.default_rng(0), **described
    )
    assert np.abs(wrong.numpy() - theirs).max() > 0.5
    assert np.abs(ours - theirs).max() < 1e-3
    assert np.abs(particles - ours).max(axis=(1, 2)).min() < 0.1  # by turns of ten degrees
    assert all(is_rigid(torch.from_numpy(one)) for one in particles)


def measure_apart(estimator: posefilter.Estimator, one: np.ndarray, other: np.ndarray) -> float:
    """Return the mean distance of the object's points under two poses [m]."""
    points = estimator.object_models[0].points.numpy()
    turned = points @ (one[:3, :3] - other[:3, :3]).T
    return float(np.linalg.norm(turned + one[:3, 3] - other[:3, 3], axis=1).mean())


def test_an_estimate_is_that_of_torch(
    exported: Path, estimator: posefilter.Estimator, poses: ModuleType
) -> None:
    rgb, depth, K = read_scene()
    pose, _, particles, weights = poses.PoseFilter(exported).estimate(rgb, depth, K)
    assert measure_apart(estimator, pose, estimator.predict(rgb, depth, K).pose) < 0.004
    assert is_rigid(torch.from_numpy(pose))
    assert particles.shape == (estimator.methods[0].filter.particles, 4, 4)
    assert weights.sum() == pytest.approx(1)


@pytest.mark.parametrize("early", [True, False])
def test_a_small_object_is_estimated_in_a_window_as_by_torch(
    early: bool, exported: Path, zoomed: posefilter.Estimator, poses: ModuleType
) -> None:
    rgb, depth, K = shrink_scene()
    own = poses.PoseFilter(exported)
    own.settings |= json.loads(json.dumps(describe_filter(zoomed.methods[0])))
    if not early:  # as where no place has enough weight after the first steps
        own.settings["zoom"]["steps"] = 0
    encode, seen, calls = own.encode, [], []  # images that were encoded, steps on each

    def watch(names: list[str], image: dict[str, np.ndarray]) -> Any:
        seen.append(image)
        return encode.run(names, image)

    def call(name: str, step: Callable[..., Any], *given: Any, **settings: Any) -> Any:
        assert all(one is seen[-1] for one in given if isinstance(one, dict) and "rgb" in one)
        calls.append((name, len(seen)))
        return step(*given, **settings)

    own.encode = SimpleNamespace(get_outputs=encode.get_outputs, run=watch)
    for name in ("score", "align", "turn"):
        setattr(own, name, partial(call, name, getattr(own, name)))
    pose, _, particles, _ = own.estimate(rgb, depth, K)
    whole, window = seen
    assert (calls.count(("score", 1)) == 3) == early
    assert {("score", 2), ("align", 2), ("turn", 2)} <= set(calls)
    z = (pose @ np.append(own.center, 1))[2]
    share = own.settings["diameter"] / z / depth.shape[1]
    assert share * whole["intrinsics"][0, 0] < 0.3
    assert share * window["intrinsics"][0, 0] == pytest.approx(0.4, abs=0.005)
    assert measure_apart(zoomed, pose, zoomed.predict(rgb, depth, K).pose) < 0.004
    assert measure_apart(zoomed, particles[0], pose) < 0.03  # they are of the whole image's camera


@pytest.mark.parametrize(
    ("z", "share", "zoom"),
    [(1.6, 0.8, 1.4), (9.0, 0.8, 4.0), (0.8, 0.8, None), (1.6, 0.6, None), (-1.6, 0.8, None)],
)
def test_the_example_magnifies_as_torch_does(
    z: float, share: float, zoom: float | None, zoomed: posefilter.Estimator, poses: ModuleType
) -> None:
    rgb, depth, K = read_scene()
    model = zoomed.object_models[0]
    batch = make_batch(check_images(rgb, depth, K)[0], None, None)
    R = random_rotation(250, generator=torch.Generator().manual_seed(3))
    centers = torch.tensor([0.2, -0.3, 1.0]) * z + 0.02 * torch.randn(250, 3)
    centers[200:] += 1.0  # another place, whose particles have all the rest of the weight
    states = make_pose(R, centers - R @ model.center)
    weights = torch.cat([torch.rand(200) + 0.5, torch.rand(50) + 0.5])
    weights[:200] *= share / weights[:200].sum()
    weights[200:] *= (1 - share) / weights[200:].sum()
    nothing = torch.zeros(1, 250, 0)
    particles = Particles(states[None], nothing, weights.log()[None], torch.arange(250)[None])
    center, most = find_place(particles, model)
    factor = measure_zoom(center, batch, model, 0.4)
    own = poses.PoseFilter.__new__(poses.PoseFilter)
    own.center, own.settings = model.center.numpy(), describe_filter(zoomed.methods[0])
    image = {"rgb": rgb, "depth": depth, "intrinsics": np.float32(K)}
    window = own.magnify(image, states.numpy(), weights.numpy(), **own.settings["zoom"])
    assert float(most) == pytest.approx(share)
    assert (window is None) == (zoom is None)
    if window is None:
        assert share < 0.7 or float(factor) == 1
        return
    assert float(factor) == pytest.approx(zoom, abs=0.1)
    view = magnify(batch, project(center[:, None], batch.intrinsics)[:, 0], factor)
    np.testing.assert_allclose(window["rgb"], 255 * view.rgb[0].movedim(0, 2), atol=0.51)
    np.testing.assert_allclose(window["depth"], view.depth[0, 0], atol=1e-5)
    np.testing.assert_allclose(window["intrinsics"], view.intrinsics[0], rtol=1e-5)


@pytest.mark.parametrize("encoder", ["unet", "foveated"])
def test_a_filter_over_pixels_takes_the_same_steps(
    encoder: str, pixels: ModuleType, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("onnxscript", reason="needs the extra export")
    method = make_pixel_method(
        f"model/encoder={encoder}",
        *("filter/propagate=learned", "filter/resample=none", "filter/estimate=argmax"),
        *("filter.particles=12", "filter.steps=3", "data.image_width=96"),
    )
    rgb, depth, K = read_scene()
    with caplog.at_level(logging.INFO):
        write_filter(method, tmp_path, depth.shape[1], depth.shape[0], "onnx")
    assert caplog.messages == []
    images, _ = check_images(rgb, depth, K)
    batch = make_batch(images, 96, None)
    with pytest.MonkeyPatch.context() as patch, torch.no_grad():
        patch.setattr("posefilter.nets.encoding.fast_bfloat16", lambda device: False)
        trace = method.predict_step(batch, 0)
    start = trace.particles[0].state[0].numpy()
    pose, score, found = pixels.PixelFilter(tmp_path).estimate(rgb, depth, K, start=start)
    assert np.abs(trace.particles[-1].state[0].numpy() - start).max() > 0.5  # they moved
    np.testing.assert_allclose(found["state"], trace.particles[-1].state[0], atol=0.02)
    np.testing.assert_allclose(found["next_latent"], trace.outputs[-1].latent[0], atol=2e-3)
    np.testing.assert_allclose(pose, trace.belief.best[0], atol=2e-3)
    assert score == pytest.approx(float(trace.belief.score[0]), abs=1e-3)


def test_agreement_finds_a_planted_pose_among_wrong_particles(pixels: ModuleType) -> None:
    draw = np.random.default_rng(0)
    truth = np.eye(4, dtype=np.float32)
    truth[:3, :3], truth[:3, 3] = random_rotation(1)[0], (0.1, -0.05, 0.8)
    objects = np.float32(draw.uniform(-1, 1, (100, 3)))
    points = np.float32(0.1 * objects) @ truth[:3, :3].T + truth[:3, 3]
    points[60:] += np.float32(draw.uniform(-0.2, 0.2, (40, 3)))
    own = pixels.PixelFilter.__new__(pixels.PixelFilter)
    rule = {"scale_m": 0.015, "hypotheses": 64, "iterations": 8}
    own.settings = {"center": [0, 0, 0], "radius": 0.1, "estimate": rule}
    found = {
        "point": points, "known": np.ones(100, np.float32), "log_likelihood": np.zeros(100),
        "share": np.ones((100, 1), np.float32), "position": objects[:, None],
        "pose": np.tile(np.eye(4, dtype=np.float32), (100, 1, 1)),
    }  # fmt: skip
    pose, score = own.agree(found, np.random.default_rng(0))
    np.testing.assert_allclose(pose, truth, atol=1e-3)
    assert 0.55 < score < 0.7


def test_the_examples_geometry_is_ours(poses: ModuleType) -> None:
    R = random_rotation(8)
    states = torch.eye(4).repeat(8, 1, 1)
    states[:, :3, :3], states[:, :3, 3] = R, torch.randn(8, 3)
    tangent, center = torch.randn(8, 6), torch.randn(3)
    tangent[0] = 0
    moved = poses.move(states.numpy(), tangent.numpy(), center.numpy())
    np.testing.assert_allclose(moved, move_about(states, tangent, center), atol=1e-5)
    source, target, weights = torch.randn(8, 5, 3), torch.randn(8, 5, 3), torch.rand(8, 5)
    ours = fit_rigid(source, target, weights)
    theirs = poses.fit_rigid(source.numpy(), target.numpy(), weights.numpy())
    np.testing.assert_allclose(theirs, ours, atol=1e-4)


def test_the_examples_draws_follow_their_weights(poses: ModuleType) -> None:
    weights = np.random.default_rng(0).dirichlet(np.ones(30))
    children = np.bincount(poses.resample(weights, 200, np.random.default_rng(1)), minlength=30)
    assert (np.abs(children - 200 * weights) < 1).all()  # systematic: floor or ceil
    drawn = poses.draw(np.stack([weights, weights[::-1]]), np.random.default_rng(2), 4000)
    for row, wanted in zip(drawn, (weights, weights[::-1]), strict=True):
        share = np.bincount(row, minlength=30) / 4000
        assert (np.abs(share - wanted) < 5 * np.sqrt(wanted / 4000) + 1e-3).all()


@pytest.mark.parametrize("name", ["poses", "pixels"])
def test_the_examples_import_neither_torch_nor_us(name: str) -> None:
    tree = ast.parse((HOME / "examples" / "onnx" / f"{name}.py").read_text())
    found = {one.module for one in ast.walk(tree) if isinstance(one, ast.ImportFrom)}
    found |= {a.name for one in ast.walk(tree) if isinstance(one, ast.Import) for a in one.names}
    assert found <= {"json", "sys", "pathlib", "statistics", "numpy", "onnxruntime", "cv2", "poses"}


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (["nothing", "c.png", "d.png", "1,1,1,1", "1"], "nothing: no folder that export.py"),
        (["cut_short", "c.png", "d.png", "1,1,1,1", "1"], "cut_short: no folder that export.py"),
        (["pixels", "c.png", "d.png", "1,1,1,1", "1"], "pixels: its particles are pixels; pix"),
        (["poses", "c.png", "d.png", "1,1,1", "1"], "1,1,1 1: expected fx,fy,cx,cy"),
        (["poses", "c.png", "d.png", "1,1,1,1", "mm"], "1,1,1,1 mm: expected"),
        (["poses", "c.png", "d.png", "1,1,1,1", "0"], "0: expected .* above 0"),
        (["poses", "a.png", "d.png", "1,1,1,1", "1"], "a.png: no image that OpenCV reads"),
        (["poses", "c.png", "c.png", "1,1,1,1", "1"], "c.png: has 3 channels, and depth has one"),
        (["poses", "c.png", "0.png", "1,1,1,1", "1"], "0.png: no pixel has depth"),
        (["poses", "c.png", "8.png", "1,1,1,1", "1"], "8.png: is of uint8; depth is uint16, or"),
        (["poses", "c.png", "d.png", "nan,1,1,1", "1"], "nan,1,1,1: fx and fy must be above 0"),
        (["poses", "c.png", "d.png", "1,-1,1,1", "1"], "1,-1,1,1: fx and fy must be above 0"),
        (["poses", "c.png", "d.png", "1,1,1,1", "inf"], "inf: expected the depth image's units"),
        (["poses", "c.png", "d.png", "1,1,1,1", "1"], "1: the median depth would be 700 m; is it"),
        (["poses", "c.png", "d.png", "1,1,1,1", "1e5"], "1e5: the median depth would be 0.007 m"),
    ],
)
def test_the_examples_mistakes_are_one_line(
    typed: list[str], told: str, poses: ModuleType, tmp_path: Path, monkeypatch
) -> None:
    for name in ("poses", "pixels"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "filter.json").write_text(json.dumps({"particles_are": name}))
        for graph in ("encode", "measure"):
            (tmp_path / name / f"{graph}.onnx").touch()
    (tmp_path / "cut_short").mkdir()  # the settings without the networks
    (tmp_path / "cut_short" / "filter.json").write_text(json.dumps({"particles_are": "poses"}))
    depth = np.full((6, 8), 700, np.uint16)
    color, shown = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 70, np.uint8)
    for name, image in (("c", color), ("d", depth), ("0", 0 * depth), ("8", shown)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["poses.py", *typed])
    with pytest.raises(SystemExit, match=f"^{told}"):
        poses.read_arguments("poses")


def test_an_image_that_cannot_be_used_is_refused_and_the_next_one_may_be(
    poses: ModuleType, capsys
) -> None:
    """A program that takes the example's class goes on after it; the example itself ends."""
    rgb, depth, K = read_scene()
    settings = {"camera": [depth.shape[1], depth.shape[0]]}
    kept = poses.take_image(settings, rgb, np.where(depth > 0, depth, np.nan), K)["depth"]
    np.testing.assert_array_equal(kept, depth)
    for wrong in ((1000 * depth).astype(np.uint16), 1000 * depth, depth / 100, 0 * depth):
        with pytest.raises(poses.ImageError, match="not in meters"):
            poses.take_image(settings, rgb, wrong, K)
    with pytest.raises(poses.ImageError, match="exported for images of 320x240"):
        poses.take_image(settings, rgb[1:], depth[1:], K)
    with pytest.raises(poses.ImageError, match="the image has 320x240 pixels, its depth 320x239"):
        poses.take_image(settings, rgb, depth[1:], K)
    with pytest.raises(poses.ImageError, match=r"float64 \(240, 320, 3\); expected uint8"):
        poses.take_image(settings, rgb / 255, depth, K)
    example = SimpleNamespace(estimate=lambda *image: poses.take_image(settings, *image))
    with pytest.raises(SystemExit, match=r"^depth: no pixel has any"):
        poses.print_estimate(example, (rgb, 0 * depth, K))
    example.estimate = lambda *image: (np.eye(4), 1.5)
    poses.print_estimate(example, (rgb, depth, K))
    assert "score 1.50" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("before", "width"), [((480, 640), 320), ((481, 643), 200), ((60, 80), 160), ((48, 64), 64)]
)
def test_images_are_resized_as_before_prediction(before: tuple[int, int], width: int) -> None:
    draw = np.random.default_rng(0)
    rgb = cv2.GaussianBlur(draw.integers(0, 256, (*before, 3), dtype=np.uint8), (0, 0), 2)
    depth = np.float32(draw.uniform(0.6, 0.62, before) + (draw.random(before) < 0.3))
    depth[draw.random(before) < 0.1] = 0
    depth[draw.random(before) < 0.1] = 1000  # where a simulator has nothing
    K = np.array([[0.9 * before[1], 0, 31.5], [0, 0.9 * before[1], 20.2], [0, 0, 1]])
    ours = make_batch(check_images(rgb, depth, K)[0], width, None)
    resize = Resize(before, (ours.rgb.shape[2], ours.rgb.shape[3]))
    color, z, camera = resize(
        torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(K).float()
    )
    assert (color - ours.rgb).abs().max() < 1.01 / 255  # cv2 rounds ties otherwise
    torch.testing.assert_close(z, ours.depth, atol=1e-6, rtol=0)
    torch.testing.assert_close(camera, ours.intrinsics)


def test_a_traced_program_runs_in_torch_alone(estimator: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    graphs = make_graphs(estimator.methods[0], depth.shape[1], depth.shape[0])
    measure = torch.export.load(io.BytesIO(to_program(graphs.measure))).module()
    images = torch.from_numpy(rgb), torch.from_numpy(depth), torch.from_numpy(K).float()
    with torch.no_grad():
        encoding = graphs.encode.network(*images)[:5]
        states = torch.eye(4).repeat(9, 1, 1)
        states[:, 2, 3] = torch.linspace(0.4, 1.2, 9)
        given = (states, torch.tensor(0.02), torch.randn(31, 2), *encoding)
        torch.testing.assert_close(
            measure(*given), graphs.measure.network(*given), atol=1e-3, rtol=1e-4
        )


@pytest.mark.parametrize(
    ("overrides", "named"),
    [
        (["model=cnn_patch"], "estimates no pose"),
        (["model=pose_pf", "variant=paper"], "model/proposals=dense"),
        (["model=patch_pf", "filter/resample=soft"], "filter/resample: Soft"),
        (["model=patch_pf", "filter/estimate=mean"], "choose argmax"),
    ],
)
def test_what_cannot_be_exported_is_named(overrides: list[str], named: str) -> None:
    job = compose_job("train", HOME / "conf", overrides, Path())
    model = posefilter.load("003_cracker_box", device="cpu").object_models[0]
    with pytest.raises(UserError, match=named):
        describe_filter(build_method(recipe(job), model, lightning=False))


def test_mistakes_are_one_line(tmp_path: Path, capfd, monkeypatch) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("kept")
    typed = ["checkpoint=003_cracker_box", "format=onnx"]
    monkeypatch.setattr("posefilter.deploy.write.find_spec", lambda name: object())
    assert run_command("export", HOME, [*typed, f"out={tmp_path / 'full'}"]) == 2
    assert "name a new folder" in capfd.readouterr().err
    monkeypatch.setattr("posefilter.deploy.write.find_spec", lambda name: None)
    assert run_command("export", HOME, [*typed, f"out={tmp_path / 'new'}"]) == 2
    assert "pip install 'posefilter[export]'" in capfd.readouterr().err
    assert run_command("export", HOME, [*typed[:1], "format=tflite", f"out={tmp_path}"]) == 2
    assert "choose weights, onnx, torch" in capfd.readouterr().err
