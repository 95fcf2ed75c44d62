"""All that runs on a GPU keeps its tensors there (tests/simulated_gpu.py); numbers are not
compared.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from tests.simulated_gpu import GPU, simulate_gpu
from tests.smoke.conftest import SMALL_POSE_PF
from tests.smoke.test_comparisons import FEW
from tests.smoke.test_confidence import QUIET, weights, without  # noqa: F401

import posefilter
from posefilter.cli import run_command
from posefilter.cli.job import Job
from posefilter.cli.measure_speed import measure_speed
from posefilter.cli.train import look_once, train
from posefilter.data.module import PoseDataModule
from posefilter.filters.texture import TextureRotations
from posefilter.images import check_images, make_batch
from posefilter.models import evaluation
from posefilter.models.base import PoseEstimator
from posefilter.types import Batch, Trace

HOME = Path(__file__).parents[2]
SCENE = HOME / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0003_0" / "000000.left"
K = np.array([[533.39, 0, 156.24], [0, 533.74, 120.41], [0, 0, 1]])
END_TO_END = ["loss=belief_nll_pose", "model/pose_head=surface_point"]
END_TO_END += ["model/train_rollout=resampled"]
END_TO_END += ["filter/resample@model.train_rollout.resample=optimal_transport"]


@pytest.fixture(scope="module")
def image() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color, depth and intrinsics of a rendered scene."""
    rgb = cv2.imread(f"{SCENE}.jpg")[..., ::-1].copy()
    depth = cv2.imread(f"{SCENE}.depth.png", cv2.IMREAD_UNCHANGED).astype(np.float32) / 10_000
    return rgb, depth, K


# flat print, a shape that any turn about its axis leaves as it is, one that some do
@pytest.mark.parametrize("name", ["003_cracker_box", "007_tuna_fish_can", "061_foam_brick"])
@pytest.mark.slow
def test_an_image_is_searched(name: str, image: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    with simulate_gpu():
        result = posefilter.load(name).predict(*image)
        assert result.pose.shape == (4, 4)
        assert np.isfinite(result.belief.covariance).all()
    if name == "003_cracker_box":
        here = posefilter.load(name).predict(*image)
        assert (result.verdict, here.verdict) == ("found", "found")
        assert np.linalg.norm(result.pose[:3, 3] - here.pose[:3, 3]) < 0.005


def test_a_tracked_can_is_turned(image: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    with simulate_gpu() as gpu:
        method = posefilter.load("007_tuna_fish_can").methods[0]
        batch = make_batch(check_images(*image)[0], None, None)
        encoding = method.encode(Batch(*(one.to(gpu) for one in batch)))
        pose = torch.eye(4, device=gpu)[None].clone()
        pose[:, 2, 3] = 0.8
        turned = TextureRotations().rotate_nearby(pose, encoding, method)
        assert turned is not None
        assert turned.device == gpu


@pytest.mark.slow
def test_instances_and_tracks_are_searched(
    image: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    with simulate_gpu():
        estimator = posefilter.load(["003_cracker_box", "007_tuna_fish_can"])
        assert {one.device for one in estimator.methods} == {GPU}
        found = estimator.predict(*image, instances=2)
        assert [one.object_model.name for one in found] == ["003_cracker_box"]
        tracker = posefilter.Tracker(estimator)
        verdicts = [tracker.update(*image)[0].verdict for _ in range(5)]
    assert verdicts == ["found"] * 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ["model=pose_pf", *SMALL_POSE_PF],
        ["model=pose_pf", "variant=paper"],
        ["model=pose_pf", SMALL_POSE_PF[0], "filter/refine=gradient"],
        ["model=pose_pf", SMALL_POSE_PF[0], "filter/refine=mean_shift_and_resample_move"],
        ["model=pixel_pf"],
        ["model=patch_pf"],
        ["model=patch_pf", "variant=paper"],
        ["model=patch_pf", *END_TO_END],
        ["model=cnn_patch"],
        ["model=downsized", "variant=paper"],
        *([f"model={name}", *few] for name, few in FEW.items()),
    ],
    ids=" ".join,
)
def test_a_method_is_trained_tested_and_drawn(
    words: list[str],
    tiny_job: Callable[..., Job],
    tmp_path: Path,
) -> None:
    job = tiny_job(tmp_path / "run", *words, "trainer.max_steps=2", "logger=tensorboard")
    with simulate_gpu():
        train(job)
    assert (tmp_path / "run" / "metrics.json").is_file()


def test_the_speed_of_a_training_is_measured_there(
    tiny_job: Callable[..., Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices: list[torch.device] = []

    def watch(method: PoseEstimator, data: PoseDataModule) -> None:
        look_once(method, data)
        devices.append(method.device)
        raise InterruptedError

    monkeypatch.setattr("posefilter.cli.measure_speed.look_once", watch)
    job = tiny_job(tmp_path / "run", "model=pixel_pf")
    with simulate_gpu(), pytest.raises(InterruptedError):
        measure_speed(job)
    assert devices == [GPU]


@pytest.mark.slow
def test_probabilities_are_calibrated_and_evaluated(
    weights: Path,  # noqa: F811
    without: Path,  # noqa: F811
    tiny_scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "carton.ckpt"
    data = [f"data.root={tiny_scenes}", "data.min_visibility_test=0"]
    typed = [f"checkpoint={weights}", f"absent={without}", f"out={out}", *data, *QUIET]
    typed += ["data.split={train: 0, val: 1.0, test: 0}", "frames=12", "absent_frames=10"]
    devices: list[torch.device] = []
    judge = evaluation.judge_confidence

    def watch(method: PoseEstimator, trace: Trace, batch: Batch, present: bool) -> Any:
        devices.append(batch.rgb.device)
        return judge(method, trace, batch, present)

    for module in ("posefilter.models.evaluation", "posefilter.cli.evaluate"):
        monkeypatch.setattr(f"{module}.judge_confidence", watch)
    with simulate_gpu():
        assert run_command("calibrate", HOME, typed) == 0
        typed = [f"checkpoint={out}", *data, "data.split={test: 1.0}", *QUIET]
        assert run_command("evaluate", HOME, [*typed, f"out={tmp_path / 'test'}"]) == 0
    assert {*devices} == {GPU}  # also of images without the object, which are judged after the test
