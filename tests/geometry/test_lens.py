"""Images with a lens distortion, and without it again."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.library.test_estimator import FEW, NAME, ONE_MODE, read_scene

import posefilter
from posefilter.cli.arguments import bracketed
from posefilter.cli.command import compose_job, run_command
from posefilter.cli.track import open_videos
from posefilter.data.sequences import FolderVideo
from posefilter.errors import UserError
from posefilter.geometry.lens import undistort
from posefilter.metrics.errors import add

HOME = Path(__file__).parents[2]
ASIDE = ONE_MODE.parent / "scene0002_0"  # the object is where the lens shifts it by millimeters
BROWN = (-0.35, 0.12, 0.001, -0.002, 0.02)
FISHEYE = (-0.05, 0.01, -0.003, 0.001)
K = np.array([[260.0, 0, 163.0], [0, 255.0, 118.0], [0, 0, 1]])


def distort(image: np.ndarray, K: np.ndarray, numbers: tuple[float, ...], mode: int) -> np.ndarray:
    """Return what a camera with a lens distortion sees of what one without sees so."""
    height, width = image.shape[:2]
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    find = cv2.fisheye.undistortPoints if numbers == FISHEYE else cv2.undistortPoints
    at = find(grid.reshape(-1, 1, 2), K, np.array(numbers), R=np.eye(3), P=K)
    maps = at.reshape(height, width, 2).astype(np.float32)
    return cv2.remap(np.ascontiguousarray(image), maps, None, mode)


@pytest.mark.parametrize("numbers", [BROWN, BROWN[:4], (*BROWN, 0.1, 0.0, 0.01), FISHEYE])
def test_a_distortion_is_undone(numbers: tuple[float, ...]) -> None:
    fisheye = numbers == FISHEYE
    v, u = np.mgrid[:240, :320]
    rgb = np.stack([u / 320, v / 240, 0.5 + 0.5 * np.sin(u / 40)], axis=-1).astype(np.float32)
    depth = np.where(u < 160, 0.8, 1.2)
    raw = distort(rgb, K, numbers, cv2.INTER_LINEAR)
    raw_depth = distort(depth, K, numbers, cv2.INTER_NEAREST)
    assert np.abs(raw - rgb)[20:-20, 20:-20].max() > 0.01
    color, z = undistort(raw, raw_depth, K, numbers, fisheye)
    seen = z > 0
    assert seen.mean() > 0.8
    assert (color.dtype, z.dtype, z.shape) == (rgb.dtype, depth.dtype, depth.shape)
    assert np.abs(color - rgb)[30:-30, 30:-30].max() < 0.01
    assert set(np.unique(z[seen])) == {0.8, 1.2}  # no depth between two surfaces
    assert (z != depth)[seen].mean() < 0.01


def test_images_of_another_matrix_are_those_of_that_camera() -> None:
    rgb, depth = np.zeros((240, 320, 3), np.uint8), np.zeros((240, 320))
    rgb[100:120, 200:220], depth[100:120, 200:220] = 255, 1.0
    new = K.copy()
    new[0, 2] -= 30
    color, z = undistort(rgb, depth, K, np.zeros(5), new_intrinsics=new)
    assert (color[100:120, 170:190] == 255).all()
    assert z[100:120, 170:190].min() == 1.0


def test_a_pose_from_a_raw_image_is_that_of_the_rectified_one() -> None:
    rgb, depth, K = read_scene(0, ASIDE)
    numbers = (-0.4, 0.1, 0.0, 0.0, 0.0)
    raw = distort(rgb, K, numbers, cv2.INTER_LINEAR)
    raw_depth = distort(depth, K, numbers, cv2.INTER_NEAREST)
    estimator = posefilter.load(NAME, device="cpu")
    straight = estimator.predict(rgb, depth, K)
    rectified = estimator.predict(*posefilter.undistort(raw, raw_depth, K, numbers), K)
    points = straight.object_model.points.double()
    poses = [
        np.asarray(one.pose)[None] for one in (rectified, estimator.predict(raw, raw_depth, K))
    ]
    off = [
        float(add(torch.from_numpy(one), torch.from_numpy(straight.pose)[None], points))
        for one in poses
    ]
    assert off[0] < 0.005
    assert off[1] > 2 * off[0]


def test_files_are_rectified_by_commands(tmp_path: Path) -> None:
    rgb, depth, K = read_scene(0, ONE_MODE)
    numbers = (-0.4, 0.1, 0.0, 0.0, 0.0)
    millimeters = (1000 * depth).astype(np.uint16)
    for name, image in (("rgb", rgb[..., ::-1]), ("depth", millimeters)):
        (tmp_path / name).mkdir()
        assert cv2.imwrite(str(tmp_path / name / "0.png"), image)
    given = posefilter.undistort(rgb, (millimeters / 1000.0).astype(np.float32), K, numbers)
    wanted = posefilter.load(NAME, overrides=FEW, device="cpu").predict(*given, K)
    typed = [f"rgb={tmp_path / 'rgb/0.png'}", f"depth={tmp_path / 'depth/0.png'}", *FEW]
    typed += [f"checkpoint={NAME}", "depth_scale=1000", f"out={tmp_path / 'out'}"]
    typed.append(f"intrinsics={K[0, 0]},{K[1, 1]},{K[0, 2]},{K[1, 2]}")
    lens = f"distortion={','.join(map(str, numbers))}"
    assert run_command("predict", arguments=[*typed, lens]) < 2
    told = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert np.allclose(told["camera_from_object"], wanted.pose, atol=1e-6)
    assert run_command("predict", arguments=[*typed, "distortion=0.1,0.2"]) == 2

    several = [f"checkpoint=[{NAME},025_mug]", f"out={tmp_path / 'several'}"]
    assert run_command("predict", arguments=[*typed, lens, *several]) < 2
    first, _ = json.loads((tmp_path / "several" / "poses.json").read_text())
    assert np.allclose(first["camera_from_object"], wanted.pose, atol=1e-6)

    (frame,) = FolderVideo(tmp_path, K, 1000.0, distortion=numbers)
    assert np.array_equal(frame.rgb, given[0])
    assert np.array_equal(frame.depth, given[1])


@pytest.mark.parametrize(
    ("numbers", "fisheye", "said"),
    [
        ((0.1, 0.2, 0.3), False, "expected 4 or 5 or 8"),
        ((0.1,) * 5, True, "k1 to k4"),
        ((0.1, 0.2, 0.3, float("nan")), False, "finite"),
        (("a", "b", "c", "d"), False, "no numbers"),
    ],
)
def test_wrong_coefficients_are_refused(numbers: tuple, fisheye: bool, said: str) -> None:
    with pytest.raises(UserError, match=said):
        undistort(np.zeros((4, 4, 3)), np.zeros((4, 4)), K, numbers, fisheye)


def test_images_that_cannot_be_resampled_are_refused() -> None:
    rgb, depth = np.zeros((4, 5, 3), np.uint8), np.zeros((4, 5), np.float32)
    with pytest.raises(UserError, match="camera matrix"):
        undistort(rgb, depth, K[0], BROWN)
    with pytest.raises(UserError, match="depth: expected an array of NumPy, not NoneType"):
        undistort(rgb, None, K, BROWN)  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"not \(H, W, 3\)"):
        undistort(np.moveaxis(rgb, -1, 0), depth, K, BROWN)
    for wrong in (np.transpose(K), np.zeros((3, 3))):  # zeros: ROS, of a camera without calibration
        for matrices in ((wrong, BROWN), (K, BROWN, False, wrong)):
            with pytest.raises(UserError, match=r"^intrinsics: are no camera matrix"):
                undistort(rgb, depth, *matrices)
    with pytest.raises(UserError, match="but rgb"):
        undistort(rgb, depth[:3], K, BROWN)
    with pytest.raises(UserError, match="expected one image"):
        undistort(rgb[None], depth[None], K, BROWN)
    with pytest.raises(UserError, match="float16"):
        undistort(rgb, depth.astype(np.float16), K, BROWN)


def test_masked_depth_stays_unknown() -> None:
    depth = np.ma.masked_greater(np.where(np.eye(40) > 0, 9.0, 0.7), 5)
    z = undistort(np.zeros((40, 40, 3), np.uint8), depth, np.diag([40.0, 40, 1]), [0.0] * 5)[1]
    assert set(np.unique(z)) == {0, 0.7}


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_what_no_pixel_shows_is_empty(count: int) -> None:
    rgb, depth = np.full((240, 320, 3), 200, np.uint8), np.full((240, 320), 0.7, np.float32)
    color, z = undistort(rgb, depth, K, (0.4, 0.1, 0, 0, *[0.0] * 10)[:count])
    assert z[0, 0] == z[-1, -1] == 0  # a pincushion, whose corners the image does not hold
    assert not color[0, 0].any()
    assert z[120, 160] == np.float32(0.7)


def test_a_video_of_a_folder_is_rectified_by_the_command(tmp_path: Path, capfd) -> None:
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
        image = np.full((240, 320), *((900, np.uint16) if name == "depth" else (90, np.uint8)))
        assert cv2.imwrite(str(tmp_path / name / "0.png"), image)
    typed = [f"frames={tmp_path}", "intrinsics=260,255,163,118", "depth_scale=1000"]
    lens = "distortion=0.4,0.1,0,0"
    found = []
    for words in (typed, [*typed, lens]):
        cfg = compose_job("track", HOME / "conf", bracketed(words), tmp_path).cfg
        ((video,), _) = open_videos(cfg, ["box"])
        found.append(next(iter(video)).depth[0, 0])
    assert found == [np.float32(0.9), 0]
    typed = [f"checkpoint={NAME}", "data=ycb_video", f"data.root={tmp_path}", lens]
    assert run_command("track", HOME, [*typed, f"out={tmp_path / 'out'}"]) == 2
    assert "only valid with frames=DIR" in capfd.readouterr().err
