"""The YCB-Video reader against analytic truth: frames, labels, lists, and what is listed but not
shown.
"""

import json

import numpy as np
import pytest
import scipy.io
from dataset_trees import HEIGHT, WIDTH, K, pose, truth, write_png, ycb_frame

from posefilter.data.frames import NotShown
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.ycb_video import YCBVideoReader
from posefilter.data.splits import split_records
from posefilter.errors import BadData, UserError
from posefilter.meshes import ycb

NAME = "003_cracker_box"
NATIVE = ycb.ycbvideo_from_original(NAME)


@pytest.fixture
def root(tmp_path):
    for scene in ("0048", "0050"):
        for frame in (1, 2):
            ycb_frame(
                tmp_path / "data" / scene / f"{frame:06d}",
                [(2, pose((0.1 * frame, 0.2, 0.3)))],
                NATIVE,
            )
    ycb_frame(tmp_path / "data_syn" / "000123", [(2, pose())], NATIVE, syn=True)
    (tmp_path / "image_sets").mkdir()
    (tmp_path / "image_sets" / "keyframe.txt").write_text("0048/000002\n0050/000001\n0099/000001\n")
    return tmp_path


def test_pose_is_of_the_original_mesh_frame(root):
    reader = YCBVideoReader(root, NAME)
    sample = reader.read(0)
    expected = pose((0.1, 0.2, 0.3))
    np.testing.assert_allclose(sample.camera_from_object, expected, atol=1e-6)
    np.testing.assert_array_equal(sample.mask, truth(expected) > 0)
    np.testing.assert_allclose(sample.intrinsics, K, atol=1e-4)
    assert np.abs(sample.depth - np.where(sample.mask, truth(expected), 0.9)).max() < 0.6e-4
    record = reader.records()[0]
    assert (record.scene_id, record.im_id, record.obj_id, record.group, record.name) == (
        48,
        1,
        2,
        "0048",
        "0048/000001",
    )
    raw = scipy.io.loadmat(record.files[3])["poses"][..., 0]
    np.testing.assert_allclose(
        (sample.camera_from_object @ np.linalg.inv(reader.native_from_mesh(NAME)))[:3],
        raw,
        atol=1e-6,
    )
    assert np.linalg.norm(raw[:, 3] - expected[:3, 3]) > 0.1  # canary: the two frames are far apart


def test_models_in_ycbvideos_own_frame_are_taken_as_they_are(root):
    reader = YCBVideoReader(root, NAME, mesh_frame="ycb_video")
    raw = scipy.io.loadmat(reader.records()[0].files[3])["poses"][..., 0]
    np.testing.assert_allclose(reader.read(0).camera_from_object[:3], raw, atol=1e-6)


def test_rendered_frames_with_alpha_and_float_indices(root):
    reader = YCBVideoReader(root, NAME, subsets=("data", "data_syn"))
    (i,) = [i for i, r in enumerate(reader.records()) if r.name == "data_syn/000123"]
    sample = reader.read(i)
    assert sample.rgb.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(sample.camera_from_object, pose(), atol=1e-6)
    assert reader.records()[i].group == "data_syn/1"
    assert len(YCBVideoReader(root, NAME).records()) == 4
    assert YCBVideoReader(root / "data", NAME).records()[0].name == "0048/000001"
    assert YCBVideoReader(root / "data_syn", NAME).records()[0].name == "data_syn/000123"


def test_a_list_of_key_frames_chooses_and_counts_what_is_not_there(root):
    reader = YCBVideoReader(root, NAME, frames="keyframe.txt")
    assert [r.name for r in reader.records()] == ["0048/000002", "0050/000001"]
    assert list(reader.notes.values()) == [1]
    (root / "image_sets" / "other.txt").write_text("0077/000001\n")
    with pytest.raises(UserError, match="none of its 1 frames"):
        YCBVideoReader(root, NAME, frames="other.txt")


@pytest.mark.parametrize("ending", ["txt", "json"])
def test_scenes_of_a_list_that_are_not_there_are_named(root, caplog, ending):
    """A scene that is there and does not show the object is no reason to warn."""
    ycb_frame(root / "data" / "0051" / "000001", [(3, pose())], NATIVE)
    frames = [(48, 2), (51, 1), (99, 1)]
    lines = "".join(f"{scene:04d}/{frame:06d}\n" for scene, frame in frames)
    targets = [{"scene_id": scene, "im_id": frame} for scene, frame in frames]
    path = root / "image_sets" / f"part.{ending}"
    path.write_text(lines if ending == "txt" else json.dumps(targets))
    records = YCBVideoReader(root, NAME).records()
    assert split_records(records, {"test": path.name}, 0, root)["test"] == [1]
    (warning,) = caplog.messages
    missing = "0099" if ending == "txt" else "99"
    assert warning.startswith("data.split: 1 of the 3 scenes in ")
    assert warning.endswith(f"are not in {root}, and are left out: {missing}")


def test_a_list_may_name_a_frame_twice_and_rendered_frames(root):
    lines = "0048/000002\n0048/000002\ndata_syn/000123\n"
    (root / "image_sets" / "both.txt").write_text(lines)
    reader = YCBVideoReader(root, NAME, frames="both.txt")
    assert [r.name for r in reader.records()] == ["0048/000002"]
    (note,) = reader.notes
    assert "data.options.subsets=[data,data_syn] reads those" in note
    both = YCBVideoReader(root, NAME, frames="both.txt", subsets=["data", "data_syn"])
    assert [r.name for r in both.records()] == ["0048/000002", "data_syn/000123"]
    (root / "image_sets" / "both.txt").write_text("data_syn/000123\n")
    with pytest.raises(UserError, match=r"none of its 1 frames .*subsets=\[data,data_syn\]"):
        YCBVideoReader(root, NAME, frames="both.txt")


def test_listed_but_not_in_the_label(root):
    ycb_frame(root / "data" / "0051" / "000001", [(2, pose())], NATIVE, unlabeled=5)
    reader = YCBVideoReader(root, ["006_mustard_bottle"])
    assert [r.name for r in reader.records()] == ["0051/000001"]
    with pytest.raises(NotShown):
        reader.read(0)


@pytest.mark.parametrize("factor", [1000.0, 10_000.0])
def test_factor_depth_scales_depth(tmp_path, factor):
    ycb_frame(
        tmp_path / "0001" / "000001", [(2, pose())], NATIVE, units=factor, factor_depth=factor
    )
    sample = YCBVideoReader(tmp_path, NAME).read(0)
    np.testing.assert_allclose(
        sample.depth[sample.mask], truth(pose())[sample.mask], atol=0.6 / factor
    )


def test_the_wood_block_is_refused_with_the_way_out(tmp_path):
    ycb_frame(tmp_path / "0001" / "000001", [(16, pose())], np.eye(4))
    with pytest.raises(UserError, match="mesh_frame=ycb_video"):
        YCBVideoReader(tmp_path, "036_wood_block")
    assert YCBVideoReader(tmp_path).objects == ()


BROKEN = {
    "key": ({"without": "factor_depth"}, "missing key 'factor_depth'"),
    "nan": ({"poses": lambda p: p * np.nan}, "'poses' holds NaN"),
    "no rotation": ({"poses": lambda p: p * 2}, "no rotation"),
    "size": ({"K": np.eye(4)}, "'intrinsic_matrix' has the wrong size"),
    "class": ({"cls": 1}, "unknown class"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_meta_is_named_or_counted(tmp_path, case):
    change, cause = BROKEN[case]
    index = 77 if case == "class" else 2
    ycb_frame(tmp_path / "0001" / "000001", [(index, pose())], NATIVE, **change)
    ycb_frame(tmp_path / "0001" / "000002", [(2, pose())], NATIVE)
    with pytest.raises(BadData, match=cause) as caught:
        YCBVideoReader(tmp_path, NAME)
    assert "000001-meta.mat" in str(caught.value)
    reader = YCBVideoReader(tmp_path, NAME, on_error="skip")
    assert [r.name for r in reader.records()] == ["0001/000002"]
    assert sum(reader.skipped.values()) == 1
    assert "000001-meta.mat" in next(iter(reader.examples.values()))


def test_broken_files_are_named(tmp_path):
    stem = tmp_path / "0001" / "000001"
    ycb_frame(stem, [(2, pose())], NATIVE)
    reader = YCBVideoReader(tmp_path, NAME)
    label = stem.with_name("000001-label.png")
    write_png(label, np.full((HEIGHT, WIDTH), 200, np.uint8))
    with pytest.raises(BadData, match=r"unknown class.*label 200"):
        reader.read(0)
    write_png(label, np.zeros((HEIGHT, WIDTH), np.uint8))
    with pytest.raises(BadData, match="empty mask"):
        reader.read(0)
    write_png(label, np.full((HEIGHT, WIDTH // 2), 2, np.uint8))
    with pytest.raises(BadData, match=r"label.png: wrong image size \(80x120"):
        reader.read(0)
    meta = stem.with_name("000001-meta.mat")
    meta.write_bytes(meta.read_bytes()[:200])
    with pytest.raises(BadData, match=r"000001-meta\.mat: (not readable|missing key)"):
        YCBVideoReader(tmp_path, NAME)


def test_a_scene_that_is_not_numbered_is_not_left_out_without_a_word(tmp_path):
    for scene in ("0001", "kitchen"):
        (tmp_path / "data" / scene).mkdir(parents=True)
        ycb_frame(tmp_path / "data" / scene / "000001", [(1, pose())], np.eye(4))
    (tmp_path / "data" / "notes").mkdir()
    with pytest.raises(UserError, match=r"kitchen: scenes are named by numbers, such as 0001"):
        YCBVideoReader(tmp_path, mesh_frame="ycb_video")
    one = YCBVideoReader(tmp_path / "data" / "kitchen", mesh_frame="ycb_video")  # asked for
    assert [record.name for record in one.records()] == ["kitchen/000001"]
    (tmp_path / "data" / "kitchen").rename(tmp_path / "data" / "0002")
    assert len(YCBVideoReader(tmp_path, mesh_frame="ycb_video").records()) == 2


@pytest.mark.parametrize("typed", [".", "../0048"])
def test_a_scene_has_its_name_from_within_its_folder(root, typed, monkeypatch):
    monkeypatch.chdir(root / "data" / "0048")
    records = YCBVideoReader(typed, NAME).records()
    assert [(r.name, r.scene_id) for r in records] == [("0048/000001", 48), ("0048/000002", 48)]


def test_an_object_that_no_image_shows_is_named(root):
    """The folder is right, and has frames of others."""
    data = PoseDataModule("ycb_video", root, "037_scissors", progress=False)
    with pytest.raises(UserError) as caught:
        data.setup("test")
    assert str(caught.value) == f"data.object=037_scissors: no frame in {root} (data.root) shows it"
