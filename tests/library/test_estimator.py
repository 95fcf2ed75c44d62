"""The library answers as the command does, on the weights and scenes that ship."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

import posefilter
from posefilter import devices
from posefilter.cli.command import run_command
from posefilter.confidence.scale_ratio import ScaleRatio
from posefilter.images import check_images
from posefilter.metrics.bop_results import read_poses_csv
from posefilter.result import collect_results

HOME = Path(__file__).parents[2]
SCENE = HOME / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0000_0"
ONE_MODE = SCENE.parent / "scene0003_0"  # random numbers do not choose between two
NAME = "003_cracker_box"
FEW = ["filter.particles=40", "filter.initial_particles=60", "filter.steps=3", "filter/refine=none"]


def read_scene(number: int = 0, scene: Path = SCENE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color (H, W, 3) uint8, depth (H, W) [m] and K (3, 3) of a scene that ships."""
    stem = sorted(scene.glob("*.left.jpg"))[number].name.removesuffix(".left.jpg")
    rgb = cv2.imread(str(scene / f"{stem}.left.jpg"))[..., ::-1]
    depth = cv2.imread(str(scene / f"{stem}.left.depth.png"), cv2.IMREAD_UNCHANGED) / 10000
    (camera,) = json.loads((scene / "_camera_settings.json").read_text())["camera_settings"][:1]
    own = camera["intrinsic_settings"]
    K = np.array([[own["fx"], 0, own["cx"]], [0, own["fy"], own["cy"]], [0, 0, 1]])
    return rgb, depth, K


@pytest.fixture(scope="module")
def estimator() -> posefilter.Estimator:
    """Return the filter that ships, as it ships."""
    return posefilter.load(NAME, device="cpu")


@pytest.fixture(scope="module")
def small() -> posefilter.Estimator:
    """Return it with few particles, for what does not depend on its being right."""
    return posefilter.load(NAME, overrides=FEW, device="cpu")


def test_an_answer_is_that_of_the_command(estimator: posefilter.Estimator, tmp_path: Path) -> None:
    rgb, depth, K = read_scene()
    result = estimator.predict(rgb, depth, K)
    stem = SCENE / sorted(SCENE.glob("*.left.jpg"))[0].name.removesuffix(".left.jpg")
    numbers = f"{K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}"
    typed = [
        f"checkpoint={NAME}",
        f"rgb={stem}.left.jpg",
        f"depth={stem}.left.depth.png",
        f"intrinsics={numbers}",
        "depth_scale=10000",
        f"out={tmp_path}",
        "console=json",
    ]
    assert run_command("predict", arguments=typed) == 0
    told = json.loads((tmp_path / "pose.json").read_text())
    assert told["camera_from_object"] == result.pose.tolist()
    assert told["score"] == result.score
    assert told["object"] == result.object == NAME
    assert told["probability"] == result.probability
    assert told["verdict"] == result.verdict
    assert result.verdict in (None, "found")
    assert result.object_model is estimator.object_models[0]
    assert 0 < result.depth_inlier_fraction < 0.6  # half of its surface faces away
    assert (result.model, result.surface) == (result.object_model, result.depth_inlier_fraction)
    assert estimator.models == estimator.object_models  # by their earlier names
    own = result.belief
    assert told["belief"]["weight_entropy"] == pytest.approx(own.weight_entropy)
    assert told["belief"]["differential_entropy"] == pytest.approx(own.differential_entropy)
    assert told["belief"]["entropy"] == told["belief"]["weight_entropy"]  # the earlier name stays
    assert np.allclose(told["belief"]["covariance"], own.covariance)
    assert np.allclose(told["belief"]["error_covariance"], result.covariance)
    assert told["belief_file"] == str(tmp_path / "belief.npz")
    assert told["score_is"] == estimator.methods[0].filter.score_is
    assert told["warnings"] == [] == list(result.warnings)
    sure = told["belief"]["uncertainty"]
    assert sure["translation_mm"] == 1000 * result.belief.uncertainty().translation
    assert sure["rotation_deg"] == np.rad2deg(result.belief.uncertainty().rotation)
    assert sure["shift_mm"] == sure["translation_mm"]  # earlier names stay
    assert sure["turn_degrees"] == sure["rotation_deg"]
    again = posefilter.Belief.load(tmp_path / "belief.npz")
    assert np.allclose(again.samples, result.belief.samples, atol=1e-6)
    assert sum(mode["mass"] for mode in told["belief"]["modes"]) == pytest.approx(1)


def test_several_checkpoints_give_one_list_and_one_overlay(
    small: posefilter.Estimator, tmp_path: Path
) -> None:
    rgb, depth, K = read_scene()
    stem = SCENE / sorted(SCENE.glob("*.left.jpg"))[0].name.removesuffix(".left.jpg")
    typed = [
        f"checkpoint=[{NAME},025_mug]",
        f"rgb={stem}.left.jpg",
        f"depth={stem}.left.depth.png",
        f"intrinsics={K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}",
        f"out={tmp_path}",
        "console=json",
        *FEW,
    ]
    assert run_command("predict", arguments=typed) == 0
    told = json.loads((tmp_path / "poses.json").read_text())
    assert [one["object"] for one in told] == [NAME, "025_mug"]
    alone = small.predict(rgb, depth, K)  # what it is asked beside changes no answer
    assert told[0]["camera_from_object"] == alone.pose.tolist()
    assert told[0]["score"] == alone.score
    for one in told:
        kept = posefilter.Belief.load(Path(one["belief_file"]))
        assert kept.object == one["object"]
    picture = cv2.imread(str(tmp_path / "overlay.png"))
    height, width = rgb.shape[0] * max(640, rgb.shape[1]) // rgb.shape[1], picture.shape[1]
    assert picture.shape[0] > height  # the legend
    plain = cv2.resize(rgb[..., ::-1], (width, height), interpolation=cv2.INTER_CUBIC)
    assert (np.abs(picture[:height].astype(int) - plain).max(-1) > 60).mean() > 0.002
    assert run_command("predict", arguments=[*typed, "save_rerun=true"]) == 2
    assert not (tmp_path / "pose.json").exists()


def test_instances_are_listed_once_each_and_absent_ones_are_named(
    estimator: posefilter.Estimator, tmp_path: Path
) -> None:
    rgb, depth, K = read_scene(scene=ONE_MODE)
    stem = ONE_MODE / sorted(ONE_MODE.glob("*.left.jpg"))[0].name.removesuffix(".left.jpg")
    typed = [
        f"checkpoint=[{NAME},025_mug]",
        f"rgb={stem}.left.jpg",
        f"depth={stem}.left.depth.png",
        f"intrinsics={K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}",
        "instances=2",
        f"out={tmp_path}",
        "console=json",
    ]
    assert run_command("predict", arguments=typed) == 0
    told = json.loads((tmp_path / "poses.json").read_text())
    rows = read_poses_csv(tmp_path / "poses.csv")
    alone = estimator.predict(rgb, depth, K)
    # the one that is there, where the whole filter finds it; the rest is less probable
    assert told[0]["object"] == NAME
    assert told[0]["verdict"] == "found"
    found = np.array(told[0]["camera_from_object"])
    assert np.linalg.norm(found[:3, 3] - alone.pose[:3, 3]) < 0.01
    assert [one["verdict"] for one in told].count("found") == 1
    assert {one["object"] for one in told} == {NAME, "025_mug"}
    assert len(rows) == sum(one["camera_from_object"] is not None for one in told)
    assert rows[0].obj_id == 2  # of YCB-Video's classes
    assert np.allclose(rows[0].camera_from_native, found)
    assert len({tuple(one) for one in told}) == 1  # of all entries, also where nothing is found
    assert told[0]["costs"] == told[-1]["costs"]
    for one in told:
        if one["camera_from_object"] is not None:
            assert one["visible_pixels"] > 0
            assert Path(one["belief_file"]).is_file()


def test_the_box_is_where_it_was_rendered(estimator: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    # one run of three may follow another mode; which one depends on the processor's rounding
    results = [estimator.predict(rgb, depth, K, seed=seed) for seed in range(3)]
    notes = json.loads(sorted(SCENE.glob("*.left.json"))[0].read_text())
    truth = np.array(notes["objects"][0]["cuboid_centroid"]) / 100
    masses = []
    for result in results:
        belief = result.belief
        found = result.pose[:3, :3] @ belief.center + result.pose[:3, 3]
        assert np.linalg.norm(found - truth) < 0.02
        assert np.sqrt(np.diag(result.covariance))[:3].max() < 0.02
        centers = belief.samples[:, :3, :3] @ belief.center + belief.samples[:, :3, 3]
        near = np.linalg.norm(centers - found, axis=-1) < 0.03
        turns = np.einsum("nij,ij->n", belief.samples[:, :3, :3], result.pose[:3, :3])
        alike = (turns - 1) / 2 > np.cos(np.radians(25))
        masses.append(belief.weights[near & alike].sum())
    assert np.median(masses) > 0.9  # in one mode or two that touch


def test_a_wrong_depth_scale_is_reported(estimator: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    # others may follow, about the size of what is found there
    warnings = estimator.predict(rgb, 10 * depth, K).warnings
    assert "median depth" in warnings[0]
    assert all("depth_scale" in warning for warning in warnings)


def test_a_depth_that_is_a_fourth_too_large_is_measured_and_not_believed(
    estimator: posefilter.Estimator,
) -> None:
    """The likelihood does not notice: its pose is as much too far away as the depth."""
    rgb, depth, K = read_scene(0, ONE_MODE)
    right, large = estimator.predict(rgb, depth, K), estimator.predict(rgb, 1.25 * depth, K)
    assert right.scale_ratio == pytest.approx(1.0, abs=0.08)
    assert not right.wrong_size
    assert large.scale_ratio == pytest.approx(1.25, abs=0.08)
    assert large.wrong_size
    assert large.probability is not None
    assert large.verdict == "unsure"
    assert f"appears {large.scale_ratio:.2f} times" in large.describe()
    (warning,) = large.warnings
    assert "depth_scale" in warning
    assert "intrinsics" in warning


def test_objects_of_one_image_are_measured_together(estimator: posefilter.Estimator) -> None:
    """Of two that appear a fifth too large, and neither certainly, both are doubted."""
    rgb, depth, K = read_scene(0, ONE_MODE)
    (run,) = estimator.run(check_images(rgb, depth, K)[0])
    assert run.size is not None
    doubtful = run._replace(size=ScaleRatio(*torch.tensor([[1.2], [5.0], [0.9]])))
    (alone,), together = collect_results([doubtful])[0], collect_results([doubtful, doubtful])[0]
    assert (alone.verdict, alone.wrong_size) == ("found", False)
    assert [(one.verdict, one.wrong_size) for one in together] == 2 * [("unsure", True)]
    right = [one.wrong_size for one in collect_results([doubtful, run])[0]]
    assert right == [False, False]


def test_instances_of_a_wrong_size_are_not_believed(estimator: posefilter.Estimator) -> None:
    """Each is measured by itself: a second box, a fourth farther away, is of its own size."""
    rgb, depth, K = read_scene(0, ONE_MODE)
    (right,) = estimator.predict(rgb, depth, K, instances=1)
    assert right.scale_ratio == pytest.approx(1.0, abs=0.08)
    assert right.verdict == "found"
    below = np.concatenate([rgb, rgb]), np.concatenate([depth, 1.25 * depth])
    found = {
        bool(one.mask[: len(rgb)].any()): one for one in estimator.predict(*below, K, instances=2)
    }
    assert found[True].scale_ratio == pytest.approx(1.0, abs=0.08)
    assert (found[True].verdict, found[True].wrong_size) == ("found", False)
    assert found[False].scale_ratio == pytest.approx(1.25, abs=0.08)
    assert found[False].wrong_size
    assert found[False].verdict == "unsure"
    assert "depth_scale" in found[False].warnings[-1]


@pytest.mark.slow
def test_an_image_of_one_color_or_depth_is_doubted(estimator: posefilter.Estimator) -> None:
    """A black one is answered from the depth alone, with a presence that nothing supports; in one
    of one depth nothing of the box is left, and yet it is not absent.
    """
    rgb, depth, K = read_scene(0, ONE_MODE)
    images = np.stack([rgb, 0 * rgb, rgb[:, ::-1]])  # of one depth: with its print mirrored
    depths = np.stack([depth, depth, 0 * depth + 0.7])
    plain, black, flat = estimator.predict(images, depths, K)
    assert (plain.verdict, plain.blank, plain.warnings) == ("found", "", ())
    assert black.presence > 0.5
    assert flat.presence < 0.2
    for result, cause in ((black, "covered lens"), (flat, "right file")):
        assert result.verdict == "unsure"
        assert cause in result.blank == result.warnings[0]
    (found,) = estimator.predict(0 * rgb, depth, K, instances=1)
    assert found.verdict == "unsure"
    assert found.mask.shape == depth.shape
    assert not found.mask.any()
    assert found.conformal is None
    ((covered,), seen) = estimator.predict(
        images[1:], np.stack([depth[::-1], depth]), K, instances=2
    )
    assert covered.verdict == "unsure"
    assert "covered lens" in covered.blank
    assert all(one.blank == "" for one in seen)


def test_the_belief_of_an_instance_is_as_wide_as_errors_are(
    estimator: posefilter.Estimator,
) -> None:
    images = read_scene(0, ONE_MODE)
    one, (instance,) = estimator.predict(*images), estimator.predict(*images, instances=1)
    assert instance.belief_calibrated
    sure, as_instance = one.belief.uncertainty(), instance.belief.uncertainty()
    assert 0.7 < as_instance.translation / sure.translation < 1.4  # the particles' is 1.7 times it


def test_instances_have_the_calibration_of_their_own_object(
    estimator: posefilter.Estimator,
) -> None:
    images = read_scene(0, ONE_MODE)
    (alone,) = estimator.predict(*images, instances=1)
    other = posefilter.load("025_mug", device="cpu")
    both = posefilter.Estimator([*other.methods, *estimator.methods], "cpu")
    (found,) = [one for one in both.predict(*images, instances=1) if one.object == NAME]
    assert found.probability == pytest.approx(alone.probability, abs=1e-6)
    assert np.allclose(found.belief.samples, alone.belief.samples, atol=1e-6)


def test_tensors_and_floats_are_the_same_image(small: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    arrays = small.predict(rgb, depth, K)
    tensors = small.predict(
        torch.from_numpy(rgb.copy()).permute(2, 0, 1),
        torch.from_numpy(depth).float()[None][0],
        torch.from_numpy(K),
    )
    floats = small.predict(rgb.astype(np.float32) / 255, np.where(depth > 0, depth, np.nan), K)
    assert np.array_equal(arrays.pose, tensors.pose)
    assert np.allclose(arrays.pose, floats.pose, atol=1e-3)
    assert not np.array_equal(arrays.pose, small.predict(rgb, depth, K, seed=1).pose)
    assert np.array_equal(arrays.pose, small.predict(rgb, depth, K, seed=0).pose)


def test_batches_and_several_objects_nest(small: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    both = posefilter.Estimator([*small.methods, *small.methods], "cpu")
    one = small.predict(rgb, depth, K)
    pair = both.predict(rgb, depth, K)
    batch = small.predict(np.stack([rgb, rgb]), np.stack([depth, depth]), K)
    grid = both.predict(np.stack([rgb, rgb]), np.stack([depth, depth]), np.stack([K, K]))
    assert both.objects == (NAME, NAME)
    assert np.array_equal(pair[0].pose, one.pose)
    assert np.array_equal(pair[1].pose, one.pose)
    assert [type(each) for each in batch] == [posefilter.Result, posefilter.Result]
    assert [[type(each) for each in row] for row in grid] == 2 * [2 * [posefilter.Result]]
    assert len(small.predict_batch(rgb, depth, K)[0]) == 1


def test_pictures(small: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    result = small.predict(rgb, depth, K)
    drawn = result.draw_overlay(rgb, K)
    assert drawn.dtype == np.uint8
    assert drawn.shape[1] >= rgb.shape[1]
    picture = result.draw_belief(rgb, K)
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
    calibrated = replace(result, belief=replace(result.belief, draws=len(result.belief.weights)))
    assert not np.array_equal(calibrated.draw_belief(rgb, K), picture)  # its draws are one mode
    band = result.draw_band(rgb, K, level=0.5)
    assert band.shape[1] == drawn.shape[1]
    assert len(np.unique(band.reshape(-1, 3), axis=0)) > 100
    with pytest.raises(posefilter.UserError, match="the level is between 0 and 1"):
        result.draw_band(rgb, K, level=1.5)
    assert posefilter.figures.draw_overlay is not None


def test_pictures_take_the_images_that_predict_takes(small: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene()
    result = small.predict(rgb, depth, K)
    tensor, matrix = torch.from_numpy(rgb.copy()).permute(2, 0, 1), torch.from_numpy(K)
    for draw in (
        result.draw_overlay,
        result.draw_belief,
        result.draw_band,
        lambda image, camera: posefilter.figures.draw_overlay(
            image, camera, torch.from_numpy(result.pose), result.object_model.hull
        ),
        lambda image, camera: posefilter.figures.draw_belief(
            image, camera, result.belief, result.object_model
        ),
    ):
        plain = draw(rgb, K)
        for image in (tensor, tensor.float() / 255, (rgb / 255).astype(np.float64)):
            assert np.array_equal(draw(image, matrix), plain)
        with pytest.raises(posefilter.UserError, match=r"rgb: .* expected one image"):
            draw(rgb[None], K)
        with pytest.raises(posefilter.UserError, match="rgb: is int64"):
            draw(rgb.astype(np.int64), K)
        with pytest.raises(posefilter.UserError, match="a camera matrix"):
            draw(rgb, K[:2])
    with pytest.raises(posefilter.UserError, match=r"pose: .* \(4, 4\)"):
        posefilter.figures.draw_overlay(rgb, K, result.pose[:3], result.object_model.hull)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"depth": np.ones((4, 5))}, "depth: has shape"),
        ({"depth": np.full((240, 320), 700, np.uint16)}, "1000 where it is in millimeters"),
        ({"depth": np.full((240, 320), 700.0)}, "is it in meters"),
        ({"depth": np.zeros((240, 320))}, "no pixel has depth"),
        ({"rgb": np.ones((240, 320))}, "rgb: has shape"),
        ({"rgb": np.full((240, 320, 3), 255.0)}, "rgb: floats should lie in"),
        ({"rgb": np.full((240, 320, 3), 1.002)}, r"not in \[1.002, 1.002\]; numpy.clip"),
        ({"rgb": np.ones((240, 320, 3), np.int64)}, "expected uint8"),
        ({"intrinsics": np.ones(4)}, r"camera matrix .*: of fx, fy, cx, cy give \[\["),
        ({"intrinsics": np.ones((3, 4))}, r"of a projection matrix P .* give P\[:, :3\]"),
        ({"intrinsics": np.ones(9)}, r"give it as K\.reshape\(3, 3\)"),
        ({"intrinsics": np.array([[300.0, 0, 0], [0, 300, 0], [160, 120, 1]])}, "transposed"),
        ({"intrinsics": np.diag([300.0, 0, 1])}, "fy 0"),
        ({"intrinsics": np.diag([300.0, 300, 1])}, "principal point .* left out"),
        ({"intrinsics": np.array([[300.0, 0, 0.5], [0, 300, 0.5], [0, 0, 1]])}, "units of the"),
        ({"intrinsics": np.array([[300.0, 0, 160], [0, 300, -500], [0, 0, 1]])}, "swapped"),
    ],
)
def test_wrong_images_are_refused_in_one_line(change: dict[str, np.ndarray], told: str) -> None:
    right = dict(zip(("rgb", "depth", "intrinsics"), read_scene(), strict=True))
    with pytest.raises(posefilter.UserError, match=told) as caught:
        check_images(**(right | change))
    assert "\n" not in str(caught.value)


def test_a_principal_point_far_from_the_middle_is_told(estimator: posefilter.Estimator) -> None:
    rgb, depth, K = read_scene(0, ONE_MODE)
    result = estimator.predict(rgb, depth, K)
    assert not any("principal point" in warning for warning in result.warnings)
    K[:2, 2] = 4.0
    off = estimator.predict(rgb, depth, K)
    assert any("principal point is far from the middle" in warning for warning in off.warnings)
    assert len(repr(result)) < 160
    assert result.describe() in repr(result)


def test_what_cannot_be_loaded_is_refused_in_one_line(tmp_path: Path) -> None:
    for what, told in (
        (tmp_path / "none.ckpt", "no such file, and no weights of that name"),
        ("004_suger_box", "did you mean 004_sugar_box"),
        ("Cracker_box", "did you mean 003_cracker_box"),
        ([], "one object at least"),
    ):
        with pytest.raises(posefilter.UserError, match=told):
            posefilter.load(what)
    with pytest.raises(posefilter.UserError, match="did you mean 'particles'"):
        posefilter.load(NAME, overrides=["filter.particle=3"])
    with pytest.raises(posefilter.UserError, match="there is no such choice"):
        posefilter.load(NAME, overrides=["filter/refine=nothing"])


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("seed=3", "'seed=3' changes nothing of a trained filter: give predict seed="),
        ("++cost_miss=2", "give load costs="),
        ("data.image_width=64", "begins with filter or model"),
        ("filters.particles=3", "begins with filter or model"),
    ],
)
def test_an_override_without_an_effect_is_refused(override: str, told: str) -> None:
    with pytest.raises(posefilter.UserError, match=re.escape(told)):
        posefilter.load(NAME, overrides=[override])


def test_overrides_are_a_list() -> None:
    with pytest.raises(posefilter.UserError, match="must be a list"):
        posefilter.load(NAME, overrides="filter.particles=3")
    for wrong in (None, {"filter.particles": 3}, 3, [3]):
        with pytest.raises(posefilter.UserError, match="must be a list, such as"):
            posefilter.load(NAME, overrides=wrong)


def test_a_configuration_is_composed_and_built() -> None:
    config = posefilter.compose(["model=patch_pf", "filter.particles=7", "console=json"])
    method = posefilter.build(config)
    assert type(method).__name__ == "PatchPF"
    assert method.filter.particles == 7
    data = posefilter.build_data(config)
    assert type(data).__name__ == "PoseDataModule"
    with pytest.raises(posefilter.UserError, match=r"did you mean 'filter\.particles'"):
        posefilter.compose(["filter.particels=7"])
    with pytest.raises(posefilter.UserError, match="choose train"):
        posefilter.compose(command="trian")


def test_import_takes_neither_torch_nor_hydra_and_every_public_name_is_there() -> None:
    program = (
        "import sys, posefilter; "
        "heavy = {'torch', 'numpy', 'hydra', 'omegaconf', 'lightning', 'cv2'} & set(sys.modules); "
        "assert not heavy, heavy; "
        "missing = [n for n in dir(posefilter) if not hasattr(posefilter, n)]; "
        "assert not missing and dir(posefilter), missing"
    )
    own = {**os.environ, "PYTHONPATH": str(HOME / "src")}
    subprocess.run([sys.executable, "-c", program], check=True, env=own)


def test_an_answer_needs_no_training_framework() -> None:
    """They take seconds to import, and a first answer should not wait for them."""
    code = (
        "import sys, numpy as np, posefilter; "
        "estimator = posefilter.load('003_cracker_box', overrides=['filter.particles=4']); "
        "depth = np.full((60, 80), 0.8, np.float32); "
        "K = np.array([[70.0, 0, 40], [0, 70, 30], [0, 0, 1]]); "
        "estimator.predict(np.zeros((60, 80, 3), np.uint8), depth, K); "
        "heavy = {'lightning', 'torchmetrics', 'matplotlib', 'tensorboard', 'sympy'}; "
        "sys.exit(' '.join(heavy & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_public_name_is_documented() -> None:
    for name in posefilter.__all__:
        thing = getattr(posefilter, name)
        assert isinstance(thing, str) or len(thing.__doc__ or "") > 40, name
    for name in ("load", "load_method", "compose", "build"):
        assert "Raises:" in getattr(posefilter, name).__doc__


def test_what_is_typed_first_is_answered_or_refused_in_one_line(
    small: posefilter.Estimator, tmp_path: Path
) -> None:
    rgb, depth, K = read_scene()
    for wrong, told in (
        (lambda: small.predict("a.png", depth, K), "rgb: is 'a.png'; must be an array"),
        (lambda: small.predict(rgb, None, K), "depth: is None"),
        (lambda: small.predict(rgb[None][:0], depth[None][:0], K), "rgb: is a batch of no images"),
        (lambda: posefilter.load(3), "checkpoint=3: must be a name"),  # type: ignore[arg-type]
        (
            lambda: posefilter.load(NAME, costs={"miss": 2}),
            "costs={'miss': 2}: expected posefilter.Costs",
        ),
        (
            lambda: posefilter.Tracker(small, {"patience": 3}),
            "settings={'patience': 3}: expected posefilt",
        ),
        (
            lambda: posefilter.figures.draw_poses(rgb, K, np.eye(4), NAME),
            "shape: is str; expected a mesh",
        ),
    ):
        with pytest.raises(posefilter.UserError, match=re.escape(told)):
            wrong()
    result = small.predict(rgb, depth, K, seed=np.int64(3))
    assert np.array_equal(result.pose, small.predict(rgb, depth, K, seed=3).pose)
    assert repr(small) == f"Estimator({NAME}; cpu)"
    assert repr(result.belief).startswith(f"Belief({NAME}: 40 particles within ")
    drawn = posefilter.figures.draw_poses(rgb, K, result.pose, result.object_model.hull)
    posefilter.figures.save_image(drawn, str(tmp_path / "new" / "drawn.png"))
    assert np.array_equal(cv2.imread(str(tmp_path / "new" / "drawn.png"))[..., ::-1], drawn)


@pytest.mark.parametrize("seed", ["a", None, 1.5, -1, True])
def test_what_is_no_seed_is_refused_in_one_line(small: posefilter.Estimator, seed: object) -> None:
    with pytest.raises(posefilter.UserError, match=r"^seed=.*: must be a whole number"):
        small.predict(*read_scene(), seed=seed)  # type: ignore[arg-type]
    with pytest.raises(posefilter.UserError, match=r"^seed=.*: must be a whole number"):
        posefilter.Tracker(small, seed=seed)  # type: ignore[arg-type]


def test_fewer_looks_keep_the_calibration() -> None:
    rgb, depth, K = read_scene()
    once = posefilter.load("003_cracker_box", overrides=["filter.max_searches=1"], device="cpu")
    result = once.predict(rgb, depth, K)
    assert once.methods[0].filter.max_searches == 1
    assert result.probability is not None
    assert 0 <= result.probability <= result.presence
    assert once.methods[0].calibration is not None
    assert once.methods[0].filter.magnified_width == 0.4  # of the file
    for other in (
        "filter.max_searches=4",
        "filter.magnified_width=null",
        "filter.magnified_width=0.3",
    ):
        changed = posefilter.load("003_cracker_box", overrides=[other], device="cpu").methods[0]
        assert changed.calibration is None
        assert "calibrated for another filter" in changed.calibration_note
    with pytest.raises(posefilter.UserError, match=r"filter\.max_searches=5: must be 1, 2, 3 or 4"):
        posefilter.load("003_cracker_box", overrides=["filter.max_searches=5"], device="cpu")


def test_a_fork_that_would_wait_for_threads_is_told(
    estimator: posefilter.Estimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(devices, "_owner", None)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    devices.take_threads()
    devices.take_threads()
    monkeypatch.setattr(devices.os, "getpid", lambda: -1)  # as in another process
    images = read_scene()
    tracker = posefilter.Tracker(estimator)
    for compute in (
        lambda: posefilter.load(NAME),
        lambda: estimator.predict(*images),
        lambda: estimator.predict(*images, instances=2),
        lambda: tracker.update(*images),
    ):
        with pytest.raises(posefilter.UserError, match="get_context\\('spawn'\\)"):
            compute()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    devices.take_threads()
