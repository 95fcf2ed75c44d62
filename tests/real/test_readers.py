"""Readers against real files: YCB-Video frames with the public meshes, and the poses of a real FAT
frame.
"""

import json

import cv2
import numpy as np
import pytest

from posefilter.checking.check import check_dataset
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.ycb_video import YCBVideoReader
from posefilter.meshes.store import MeshStore

_SOME = ["008_pudding_box", "024_bowl", "035_power_drill", "040_large_marker"]
_CORNERS = [
    [1, -1, 1],
    [-1, -1, 1],
    [-1, 1, 1],
    [1, 1, 1],
    [1, -1, -1],
    [-1, -1, -1],
    [-1, 1, -1],
    [1, 1, -1],
]


@pytest.fixture(scope="module")
def meshes(real_data):
    return MeshStore(real_data / "ycb")


@pytest.mark.slow
def test_real_photographs_fit_their_meshes(real_data, meshes, tmp_path):
    reader = YCBVideoReader(real_data / "ycbv" / "data", None, meshes)
    assert reader.objects[:2] == ("002_master_chef_can", "003_cracker_box")
    report = check_dataset(reader, meshes, limit=2, out=tmp_path)
    assert report["problems"] == []
    assert len(report["objects"]) == 7
    for row in report["objects"]:
        assert row["frames"] == 2
        assert row["silhouette_iou"] > 0.95
        assert row["depth_error_mm"] <= 3.0


def test_rendered_ycb_video_frames_fit_to_a_fraction_of_a_millimeter(real_data, meshes):
    reader = YCBVideoReader(real_data / "ycbv", _SOME, meshes, subsets=("data_syn",))
    report = check_dataset(reader, meshes, limit=1)
    assert report["problems"] == []
    assert [row["frames"] for row in report["objects"]] == [1] * len(_SOME)
    for row in report["objects"]:
        assert row["silhouette_iou"] > 0.97, row
        assert row["depth_error_mm"] < 0.8, row


def test_canary_the_frame_of_ycb_video_is_not_the_meshes(real_data, meshes):
    reader = YCBVideoReader(
        real_data / "ycbv" / "data", "003_cracker_box", meshes, mesh_frame="ycb_video"
    )
    report = check_dataset(reader, meshes, limit=2)
    assert report["objects"][0]["silhouette_iou"] < 0.5
    assert "YCB-Video's object frame" in report["problems"][0]


def test_key_frames_and_published_points(real_data, meshes):
    dm = PoseDataModule(
        "ycb_video",
        real_data / "ycbv",
        "003_cracker_box",
        meshes,
        split={"test": 1.0},
        image_width=320,
    )
    batch = dm.test_dataset[0]
    frames = list((real_data / "ycbv" / "data" / "0001").glob("*-color.png"))
    assert len(dm.test_dataset) == len(frames) > 0
    assert batch.rgb.shape == (3, 240, 320)
    points = dm.object_model(0).points.numpy()
    assert len(points) == 2621
    # published points lie on the mesh, once in its frame
    low, high = dm.meshes.load("003_cracker_box").bounds
    assert (points > low - 0.002).all()
    assert (points < high + 0.002).all()


@pytest.fixture
def banana(real_data, tmp_path):
    """Return a FAT folder with a real frame's JSON files, and the pixels that its meshes would
    give.
    """
    folder = tmp_path / "single" / "011_banana_16k" / "kitchen_0"
    folder.mkdir(parents=True)
    source = real_data / "fat"
    names = {
        "object": "_object_settings",
        "camera": "_camera_settings",
        "left": "000000.left",
        "right": "000000.right",
    }
    for name, target in names.items():
        (folder / f"{target}.json").write_text(
            (source / f"real_fat_single_banana.{name}.json").read_text()
        )
    label = np.full((540, 960), 255, np.uint8)
    label[0] = 0  # a label of everything is refused
    for eye in ("left", "right"):
        cv2.imwrite(str(folder / f"000000.{eye}.jpg"), np.zeros((540, 960, 3), np.uint8))
        cv2.imwrite(str(folder / f"000000.{eye}.depth.png"), np.full((540, 960), 9000, np.uint16))
        cv2.imwrite(str(folder / f"000000.{eye}.seg.png"), label)
    return folder


def test_a_real_fat_pose_puts_the_mesh_into_its_cuboid(real_data, meshes, banana):
    reader = FatReader(banana, "011_banana", meshes)
    native = reader.native_from_mesh("011_banana")
    vertices = meshes.load("011_banana").vertices
    aligned = vertices @ native[:3, :3].T + native[:3, 3]
    for i, record in enumerate(reader.records()):
        cuboid = np.array(json.loads(record.files[3].read_text())["objects"][0]["cuboid"]) / 100
        pose = reader.read(i).camera_from_object
        low, high = aligned.min(0), aligned.max(0)
        corners = np.where(np.array(_CORNERS) > 0, high, low)
        camera_from_aligned = pose @ np.linalg.inv(native)
        found = corners @ camera_from_aligned[:3, :3].T + camera_from_aligned[:3, 3]
        assert np.abs(found - cuboid).max() < 0.001
    left, right = (reader.read(i).camera_from_object[:3, 3] for i in range(2))
    np.testing.assert_allclose(left - right, [0.06, 0, 0], atol=2e-5)
    assert not reader.notes  # the mesh is the one that FAT measured


@pytest.mark.slow
def test_the_wood_block_of_fat_has_no_geometry(real_data, meshes, banana):
    settings = json.loads((real_data / "fat" / "nvdu_ycb_original.json").read_text())
    (banana / "_object_settings.json").write_text(json.dumps(settings))
    for eye in ("left", "right"):
        path = banana / f"000000.{eye}.json"
        path.write_text(path.read_text().replace("011_banana_16k", "036_wood_block_16k"))
        label = np.zeros((540, 960), np.uint8)
        label[300:400, 400:500] = 192
        cv2.imwrite(str(banana / f"000000.{eye}.seg.png"), label)
    reader = FatReader(banana, "036_wood_block", meshes)
    assert any("036_wood_block is not the one that FAT measured" in note for note in reader.notes)
    assert np.isnan(reader.visible_share(reader.read(0)))
    others = [one["class"].removesuffix("_16k") for one in settings["exported_objects"]]
    others.remove("036_wood_block")
    assert len(others) == 20
    # every other class of the real settings fits its mesh
    assert not FatReader(banana, others, meshes).notes
