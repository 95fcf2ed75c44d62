"""The FAT reader against analytic truth, with canaries for the conventions that are easily
confused.
"""

import dataclasses
import json

import cv2
import numpy as np
import pytest
from dataset_trees import (
    ALIGNED,
    HEIGHT,
    WIDTH,
    K,
    fat_folder,
    fat_frame,
    pose,
    scene,
    truth,
    write_mesh,
    write_png,
)
from scipy.spatial.transform import Rotation

from posefilter.data.frames import NotShown, tight_box
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.fat import FatReader
from posefilter.errors import UserError
from posefilter.meshes.store import MeshStore


@pytest.fixture
def meshes(tmp_path):
    return MeshStore(write_mesh(tmp_path / "meshes", "toy"))


def one_frame(root, ending="jpg", eyes=("left",), truth_pose=None):
    folder = fat_folder(root / "single" / "toy_16k" / "kitchen_0", {"toy": 255})
    for eye in eyes:
        fat_frame(
            folder, 7, [("toy", 255, pose() if truth_pose is None else truth_pose)], eye, ending
        )
    return folder


def test_pose_depth_mask_and_camera_are_the_truth(tmp_path):
    one_frame(tmp_path)
    reader = FatReader(tmp_path, "toy_16k")
    sample = reader.read(0)
    expected = truth(pose())
    np.testing.assert_allclose(sample.camera_from_object, pose(), atol=1e-6)
    np.testing.assert_allclose(sample.intrinsics, K, atol=1e-4)
    np.testing.assert_array_equal(sample.mask, expected > 0)
    # 0.1 mm a unit
    assert np.abs(sample.depth - np.where(expected > 0, expected, 0.9)).max() <= 0.5e-4 + 1e-6
    np.testing.assert_allclose(reader.native_from_mesh("toy"), ALIGNED, atol=1e-6)
    assert reader.objects == ("toy",)
    assert np.isnan(sample.visibility)


def test_canary_the_transform_by_columns_is_another_pose(tmp_path):
    """Had F been taken for columns, or its factor 100 left in, the test above would notice."""
    folder = one_frame(tmp_path)
    F = np.array(
        json.loads((folder / "_object_settings.json").read_text())["exported_objects"][0][
            "fixed_model_transform"
        ]
    )
    camera_from_aligned = pose() @ np.linalg.inv(ALIGNED)
    columns = np.eye(4)
    columns[:3, :3] = F[:3, :3] / 100
    columns[:3, 3] = F[3, :3] / 100
    assert np.abs(camera_from_aligned @ columns - pose()).max() > 0.05
    assert np.abs(np.linalg.det(F[:3, :3]) - 1e6) < 1


def test_right_camera_stands_six_centimeters_to_the_right(tmp_path):
    one_frame(tmp_path, eyes=("left", "right"))
    reader = FatReader(tmp_path)
    names = {record.name: i for i, record in enumerate(reader.records())}
    left = reader.read(names["single/toy_16k/kitchen_0/000007.left"])
    right = reader.read(names["single/toy_16k/kitchen_0/000007.right"])
    np.testing.assert_allclose(
        left.camera_from_object[:3, 3] - right.camera_from_object[:3, 3], [0.06, 0, 0], atol=1e-6
    )
    assert tight_box(right.mask)[0] < tight_box(left.mask)[0]
    records = reader.records()
    assert {record.group for record in records} == {"kitchen_0"}  # stereo pairs are never split
    assert len({(r.scene_id, r.im_id, r.obj_id) for r in records}) == 2
    assert [r.name for r in FatReader(tmp_path, cameras=("left",)).records()] == [
        "single/toy_16k/kitchen_0/000007.left"
    ]


@pytest.mark.parametrize(
    ("part", "subsets"),
    [
        ("", ("single",)),
        ("", ("mixed",)),
        ("single", ("single", "mixed")),
        ("mixed", ("mixed",)),
        ("single/toy_16k", ("single", "mixed")),
        ("single/toy_16k/kitchen_1", ("single", "mixed")),
        ("mixed/kitchen_0", ("single", "mixed")),
    ],
)
def test_scenes_keep_their_numbers_whichever_part_is_read(tmp_path, part, subsets):
    """Else the estimates of one part would be matched with images of another."""
    scenes = ("mixed/kitchen_0", "single/aid_16k/kitchen_0", "single/toy_16k/kitchen_0")
    for scene_name in (*scenes, "single/toy_16k/kitchen_1"):
        folder = fat_folder(tmp_path / scene_name, {"toy": 255})
        fat_frame(folder, 7, [("toy", 255, pose())])
    (tmp_path / "mixed" / "notes").mkdir()
    numbers = {r.files[0]: r.scene_id for r in FatReader(tmp_path).records()}
    assert sorted(numbers.values()) == [0, 2, 4, 6]
    read = FatReader(tmp_path / part, subsets=subsets).records()
    assert {r.files[0]: r.scene_id for r in read}.items() <= numbers.items()
    assert 0 < len(read) < 4


def test_four_decimals_of_a_quaternion_still_make_a_rotation(tmp_path):
    folder = one_frame(tmp_path)
    path = folder / "000007.left.json"
    content = json.loads(path.read_text())
    content["objects"][0]["quaternion_xyzw"] = [
        round(x, 4) for x in content["objects"][0]["quaternion_xyzw"]
    ]
    path.write_text(json.dumps(content))
    R = FatReader(tmp_path).read(0).camera_from_object[:3, :3].astype(np.float64)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-6)
    assert Rotation.from_matrix(R @ pose()[:3, :3].T).magnitude() < 3e-4


@pytest.mark.parametrize("ending", ["jpg", "png"])
def test_color_is_rgb(tmp_path, ending):
    folder = one_frame(tmp_path, ending)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[..., 0] = 250
    write_png(folder / f"000007.left.{ending}", picture)
    np.testing.assert_allclose(
        FatReader(tmp_path).read(0).rgb.reshape(-1, 3).mean(0), [250, 0, 0], atol=4
    )


def test_visibility_is_the_share_of_pixels_not_what_the_json_says(tmp_path, meshes):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {"toy": 24, "other": 36})
    behind, front = pose(), pose((0.1, 0.2, 0.3), (0.06, -0.03, 0.35))
    fat_frame(folder, 0, [("toy", 24, behind), ("other", 36, front)])
    reader = FatReader(tmp_path, "toy", meshes)
    sample = reader.read(0)
    _, index = scene([behind, front])
    expected = (index == 0).sum() / (truth(behind) > 0).sum()
    assert 0.2 < expected < 0.95
    assert reader.visible_share(sample) == pytest.approx(expected, abs=0.005)
    np.testing.assert_array_equal(reader.others(0), index == 1)


@pytest.mark.parametrize("shift", [(0.19, 0.0), (-0.19, 0.0), (0.0, 0.15), (0.0, -0.15)])
def test_what_the_frame_cuts_off_is_not_visible(tmp_path, meshes, shift):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {"toy": 24})
    at = pose(position=(*shift, 0.45))
    fat_frame(folder, 0, [("toy", 24, at)])
    reader = FatReader(tmp_path, "toy", meshes)
    sample = reader.read(0)
    wider = K.copy()
    wider[:2, 2] += (WIDTH, HEIGHT)
    whole = (truth(at, wider, 3 * HEIGHT, 3 * WIDTH) > 0).sum()
    expected = sample.mask.sum() / whole
    assert 0.1 < expected < 0.9
    assert reader.visible_share(sample) == pytest.approx(expected, abs=0.005)


def test_an_object_about_the_camera_fills_at_most_three_frames_by_three(tmp_path, meshes):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {"toy": 24})
    fat_frame(folder, 0, [("toy", 24, pose())])
    reader = FatReader(tmp_path, "toy", meshes)
    sample = reader.read(0)
    near = pose(position=(0.0, 0.0, 0.02))
    filled = dataclasses.replace(sample, camera_from_object=near, mask=np.ones_like(sample.mask))
    assert 1 / 9 - 0.01 <= reader.visible_share(filled) <= 1


def test_two_instances_are_distinguished_by_their_geometry(tmp_path, meshes):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {"toy": 24})
    poses = [pose(), pose((0.1, 0.2, 0.3), (0.06, -0.03, 0.35))]
    fat_frame(folder, 0, [("toy", 24, p) for p in poses])
    reader = FatReader(tmp_path, "toy", meshes)
    _, index = scene(poses)
    for k in range(2):
        sample = reader.read(k)
        both = sample.mask & (index == k)
        assert both.sum() / (sample.mask | (index == k)).sum() > 0.98
        np.testing.assert_allclose(sample.camera_from_object, poses[k], atol=1e-6)
    assert (index == 1).sum() > 300
    assert sum(reader.notes.values()) == 2
    without = FatReader(tmp_path, "toy")
    assert without.records() == []
    assert list(without.skipped.values()) == [2]


def test_single_scene_folder_and_parts(tmp_path):
    folder = one_frame(tmp_path)
    mixed = fat_folder(tmp_path / "mixed" / "kitchen_0", {"toy": 24})
    fat_frame(mixed, 0, [("toy", 24, pose())])
    assert len(FatReader(tmp_path).records()) == 2
    assert len(FatReader(tmp_path, subsets=("mixed",)).records()) == 1
    assert FatReader(folder).records()[0].group == "kitchen_0"


def test_hidden_objects_are_left_out_and_counted(tmp_path):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {"toy": 24, "other": 36})
    # behind the wall
    fat_frame(folder, 0, [("toy", 24, pose(position=(0, 0, 2.0))), ("other", 36, pose())])
    path = folder / "000000.left.json"
    path.write_text(path.read_text().replace("0.81", "0.0"))
    with pytest.raises(NotShown, match="listed, but not in the label"):
        FatReader(tmp_path, "toy").read(0)
    fat_frame(folder, 1, [("toy", 24, pose()), ("other", 36, pose(position=(0, 0, 2.0)))])
    data = PoseDataModule("fat", tmp_path, "toy", split={"test": 1.0}, progress=False)
    data.setup("test")
    assert [record.im_id for record in data.records("test")] == [1]
    assert data.describe()["splits"]["test"]["left_out"] == {"listed, but not in the label": 1}


def spoil_json(key):
    def spoil(folder):
        path = folder / "000007.left.json"
        content = json.loads(path.read_text())
        del content["objects"][0][key]
        path.write_text(json.dumps(content))

    return spoil


def cut(name):
    def spoil(folder):
        path = folder / name
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])

    return spoil


def flip_byte(folder):
    path = folder / "000007.left.depth.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(bytes(data))


def nan_depth(folder):
    depth = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    (folder / "000007.left.depth.png").write_bytes(cv2.imencode(".tiff", depth)[1].tobytes())


def unknown_class(folder):
    path = folder / "000007.left.json"
    path.write_text(path.read_text().replace("toy_16k", "toast_16k"))


def nan_location(folder):
    path = folder / "000007.left.json"
    content = json.loads(path.read_text())
    content["objects"][0]["location"][1] = float("nan")
    path.write_text(json.dumps(content))


def huge_quaternion(folder):
    path = folder / "000007.left.json"
    content = json.loads(path.read_text())
    content["objects"][0]["quaternion_xyzw"][3] = 1e308  # its square is infinite
    path.write_text(json.dumps(content))


BROKEN = {
    "cut color": (cut("000007.left.jpg"), "000007.left.jpg", "truncated or corrupt"),
    "cut depth": (cut("000007.left.depth.png"), "000007.left.depth.png", "truncated or corrupt"),
    "cut json": (cut("000007.left.json"), "000007.left.json", "not readable as JSON"),
    "cut settings": (cut("_object_settings.json"), "_object_settings.json", "not readable as JSON"),
    "corrupt depth": (flip_byte, "000007.left.depth.png", "checksum"),
    "no pose": (
        spoil_json("quaternion_xyzw"),
        "000007.left.json",
        "missing key 'objects\\[0\\].quaternion_xyzw'",
    ),
    "no class": (spoil_json("class"), "000007.left.json", "missing key 'objects\\[0\\].class'"),
    "nan location": (nan_location, "000007.left.json", "holds NaN"),
    "huge quaternion": (huge_quaternion, "000007.left.json", "not a unit quaternion .norm 1e.308"),
    "nan depth": (nan_depth, "000007.left.depth.png", "unknown everywhere"),
    "wrong size": (
        lambda f: write_png(f / "000007.left.seg.png", np.full((60, 80), 255, np.uint8)),
        "seg.png",
        "80x60, but .* 160x120",
    ),
    "empty mask": (
        lambda f: write_png(f / "000007.left.seg.png", np.zeros((HEIGHT, WIDTH), np.uint8)),
        "seg.png",
        "empty mask",
    ),
    "unknown class": (unknown_class, "000007.left.json", "unknown class.*toast"),
    "no color": (lambda f: (f / "000007.left.jpg").unlink(), "000007.left.jpg", "missing file"),
    "no json": (lambda f: (f / "000007.left.json").unlink(), "000007.left.json", "missing file"),
    "no cameras": (
        lambda f: (f / "_camera_settings.json").unlink(),
        "_camera_settings.json",
        "missing file",
    ),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_are_named_with_their_cause_in_one_line(tmp_path, case):
    spoil, file, cause = BROKEN[case]
    spoil(one_frame(tmp_path))
    with pytest.raises(UserError, match=cause) as caught:
        FatReader(tmp_path).read(0)
    assert file in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_transform_that_is_no_rotation_is_refused(tmp_path):
    folder = one_frame(tmp_path)
    path = folder / "_object_settings.json"
    content = json.loads(path.read_text())
    content["exported_objects"][0]["fixed_model_transform"][0][0] += 40
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match="fixed_model_transform"):
        FatReader(tmp_path)


def test_a_class_is_unknown_since_its_folders_settings_are_broken(tmp_path):
    one_frame(tmp_path)
    (settings,) = tmp_path.glob("single/*/*/_object_settings.json")
    settings.write_text("{")
    with pytest.raises(UserError, match=r"^\S*_object_settings\.json: not readable.* is left"):
        FatReader(tmp_path, "toy", on_error="skip")


def test_unknown_object_and_folder(tmp_path):
    one_frame(tmp_path)
    with pytest.raises(UserError, match=r"unknown class 'tooy'.*did you mean 'toy'"):
        FatReader(tmp_path, "tooy")
    with pytest.raises(UserError, match="no such folder"):
        FatReader(tmp_path / "nowhere")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(UserError, match="no FAT scenes"):
        FatReader(empty)


def test_a_newer_export_is_recognized(tmp_path):
    (tmp_path / "000000.cs.png").write_bytes(b"")
    with pytest.raises(UserError, match="newer export"):
        FatReader(tmp_path)
