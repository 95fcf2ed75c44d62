"""The file of tracks holds frames and objects, read back; what is lost is not shown."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from rrd_files import read_back

from posefilter.errors import UserError
from posefilter.figures.track_recording import Seen, TrackRecorder
from posefilter.figures.view_data import make_cloud
from posefilter.meshes.builtin import catalog as builtin

H, W = 24, 32
K = np.array([[40.0, 0, 15.5], [0, 40, 11.5], [0, 0, 1]])
RGB = np.random.default_rng(0).integers(0, 256, (H, W, 3), np.uint8)
DEPTH = np.full((H, W), 0.8, np.float32)
SMOOTH = cv2.resize(RGB[:3, :4], (W, H), interpolation=cv2.INTER_CUBIC)
CENTER = np.array([0.01, 0.0, 0.1])
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="the optional extra [viz] is not installed"
)


def pose_at(x: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    pose[:3, 3] = x, 0.02, 0.7
    return pose


def test_points_of_the_cloud_project_onto_the_pixels_that_they_are_of() -> None:
    depth = DEPTH.copy()
    depth[:, :16] = 0
    depth[4, 20] = np.nan
    points, colors, footprints = make_cloud(RGB, depth, K, every=4)
    pixels = points @ K.T
    column, row = (pixels[:, :2] / pixels[:, 2:]).T.round().astype(int)
    assert len(points) == 4 * 6 - 1
    assert column.min() == 16
    assert (colors == RGB[row, column]).all()
    assert np.allclose(points[:, 2], 0.8)
    assert np.allclose(footprints, 4 * 0.8 / 40)


def test_without_a_path_nothing_is_written(tmp_path: Path) -> None:
    with TrackRecorder(None, {}) as recorder:
        recorder.add(RGB, DEPTH, K, [Seen("box", pose_at(0), CENTER, 0.9)])
    assert not list(tmp_path.iterdir())


def test_without_the_library_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="rerun-sdk is missing"):
        TrackRecorder(tmp_path / "view.rrd", {})


@needs_rerun
def test_objects_are_where_the_tracks_put_them_and_gone_while_they_are_lost(tmp_path: Path) -> None:
    mesh = builtin.build("carton")
    poses = [pose_at(0.0), pose_at(0.01), None, None, pose_at(0.3)]
    with TrackRecorder(tmp_path / "view.rrd", {"box": mesh}) as recorder:
        for number, pose in enumerate(poses):
            presence = float("nan") if number == 3 else 0.9 - 0.1 * number
            recorder.add(SMOOTH, DEPTH, K, [Seen("box", pose, CENTER, presence)])
    found = read_back(tmp_path / "view.rrd", "frame")
    box = found["/objects/box"]
    assert set(box["Transform3D:translation"]) == {0, 1, 4}
    for number, pose in enumerate(poses):
        if pose is not None:
            at = box["Transform3D:translation"][number][0]
            assert np.allclose(at, pose[:3, 3], atol=1e-6)
            turn = box["Transform3D:mat3x3"][number].reshape(3, 3).T
            assert np.allclose(turn, pose[:3, :3], atol=1e-6)
    assert set(box["Mesh3D:vertex_positions"]) == {0, 4}  # once, and anew after the loss
    assert set(box["Clear:is_recursive"]) == {2}
    (line,) = found["/trails/box"]["LineStrips3D:strips"][1]
    assert np.allclose(line, [p[:3, :3] @ CENTER + p[:3, 3] for p in poses[:2]], atol=1e-6)
    assert set(found["/trails/box"]["LineStrips3D:strips"]) == {1}  # a new line after the loss
    values = found["/presence/box"]["Scalars:scalars"]
    assert {t: float(v[0]) for t, v in values.items()} == pytest.approx(
        {0: 0.9, 1: 0.8, 2: 0.7, 4: 0.5}
    )
    pictures = found["/photograph"]["EncodedImage:blob"]
    assert set(pictures) == set(range(5))
    again = cv2.imdecode(pictures[3].astype(np.uint8).reshape(-1), cv2.IMREAD_COLOR)[..., ::-1]
    assert np.abs(again.astype(int) - SMOOTH).mean() < 3
    assert set(found["/cloud"]["Points3D:positions"]) == set(range(5))
