"""The BOP reader against analytic truth: millimeters, object numbers, one mask an instance."""

import json

import cv2
import numpy as np
import pytest
from dataset_trees import K, bop_scene, pose, scene, truth, write_png

from posefilter.data.frames import NotShown
from posefilter.data.readers.bop import BopReader
from posefilter.data.splits import split_records
from posefilter.errors import BadData, UserError
from posefilter.meshes import ycb

FRONT = pose((0.1, 0.2, 0.3), (0.06, -0.03, 0.35))


def test_millimeters_become_meters(tmp_path):
    bop_scene(tmp_path / "test" / "000048", [[(2, pose()), (2, FRONT)], [(5, pose())]])
    reader = BopReader(tmp_path, split="test")
    assert reader.objects == ("obj_000002", "obj_000005")
    assert [(r.scene_id, r.im_id, r.obj_id, r.instance) for r in reader.records()] == [
        (48, 0, 2, 0),
        (48, 0, 2, 1),
        (48, 1, 5, 0),
    ]
    _, index = scene([pose(), FRONT])
    for k, expected in enumerate((pose(), FRONT)):
        sample = reader.read(k)
        np.testing.assert_allclose(sample.camera_from_object, expected, atol=1e-6)
        np.testing.assert_array_equal(sample.mask, index == k)
        np.testing.assert_array_equal(reader.others(k), index == 1 - k)
        np.testing.assert_allclose(
            sample.depth[sample.mask], truth(expected)[sample.mask], atol=1.3e-4
        )  # 0.25 mm a unit
        np.testing.assert_allclose(sample.intrinsics, K, atol=1e-4)
    np.testing.assert_array_equal(reader.native_from_mesh("obj_000002"), np.eye(4))
    assert reader.read(2).object_id == 1


def test_ycb_names_with_original_meshes(tmp_path):
    """BOP's YCB-V frame sits at the center of YCB-Video's model, so the original mesh's bounds
    center maps to nearly 0.
    """
    name = "003_cracker_box"
    bop_scene(tmp_path / "000048", [[(2, pose())]])
    reader = BopReader(tmp_path, name)
    native = reader.native_from_mesh(name)
    np.testing.assert_allclose(reader.read(0).camera_from_object, pose() @ native, atol=1e-6)
    np.testing.assert_array_equal(native[:3, :3], np.eye(3))
    np.testing.assert_allclose(
        native[:3, 3] - ycb.ycbvideo_from_original(name)[:3, 3],
        [0.00056, 0.0017, 0.0048],
        atol=1e-9,
    )
    assert BopReader(tmp_path, name, mesh_frame="bop").read(0).camera_from_object == pytest.approx(
        pose(), abs=1e-6
    )


def test_hidden_instances(tmp_path):
    # the first is behind the wall
    bop_scene(tmp_path / "000001", [[(2, pose(position=(0, 0, 2.0))), (3, pose())]])
    with pytest.raises(NotShown):
        BopReader(tmp_path).read(0)


def change(file, edit):
    def spoil(folder):
        content = json.loads((folder / file).read_text())
        edit(content)
        (folder / file).write_text(json.dumps(content))

    return spoil


BROKEN = {
    "no scale": (
        change("scene_camera.json", lambda c: c["0"].pop("depth_scale")),
        "missing key '0.depth_scale'",
    ),
    "zero scale": (
        change("scene_camera.json", lambda c: c["0"].update(depth_scale=0)),
        "depth scale is not a positive",
    ),
    "no camera": (change("scene_camera.json", lambda c: c.pop("0")), "missing key '0'"),
    "no pose": (
        change("scene_gt.json", lambda c: c["0"][0].pop("cam_t_m2c")),
        r"missing key "
        r"'0\[0\].cam_t_m2c'",
    ),
    "no rotation": (
        change("scene_gt.json", lambda c: c["0"][0].update(cam_R_m2c=[1] * 9)),
        "no rotation",
    ),
    "nan": (
        change("scene_gt.json", lambda c: c["0"][0].update(cam_t_m2c=[1, 2, float("nan")])),
        "NaN",
    ),
    "short": (change("scene_gt.json", lambda c: c["0"][0].update(cam_t_m2c=[1, 2])), "wrong size"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_json_is_named_or_counted(tmp_path, case):
    spoil, cause = BROKEN[case]
    bop_scene(tmp_path / "000001", [[(2, pose())], [(2, pose())]])
    spoil(tmp_path / "000001")
    with pytest.raises(BadData, match=cause) as caught:
        BopReader(tmp_path)
    assert "000001/scene_" in str(caught.value)
    reader = BopReader(tmp_path, on_error="skip")
    assert [r.im_id for r in reader.records()] == [1]
    assert sum(reader.skipped.values()) == 1


@pytest.mark.parametrize("name", ["obj_000002", "003_cracker_box"])
def test_a_class_that_is_unknown_since_files_are_broken_is_no_mistake_of_the_name(tmp_path, name):
    bop_scene(tmp_path / "000001", [[(2, pose())]])
    (tmp_path / "000001" / "scene_camera.json").unlink()
    with pytest.raises(UserError, match=r"^\S*scene_camera\.json: missing file; no image is left"):
        BopReader(tmp_path, name, on_error="skip")
    bop_scene(tmp_path / "000002", [[(5, pose())]])
    with pytest.raises(UserError, match=r"obj_000005.*; left out: \S*scene_camera\.json: missing"):
        BopReader(tmp_path, name, on_error="skip")


def test_broken_masks_and_folders(tmp_path):
    bop_scene(tmp_path / "000001", [[(2, pose())]])
    reader = BopReader(tmp_path)
    write_png(
        tmp_path / "000001" / "mask_visib" / "000000_000000.png", np.full((10, 10), 255, np.uint8)
    )
    with pytest.raises(BadData, match="wrong image size"):
        reader.read(0)
    with pytest.raises(UserError, match="no BOP scenes"):
        BopReader(tmp_path / "000001" / "rgb")
    bop_scene(tmp_path / "data" / "train_pbr" / "000001", [[(2, pose())]])
    with pytest.raises(UserError, match=r"no BOP scenes.*data\.options\.split=train_pbr\)"):
        BopReader(tmp_path / "data")
    with pytest.raises(UserError, match=r"val: no such folder .*data\.options\.split=train_pbr\)"):
        BopReader(tmp_path / "data", split="val")
    with pytest.raises(UserError, match="unknown class 'obj_000003'"):
        BopReader(tmp_path, "obj_000003")


def test_gray_images_and_depth_may_be_tiff(tmp_path):
    """As ITODD's are."""
    folder = tmp_path / "test" / "000001"
    bop_scene(folder, [[(5, pose())]])
    expected = BopReader(tmp_path, split="test").read(0)
    for old, new in (("rgb/000000.png", "gray/000000.tif"), ("depth/000000.png",) * 2):
        image = cv2.imread(str(folder / old), cv2.IMREAD_UNCHANGED)
        image = image[..., 0] if image.ndim == 3 else image
        (folder / new).parent.mkdir(exist_ok=True)
        (folder / old).unlink()
        assert cv2.imwrite(str((folder / new).with_suffix(".tif")), image)
    sample = BopReader(tmp_path, split="test").read(0)
    np.testing.assert_array_equal(sample.depth, expected.depth)
    np.testing.assert_array_equal(sample.rgb, expected.rgb[..., 2:].repeat(3, axis=-1))


def test_a_ycb_name_in_a_dataset_without_it_is_told_by_the_datasets_own(tmp_path):
    bop_scene(tmp_path / "000001", [[(1, pose()), (5, FRONT)]])
    with pytest.raises(UserError, match=r"no '003_cracker_box' .*have obj_000001, obj_000005; .*"):
        BopReader(tmp_path, "003_cracker_box")


def test_broken_frames_can_be_left_out_and_the_error_says_how(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]])
    bop_scene(tmp_path / "000002", [[(5, pose())]])
    (tmp_path / "000002" / "scene_gt.json").unlink()
    with pytest.raises(BadData, match=r"scene_gt.json: missing file .*data.on_error=skip leaves"):
        BopReader(tmp_path)
    assert len(BopReader(tmp_path, on_error="skip").records()) == 1


def test_float_depth_is_in_units_of_the_depth_scale(tmp_path):
    """As whole numbers are: millimeters with a scale of 1, meters with one of 1000."""
    folder = tmp_path / "000001"
    for scale in (1.0, 500.0, 1000.0):
        bop_scene(folder, [[(5, pose())]])
        expected = BopReader(tmp_path).read(0).depth
        (folder / "depth" / "000000.png").unlink()
        file = folder / "depth" / "000000.tiff"
        assert cv2.imwrite(str(file), (1000 * expected / scale).astype(np.float32))
        change("scene_camera.json", lambda c, s=scale: c["0"].update(depth_scale=s))(folder)
        np.testing.assert_allclose(BopReader(tmp_path).read(0).depth, expected, rtol=1e-6)
        file.unlink()


@pytest.mark.parametrize("ending", ["jpeg", "JPG", "PNG", "tiff"])
def test_images_are_found_by_any_usual_ending(tmp_path, ending):
    folder = tmp_path / "000001"
    bop_scene(folder, [[(5, pose())]])
    before = folder / "rgb" / "000000.png"
    image = cv2.imread(str(before))
    before.unlink()
    assert cv2.imwrite(str(before.with_suffix(f".{ending}")), image)
    rgb = BopReader(tmp_path).read(0).rgb.astype(float)
    assert np.abs(rgb - image[..., ::-1]).mean() < 3  # JPEG loses a little


def test_objects_are_numbered_from_zero_and_by_whole_numbers(tmp_path):
    """None is left out, and none takes the name of one that the list of YCB's classes ends with."""
    bop_scene(tmp_path / "000001", [[(0, pose()), (21, FRONT)]])
    reader = BopReader(tmp_path)
    assert reader.objects == ("obj_000000", "obj_000021")
    ycb_names = BopReader(tmp_path, mesh_frame="original", objects=["061_foam_brick"])
    assert [record.obj_id for record in ycb_names.records()] == [21]
    for wrong in (-1, 1.7):
        change("scene_gt.json", lambda c, n=wrong: c["0"][0].update(obj_id=n))(tmp_path / "000001")
        with pytest.raises(
            BadData, match=r"scene_gt.json: '0\[0\].obj_id' should be a whole number"
        ):
            BopReader(tmp_path)


def test_numbers_of_images_may_be_padded_in_either_file(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]])
    change("scene_camera.json", lambda c: c.update({"000000": c.pop("0")}))(tmp_path / "000001")
    assert BopReader(tmp_path).read(0).depth.any()


def test_what_is_missing_is_told_with_what_writes_it(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]])
    (tmp_path / "000001" / "mask_visib" / "000000_000000.png").unlink()
    with pytest.raises(BadData, match=r"missing file \(bop_toolkit's scripts/calc_gt_masks\.py"):
        BopReader(tmp_path).read(0)
    (tmp_path / "000001" / "scene_gt.json").unlink()
    with pytest.raises(UserError, match=r"is the ground truth of this split public\?"):
        BopReader(tmp_path)


def test_broken_frames_of_one_kind_are_counted_as_one_cause(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]] * 4)
    for image in ("0", "2", "3"):
        spoil = change("scene_gt.json", lambda c, i=image: c[i][0].update(cam_t_m2c=[1, 2]))
        spoil(tmp_path / "000001")
    reader = BopReader(tmp_path, on_error="skip")
    assert dict(reader.skipped) == {"'cam_t_m2c' has the wrong size": 3}


def test_one_broken_record_leaves_out_one_image(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]] * 4)
    change("scene_gt.json", lambda c: c["2"][0].update(obj_id=-1))(tmp_path / "000001")
    reader = BopReader(tmp_path, on_error="skip")
    assert [record.im_id for record in reader.records()] == [0, 1, 3]
    assert sum(reader.skipped.values()) == 1
    bop_scene(tmp_path / "000002", [[(5, pose())]] * 3)
    (tmp_path / "000002" / "scene_camera.json").write_text("{")
    reader = BopReader(tmp_path, on_error="skip")
    assert len(reader.records()) == 3
    assert sum(reader.skipped.values()) == 1 + 3  # its images, and not one scene


def test_a_split_of_several_cameras_is_told(tmp_path):
    bop_scene(tmp_path / "000001", [[(5, pose())]])
    for camera in ("cam1", "cam2"):
        (tmp_path / "000001" / f"scene_gt_{camera}.json").write_text("{}")
    (tmp_path / "000001" / "scene_gt.json").unlink()
    with pytest.raises(UserError, match=r"has several cameras \(cam1, cam2\)"):
        BopReader(tmp_path)


@pytest.mark.parametrize("typed", ["1", "obj_1", "obj_01"])
def test_a_number_that_is_not_padded_is_told_as_it_is_written(tmp_path, typed):
    bop_scene(tmp_path / "000001", [[(1, pose()), (13, FRONT)]])
    with pytest.raises(UserError, match="did you mean 'obj_000001'"):
        BopReader(tmp_path, typed)


def test_a_list_for_detection_selects_whole_images(tmp_path):
    bop_scene(tmp_path / "000001", [[(1, pose()), (2, FRONT)], [(1, pose())], [(2, pose())]])
    records = BopReader(tmp_path).records()
    one = [{"scene_id": 1, "im_id": 0}, {"scene_id": 1, "im_id": 1, "obj_id": 1, "inst_count": 1}]
    (tmp_path / "list.json").write_text(json.dumps(one))
    parts = split_records(records, {"test": "list.json"}, 0, tmp_path)
    assert [(records[i].im_id, records[i].obj_id) for i in parts["test"]] == [
        (0, 1),
        (0, 2),
        (1, 1),
    ]
    (tmp_path / "list.json").write_text('[{"scene_id": 1}]')
    with pytest.raises(UserError, match="not a list of BOP targets"):
        split_records(records, {"test": "list.json"}, 0, tmp_path)


def test_a_scene_that_is_not_numbered_is_not_left_out_without_a_word(tmp_path):
    for name in ("000001", "kitchen"):
        bop_scene(tmp_path / name, [[(2, pose())]])
    with pytest.raises(UserError, match=r"kitchen: scenes are named by numbers, such as 000001"):
        BopReader(tmp_path)
    (tmp_path / "kitchen").rename(tmp_path / "2")
    assert [record.scene_id for record in BopReader(tmp_path).records()] == [1, 2]
