"""The dataset check: silent on a true dataset, and names the cause of each way to get one wrong."""

import json
import re

import cv2
import numpy as np
import pytest
from dataset_trees import (
    HIGH,
    LOW,
    K,
    bop_scene,
    fat_folder,
    fat_frame,
    pose,
    write_mesh,
    ycb_frame,
)

from posefilter.checking.check import check_dataset, format_report
from posefilter.checking.compare import View, list_causes
from posefilter.data.frames import Sample
from posefilter.data.readers.bop import BopReader
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.ycb_video import YCBVideoReader
from posefilter.errors import UserError
from posefilter.meshes import ycb
from posefilter.meshes.store import MeshStore

NAME = "003_cracker_box"
NATIVE = ycb.ycbvideo_from_original(NAME)
POSES = [
    pose((0.2 + 0.5 * k, 0.3 * k - 0.7, 0.4), (0.05 - 0.03 * k, 0.01 * k - 0.02, 0.42 + 0.02 * k))
    for k in range(4)
]
FRONT = pose((0.1, 0.2, 0.3), (0.06, -0.03, 0.33))


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    write_mesh(folder, NAME)
    return MeshStore(write_mesh(folder, "obj_000002"))


def tree(root, native=NATIVE, **change):
    for k, each in enumerate(POSES):
        ycb_frame(root / "0001" / f"{k + 1:06d}", [(2, each), (3, FRONT)], native, **change)
    return root


def check(root, meshes, **how):
    return check_dataset(YCBVideoReader(root, NAME, meshes, **how), meshes)


def test_a_true_dataset_passes(tmp_path, meshes):
    reader = YCBVideoReader(tree(tmp_path), NAME, meshes)
    report = check_dataset(reader, meshes, out=tmp_path / "out")
    (row,) = report["objects"]
    assert set(report) == {"objects", "problems", "left_out"}
    assert set(row) == {
        "object", "frames", "silhouette_iou", "depth_error_mm", "visible_share", "empty_masks"
    }  # fmt: skip
    assert report["problems"] == []
    assert (row["object"], row["frames"]) == (NAME, 4)
    assert row["silhouette_iou"] > 0.99
    assert row["depth_error_mm"] < 0.1
    assert 0.4 < row["visible_share"] < 1
    assert json.loads((tmp_path / "out" / "data_report.json").read_text()) == report
    sheet = cv2.imread(str(tmp_path / "out" / "contact_sheet.png"))
    assert sheet.shape == (2 * (275 + 6) + 19, 3 * (512 + 6) + 6, 3)  # two rows, and the legend
    assert NAME in format_report(report)
    assert "no problems" in format_report(report)


def scaled(factor):
    def change(poses):
        out = poses.copy()
        out[:, 3] *= factor
        return out

    return change


def inverted(poses):
    out = np.zeros_like(poses)
    for k in range(poses.shape[2]):
        out[..., k] = np.linalg.inv(np.vstack([poses[..., k], [0, 0, 0, 1]]))[:3]
    return out


def wide(factor):
    out = K.copy()
    out[:2] *= factor
    out[:2, 2] += (factor - 1) / 2
    return out


WRONG = {
    "depth x 10": ({"factor_depth": 1000.0}, "depth is 10 times"),
    "depth x 0.1": ({"factor_depth": 100_000.0}, "depth is 0.1 times"),
    "depth x 1000": ({"factor_depth": 10.0}, "depth is 1000 times"),
    "millimeters": ({"poses": scaled(1000)}, "translations are in millimeters"),
    "centimeters": ({"poses": scaled(100)}, "translations are in centimeters"),
    "ten times too far": ({"poses": scaled(10)}, "translations are too large by a factor of 10 "),
    "kilometers": ({"poses": scaled(0.001)}, "translations are too small by a factor of 1000"),
    "inverse": ({"poses": inverted}, "wrong way round"),
    "frame": (
        {"native": np.eye(4)},
        "poses are in the mesh file's frame already|google_16k\\) frame",
    ),
    "640 wide": ({"K": wide(4.0)}, "intrinsics belong to pictures 640 px wide, not 160"),
    "half pixel": (
        {"K": K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])},
        r"off by \+0\.5 "
        r"px: pixel corners",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_the_cause_is_named(tmp_path, meshes, case):
    change, words = WRONG[case]
    report = check(tree(tmp_path, **{"native": NATIVE, **change}), meshes)
    assert len(report["problems"]) == 1, report
    assert re.search(words, report["problems"][0]), report["problems"]


def test_no_width_is_said_to_be_wrong_for_itself(meshes):
    """Views of several widths share a list of causes, in the words of the first view."""
    sample = Sample(
        np.zeros((120, 160, 3), np.uint8),
        np.ones((120, 160), np.float32),
        np.ones((120, 160), bool),
        K.astype(np.float32),
        POSES[0].astype(np.float32),
        0,
        0,
        1.0,
    )
    view = View(sample, np.zeros((120, 160), bool), meshes.load(NAME), NATIVE)
    words = [one[0] for one in list_causes(view)]
    assert "intrinsics belong to pictures 160 px wide" in words
    assert "intrinsics belong to pictures 640 px wide, not 160" in words


def test_two_causes_at_once(tmp_path, meshes):
    report = check(tree(tmp_path, poses=scaled(1000), factor_depth=1000.0), meshes)
    assert "millimeters" in report["problems"][0]
    assert "depth is 10 times" in report["problems"][1]


def test_models_of_the_other_frame(tmp_path, meshes):
    report = check(tree(tmp_path), meshes, mesh_frame="ycb_video")
    assert "YCB-Video's object frame, meshes in the original" in report["problems"][0]


def test_a_centered_frame_is_named(tmp_path, meshes):
    center = np.eye(4)
    center[:3, 3] = (LOW + HIGH) / 2
    bop_scene(tmp_path / "000001", [[(2, each @ center)] for each in POSES])
    # pixels show the mesh at `each @ center`; let the file say the center's pose
    for folder in (tmp_path / "000001",):
        content = json.loads((folder / "scene_gt.json").read_text())
        for k, each in enumerate(POSES):
            content[str(k)][0]["cam_t_m2c"] = ((each @ center @ center)[:3, 3] * 1000).tolist()
        (folder / "scene_gt.json").write_text(json.dumps(content))
    report = check_dataset(BopReader(tmp_path, "obj_000002", meshes), meshes)
    assert "center of the bounding box" in report["problems"][0]


@pytest.mark.parametrize(
    ("unit", "told"), [(0.1, "small by a factor of 10: .* by 10 "), (10, "large .* by 0.1 ")]
)
def test_a_mesh_in_another_unit_is_not_taken_for_wrong_poses_and_depth(
    tmp_path, meshes, unit, told
):
    wrong = MeshStore(meshes.root, scale=unit)
    bop_scene(tmp_path / "000001", [[(2, each)] for each in POSES])
    (problem,) = check_dataset(BopReader(tmp_path, "obj_000002", wrong), wrong)["problems"]
    assert re.search(f"the mesh is too {told}", problem)


def invert_masks(folder, files="*"):
    for file in (folder / "mask_visib").glob(f"{files}.png"):
        cv2.imwrite(str(file), 255 - cv2.imread(str(file), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("units", [1.0, 10.0])
def test_inverted_masks_are_no_translations(tmp_path, meshes, units):
    """An object that is ten times nearer would fill the image, as nearly all of the mask is set."""
    folder = tmp_path / "000001"
    bop_scene(folder, [[(2, each), (3, FRONT)] for each in POSES])
    change_cameras(folder, "0123", units)
    invert_masks(folder)
    problems = check_dataset(BopReader(tmp_path, "obj_000002", meshes), meshes)["problems"]
    words = [r"^obj_000002: masks are inverted: 255 is the object, 0 all else"]
    words += ["depth is 10 times what the mesh says"] if units == 10 else []
    assert len(problems) == len(words), problems
    assert all(map(re.search, words, problems)), problems


def test_a_single_mask_that_is_inverted_is_named(tmp_path, meshes):
    bop_scene(tmp_path / "000001", [[(2, each)] for each in POSES])
    invert_masks(tmp_path / "000001", "000002_*")
    (problem,) = check_dataset(BopReader(tmp_path, "obj_000002", meshes), meshes)["problems"]
    assert problem.startswith("one frame, 000001/000002 obj_000002: masks are inverted")


def test_no_silhouette_of_a_whole_image_is_a_translation(tmp_path, meshes):
    """A mask of nearly all of the image, for whatever reason, does not mean that poses are far."""
    folder = tmp_path / "000001"
    bop_scene(folder, [[(2, each)] for each in POSES])
    for file in (folder / "mask_visib").iterdir():
        mask = np.full((120, 160), 255, np.uint8)
        mask[0] = 0
        cv2.imwrite(str(file), mask)
    problems = check_dataset(BopReader(tmp_path, "obj_000002", meshes), meshes)["problems"]
    assert not [problem for problem in problems if "translations" in problem], problems


def change_cameras(folder, images, factor):
    file = folder / "scene_camera.json"
    cameras = json.loads(file.read_text())
    for image in images:
        cameras[image]["depth_scale"] *= factor
    file.write_text(json.dumps(cameras))


def test_no_factor_is_proposed_that_fits_no_frame(tmp_path, meshes):
    """Half of the frames have another depth scale than their camera says."""
    bop_scene(tmp_path / "000001", [[(2, each)] for each in POSES])
    change_cameras(tmp_path / "000001", "13", 10)
    report = check_dataset(BopReader(tmp_path, "obj_000002", meshes), meshes)
    general, *single = report["problems"]
    assert "no cause that was tried explains it" in general
    assert [problem[:24] for problem in single] == [f"one frame, 000001/00000{k}" for k in (1, 3)]
    assert all("depth is 10 times what the mesh says" in problem for problem in single)


def test_a_wrong_mesh_is_a_problem_without_a_cause(tmp_path, meshes):
    wrong = write_mesh(tmp_path / "wrong", NAME)
    path = wrong / NAME / "google_16k" / "textured.obj"
    path.write_text(path.read_text().replace("0.17", "0.11").replace("0.12", "0.07"))
    report = check(tree(tmp_path / "data"), MeshStore(wrong))
    assert "no cause that was tried explains it" in report["problems"][0]
    assert report["objects"][0]["silhouette_iou"] < 0.9


def test_lookalikes_of_rendered_scenes_are_left_out_and_named(tmp_path, meshes):
    folder = fat_folder(tmp_path / "mixed" / "temple_1", {NAME: 24, "lookalike_00": 36})
    for number in range(3):
        fat_frame(folder, number, [(NAME, 24, POSES[number]), ("lookalike_00", 36, FRONT)])
    report = check_dataset(FatReader(tmp_path, None, meshes), meshes)
    assert report["left_out"] == ["lookalike_00"]
    assert report["problems"] == []
    assert [row["object"] for row in report["objects"]] == [NAME]
    assert "left out, look-alikes without a mesh: lookalike_00" in format_report(report)


def test_empty_masks_are_counted(tmp_path, meshes):
    folder = tmp_path / "000001"
    bop_scene(folder, [[(2, pose())], [(2, pose())]])
    mask = np.zeros((120, 160), np.uint8)
    cv2.imwrite(str(folder / "mask_visib" / "000001_000000.png"), mask)
    (row,) = check_dataset(BopReader(tmp_path, on_error="skip"), meshes)["objects"]
    assert (row["frames"], row["empty_masks"]) == (1, 1)


def test_broken_files_and_missing_meshes_are_reported(tmp_path, meshes):
    tree(tmp_path)
    victim = tmp_path / "0001" / "000002-color.png"
    victim.write_bytes(victim.read_bytes()[:500])
    report = check(tmp_path, meshes)
    assert "000002-color.png: truncated" in report["problems"][0]
    assert report["objects"][0]["frames"] == 3
    reader = YCBVideoReader(tmp_path, "004_sugar_box", meshes)
    missing = check_dataset(reader, meshes)
    assert "004_sugar_box: no mesh of this name" in missing["problems"][0]
    assert missing["objects"][0]["silhouette_iou"] is None
    with pytest.raises(UserError, match="max_frames=0"):
        check_dataset(reader, meshes, limit=0)


def test_images_that_show_nothing_are_read_too(tmp_path, meshes):
    folder = tmp_path / "000001"
    bop_scene(folder, [[(2, POSES[0])], [], [], []])
    reader = BopReader(tmp_path, "obj_000002", meshes, on_error="skip")
    assert check_dataset(reader, meshes)["problems"] == []
    (folder / "rgb" / "000001.png").write_bytes(b"")
    for number in (2, 3):
        (folder / "depth" / f"{number:06d}.png").unlink()
    report = check_dataset(BopReader(tmp_path, "obj_000002", meshes, on_error="skip"), meshes)
    assert [row["object"] for row in report["objects"]] == ["obj_000002"]
    image, depth = report["problems"]
    assert re.search(r"000001\.png: truncated.* \(1 such of 3 frames looked at\)$", image)
    assert re.search(r"000002\.png: missing file \(2 such of 3 frames looked at\)$", depth)


def test_what_stands_in_front_where_depth_is_unknown_is_no_error_of_the_pose(tmp_path, meshes):
    """An occluder that is not labeled, and of which the sensor has no depth."""
    root = tree(tmp_path)
    for file in sorted((root / "0001").glob("*-label.png")):
        label = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        depth_file = file.with_name(file.name.replace("label", "depth"))
        depth = cv2.imread(str(depth_file), cv2.IMREAD_UNCHANGED)
        columns = np.nonzero(label == 2)[1]
        hidden = (label == 2) & (np.arange(label.shape[1]) < np.median(columns))
        label[hidden], depth[hidden] = 0, 0
        cv2.imwrite(str(file), label)
        cv2.imwrite(str(depth_file), depth)
    assert check(root, meshes)["problems"] == []
    # where the depth is known, and behind the mesh, the same label is wrong
    for file in sorted((root / "0001").glob("*-depth.png")):
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        depth[depth == 0] = depth.max()
        cv2.imwrite(str(file), depth)
    assert check(root, meshes)["problems"]
