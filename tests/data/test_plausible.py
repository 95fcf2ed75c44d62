"""Data that lie: what a camera cannot have seen is refused, single bad frames are found."""

import json
import os
import re

import cv2
import numpy as np
import pytest
import scipy.io
from dataset_trees import K, bop_scene, fat_tree, pose, write_mesh, ycb_frame

from posefilter.checking.check import check_dataset
from posefilter.cli.evaluate import object_to_judge
from posefilter.data.module import PoseDataModule
from posefilter.data.readers.bop import BopReader
from posefilter.data.readers.decode import holds_meters, read_depth
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.plausible import find_center_flaw
from posefilter.data.readers.ycb_video import YCBVideoReader
from posefilter.errors import BadData, UserError
from posefilter.limits import read_json
from posefilter.meshes import ycb
from posefilter.meshes.mesh import object_model
from posefilter.meshes.store import MeshStore
from posefilter.metrics.bop_results import read_poses_csv
from posefilter.plausibility import find_input_warnings, find_warnings

NAME = "003_cracker_box"
NATIVE = ycb.ycbvideo_from_original(NAME)


def change_meta(root, frame=1, **arrays):
    path = root / "0001" / f"{frame:06d}-meta.mat"
    meta = scipy.io.loadmat(path)
    for name, change in arrays.items():
        meta[name] = change(meta[name])
    scipy.io.savemat(path, {k: v for k, v in meta.items() if not k.startswith("__")})


def change_png(path, change):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), change(image.copy()))


def with_element(i, j, value):
    def change(matrix):
        out = matrix.astype(float)
        out[i, j] = value
        return out

    return change


def moved(z):
    def change(poses):
        out = poses.copy()
        out[2, 3] = z
        return out

    return change


def swapped(matrix):
    out = matrix.copy()
    out[0, 0], out[0, 2] = 30 * matrix[0, 2], matrix[0, 0] * 5
    return out


WRONG = {
    "fx = 0": ({"intrinsic_matrix": with_element(0, 0, 0)}, "no camera matrix"),
    "fx = -190": ({"intrinsic_matrix": with_element(0, 0, -190)}, "no camera matrix"),
    "fx = 1e9": ({"intrinsic_matrix": with_element(0, 0, 1e9)}, "focal lengths"),
    "fx = fy / 3": ({"intrinsic_matrix": with_element(0, 0, 60)}, "focal lengths"),
    "NaN in K": ({"intrinsic_matrix": with_element(0, 1, np.nan)}, "NaN"),
    "skew": ({"intrinsic_matrix": with_element(0, 1, 100)}, "skew"),
    "K zero": ({"intrinsic_matrix": np.zeros_like}, "no camera matrix"),
    "K transposed": ({"intrinsic_matrix": np.transpose}, r"transposed\?"),
    "K identity": ({"intrinsic_matrix": lambda m: np.eye(3)}, "focal lengths"),
    "K negative": ({"intrinsic_matrix": lambda m: -m}, "no camera matrix"),
    "cx": ({"intrinsic_matrix": with_element(0, 2, 1900)}, "principal point"),
    "factor 0": ({"factor_depth": lambda m: m * 0}, "depth scale is not a positive"),
    "factor -1": ({"factor_depth": lambda m: -m}, "depth scale is not a positive"),
    "factor 1e-9": ({"factor_depth": lambda m: m * 1e-13}, "depth scale is not plausible"),
    "factor 1": ({"factor_depth": lambda m: m * 1e-4}, "depth is not plausible"),
    "behind": ({"poses": moved(-0.5)}, "behind the camera"),
    "1e30 m": ({"poses": moved(1e30)}, "wrong unit"),
    "1e300 m": ({"poses": moved(1e300)}, "wrong unit"),
    "fx, fy = 1e300": ({"intrinsic_matrix": lambda m: m * [[1e300], [1e300], [1]]}, "focal"),
    "classes of text": ({"cls_indexes": lambda m: np.array(["box"])}, "cls_indexes"),
    "classes complex": ({"cls_indexes": lambda m: m + 1j}, "complex"),
    "poses complex": ({"poses": lambda m: m + 1j}, "complex"),
    "classes NaN": ({"cls_indexes": lambda m: m * np.nan}, "holds NaN"),
}


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("case", WRONG)
def test_numbers_that_cannot_be_are_refused_and_counted(tmp_path, case):
    for frame in (1, 2):
        (tmp_path / "0001").mkdir(exist_ok=True)
        ycb_frame(tmp_path / "0001" / f"{frame:06d}", [(2, pose())], NATIVE)
    change, words = WRONG[case]
    change_meta(tmp_path, **change)
    how = {"split": {"test": 1.0}, "progress": False}
    with pytest.raises(UserError, match=rf"000001-meta\.mat|000001-depth.*{words}") as caught:
        PoseDataModule("ycb_video", tmp_path, NAME, **how).setup("test")
    assert re.search(words, str(caught.value))
    assert "\n" not in str(caught.value)
    data = PoseDataModule("ycb_video", tmp_path, NAME, on_error="skip", **how)
    data.setup("test")
    left = data.describe()
    counted = [
        *left["left_out_while_listing"].values(),
        *left["splits"]["test"]["left_out"].values(),
    ]
    assert counted == [1]
    assert len(data.records("test")) == 1


IMAGES = {
    "depth of zeros": ("depth", np.zeros_like, "unknown everywhere"),
    "depth saturated": ("depth", lambda image: np.full_like(image, 65535), "unknown everywhere"),
    "label of everything": ("label", lambda image: np.full_like(image, 2), "covers the whole"),
}


@pytest.mark.parametrize("case", IMAGES)
def test_images_that_tell_nothing_are_refused(tmp_path, case):
    (tmp_path / "0001").mkdir()
    ycb_frame(tmp_path / "0001" / "000001", [(2, pose())], NATIVE)
    kind, change, words = IMAGES[case]
    change_png(tmp_path / "0001" / f"000001-{kind}.png", change)
    with pytest.raises(BadData, match=words):
        YCBVideoReader(tmp_path, NAME).read(0)


def test_a_mask_that_is_the_depth_is_refused(tmp_path):
    bop_scene(tmp_path / "bop" / "000001", [[(2, pose())]])
    folder = tmp_path / "bop" / "000001"
    depth = (folder / "depth" / "000000.png").read_bytes()
    (folder / "mask_visib" / "000000_000000.png").write_bytes(depth)
    with pytest.raises(BadData, match=r"is it the depth\?"):
        BopReader(tmp_path / "bop", "obj_000002").read(0)
    fat_tree(tmp_path / "fat", scenes=1, frames=1)
    folder = tmp_path / "fat" / "mixed" / "kitchen_0"
    (folder / "000000.left.seg.png").write_bytes((folder / "000000.left.depth.png").read_bytes())
    with pytest.raises(BadData, match=r"is it the depth\?"):
        FatReader(tmp_path / "fat", "toy").read(0)


def broken_bop(change):
    def spoil(root):
        path = root / "000001" / "scene_gt.json"
        content = json.loads(path.read_text())
        path.write_text(json.dumps(change(content)))

    return spoil


BOP = {
    "null": lambda c: {**c, "0": None},
    "a list": lambda c: [c],
    "a ragged list": lambda c: {**c, "0": [{**c["0"][0], "cam_t_m2c": [0, [1], 2]}]},
    "null record": lambda c: {**c, "0": [None]},
    "text": lambda c: {**c, "0": "x"},
    "a nested number": lambda c: {**c, "0": [{**c["0"][0], "obj_id": [[2]]}]},
    "no number": lambda c: {**c, "0": [{**c["0"][0], "obj_id": None}]},
    "a superscript": lambda c: {**c, "\u00b2": c["0"]},
    "a long number": lambda c: {**c, "1" * 5000: c["0"]},
}


@pytest.mark.parametrize("case", BOP)
def test_odd_json_is_one_line_and_counted(tmp_path, case):
    for scene in ("000001", "000002"):
        bop_scene(tmp_path / scene, [[(2, pose())]])
    broken_bop(BOP[case])(tmp_path)
    with pytest.raises(BadData, match=r"000001/scene_gt\.json"):
        BopReader(tmp_path, "obj_000002")
    reader = BopReader(tmp_path, "obj_000002", on_error="skip")
    assert sum(reader.skipped.values()) == 1
    assert len(reader.records()) == 1


FAT = {
    "objects null": ("000000.left.json", lambda c: {**c, "objects": None}),
    "object null": ("000000.left.json", lambda c: {**c, "objects": [None]}),
    "visibility null": (
        "000000.left.json",
        lambda c: {**c, "objects": [{**c["objects"][0], "visibility": None}]},
    ),
    "cameras null": ("_camera_settings.json", lambda c: {"camera_settings": None}),
    "classes null": ("_object_settings.json", lambda c: {"exported_objects": None}),
    "skew null": (
        "_camera_settings.json",
        lambda c: {
            "camera_settings": [
                {**one, "intrinsic_settings": {**one["intrinsic_settings"], "s": None}}
                for one in c["camera_settings"]
            ]
        },
    ),
}


@pytest.mark.parametrize("case", FAT)
def test_nulls_in_fat_are_one_line_and_counted(tmp_path, case):
    fat_tree(tmp_path, scenes=2, frames=1)
    name, change = FAT[case]
    path = tmp_path / "mixed" / "kitchen_0" / name
    path.write_text(json.dumps(change(json.loads(path.read_text()))))
    with pytest.raises(BadData, match=re.escape(str(path))):
        FatReader(tmp_path, "toy")
    reader = FatReader(tmp_path, "toy", on_error="skip")
    assert sum(reader.skipped.values()) == 1
    assert len(reader.records()) == 1


def test_files_that_cannot_be_read_are_one_line(tmp_path):
    path = tmp_path / "a.json"
    for content in (b"[" * 100_000, b"9" * 5000, b"\xff\xfe\x00", b""):
        path.write_bytes(content)
        with pytest.raises(BadData, match="not readable as JSON"):
            read_json(path)
    path.chmod(0)
    if os.geteuid() != 0:  # root reads everything
        with pytest.raises(BadData, match="Permission denied"):
            read_json(path)
    loop = tmp_path / "loop.json"
    loop.symlink_to(loop)
    with pytest.raises(BadData):
        read_json(loop)
    (tmp_path / "0001").mkdir()
    ycb_frame(tmp_path / "0001" / "000001", [(2, pose())], NATIVE)
    (tmp_path / "classes.txt").write_bytes(b"\xff\xff")
    with pytest.raises(UserError, match=r"classes\.txt: not a text in UTF-8"):
        YCBVideoReader(tmp_path, NAME)


def test_a_link_to_itself_ends(tmp_path):
    (tmp_path / "mixed").mkdir()
    (tmp_path / "mixed" / "again").symlink_to(tmp_path)
    with pytest.raises(UserError, match="a link to itself"):
        FatReader(tmp_path, "toy")


def test_depth_is_read_from_arrays(tmp_path):
    meters = np.random.default_rng(0).uniform(0, 3, (6, 8))
    np.save(tmp_path / "f.npy", meters)
    np.testing.assert_allclose(read_depth(tmp_path / "f.npy", 1000.0), meters, rtol=1e-6)
    units = np.asfortranarray(np.round(meters * 1000).astype(np.uint16))
    units[0, 0] = 65535
    np.save(tmp_path / "u.npy", units)
    read = read_depth(tmp_path / "u.npy", 1000.0)
    assert read[0, 0] == 0
    np.testing.assert_allclose(read[1:], meters[1:], atol=6e-4)
    holes = meters.astype(np.float32)
    holes[0, 0], holes[0, 1] = np.nan, np.inf
    np.save(tmp_path / "h.npy", holes)
    assert cv2.imwrite(str(tmp_path / "h.tif"), holes)
    for name in ("h.npy", "h.tif"):  # unknown there, meters elsewhere, whatever the units
        read = read_depth(tmp_path / name, 1000.0)
        assert read[0, :2].tolist() == [0, 0]
        assert np.array_equal(read[1:], holes[1:])
        assert holds_meters(tmp_path / name)
    assert not holds_meters(tmp_path / "u.npy")
    for name, array, words in (
        ("negative", np.full((2, 2), -1.0), "negative"),
        ("flat", np.ones(4), r"no array \(H, W\) of numbers \(found float64 \(4,\)"),
        ("text", np.array([["a"]]), "no array"),
        ("objects", np.array([[{}]], dtype=object), "not readable as a NumPy array"),
    ):
        np.save(tmp_path / f"{name}.npy", array)
        with pytest.raises(BadData, match=words):
            read_depth(tmp_path / f"{name}.npy", 1000.0)
    whole = (tmp_path / "f.npy").read_bytes()
    (tmp_path / "f.npy").write_bytes(whole[:-8])
    with pytest.raises(BadData, match="not readable as a NumPy array"):
        read_depth(tmp_path / "f.npy", 1000.0)
    # a header that promises more than there is, and one that cannot be parsed
    for header in (b"(6e9, 8), }", b"(600, 8), }", b"(6, 8, ((( "):
        spoilt = whole.replace(b"(6, 8), }  ", header)
        assert spoilt != whole
        (tmp_path / "f.npy").write_bytes(spoilt)
        with pytest.raises(BadData, match="not readable as a NumPy array"):
            read_depth(tmp_path / "f.npy", 1000.0)


def spoil_depth(change):
    return lambda root: change_png(root / "0001" / "000003-depth.png", change)


def spoil_label(change):
    return lambda root: change_png(root / "0001" / "000003-label.png", change)


def one_pixel(label):
    out = np.zeros_like(label)
    row, column = np.argwhere(label == 2)[0]
    out[row, column] = 2
    return out


SINGLE = {
    "a tenth of depth": (spoil_depth(lambda d: d // 10), "depth is 0.1 times"),
    "depth mirrored": (spoil_depth(lambda d: d[:, ::-1]), "depth is mirrored, left to right"),
    "label mirrored": (spoil_label(lambda x: x[:, ::-1]), "label is mirrored, left to right"),
    "label of one pixel": (spoil_label(one_pixel), "silhouette IoU 0.00"),
    "behind the camera": (
        lambda root: change_meta(root, 3, poses=moved(-0.4)),
        "behind the camera",
    ),
    "another's pose": (
        lambda root: change_meta(root, 3, poses=lambda p: np.roll(p, 1, axis=1)),
        "no rotation",
    ),
    "K of another size": (
        lambda root: change_meta(root, 3, intrinsic_matrix=lambda m: K * [[4], [4], [1]]),
        "intrinsics|principal point",
    ),
}


@pytest.mark.parametrize("case", SINGLE)
def test_a_single_bad_frame_is_listed(tmp_path, case):
    meshes = MeshStore(write_mesh(tmp_path / "meshes", NAME))
    root = tmp_path / "data"
    (root / "0001").mkdir(parents=True)
    for k in range(7):
        each = pose((0.2 + 0.5 * k, 0.3 * k - 0.7, 0.4), (0.04, 0.01 * k - 0.02, 0.42))
        ycb_frame(root / "0001" / f"{k + 1:06d}", [(2, each)], NATIVE)
    reader = YCBVideoReader(root, NAME, meshes, on_error="skip")
    assert check_dataset(reader, meshes)["problems"] == []
    spoil, words = SINGLE[case]
    spoil(root)
    reader = YCBVideoReader(root, NAME, meshes, on_error="skip")
    (problem,) = check_dataset(reader, meshes, limit=None)["problems"]
    assert "000003" in problem
    assert re.search(words, problem), problem


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("min_visibility", float("nan")),
        ("min_visibility", -1),
        ("min_visibility_test", 1.5),
        ("num_model_points", 0),
        ("batch_size", 0),
        ("batch_size_test", 0),
        ("workers", -1),
        ("workers", 1_000_000),
        ("limit_train", -1),
        ("limit_val", 0),
        ("limit_test", 0),
        ("image_width", 0),
        ("image_height", 1 << 20),
        ("split_seed", -1),
        ("seed", -1),
    ],
)
def test_settings_that_make_no_sense_are_named(tmp_path, name, value):
    with pytest.raises(UserError, match=rf"^data\.{name}={value}: must be a (whole )?number"):
        PoseDataModule("fat", tmp_path, **{name: value})


@pytest.mark.parametrize(("scale", "told"), [(1.0, False), (0.1, True)])
def test_depth_nearer_than_cameras_measure_is_told(tmp_path, scale, told):
    """As of millimeters that are read as tenths of them."""
    model = object_model(MeshStore(write_mesh(tmp_path, NAME)).load(NAME))
    depth = np.full((120, 160), 0.9 * scale, dtype=np.float32)
    depth[:50] = 0
    where = np.eye(4)
    where[2, 3] = 0.8
    found = find_warnings(where, model, depth, K)
    assert (
        any("the median depth is 0.09 m" in one and "depth_scale" in one for one in found) is told
    )


def test_a_median_depth_beyond_what_cameras_measure_is_told():
    model = object_model(MeshStore("builtin").load("carton"))
    where = np.eye(4)
    where[2, 3] = 0.8
    for median, told in ((8.0, True), (3.0, False)):
        found = find_warnings(where, model, np.full((100, 100), median), K)
        assert any(f"the median depth is {median:.2g} m, farther" in one for one in found) is told


def test_what_makes_the_inputs_implausible_does_not_depend_on_the_pose():
    model = object_model(MeshStore("builtin").load("carton"))
    depth, camera = np.full((100, 100), 8.0), np.array([[90.0, 0, 50], [0, 90.0, 50], [0, 0, 1]])
    far, behind = np.eye(4), np.eye(4)
    far[:3, 3], behind[2, 3] = (5.0, 0.0, 1.0), -1.0
    inputs = find_input_warnings(depth, camera, 1.25)
    assert [one.split()[:3] for one in inputs] == [
        ["the", "median", "depth"],
        ["the", "object", "appears"],
    ]
    for where in (far, behind):
        found = find_warnings(where, model, depth, camera, 1.25)
        assert found[:2] == inputs
        assert len(found) == 3
    assert not find_input_warnings(np.ones((100, 100)), camera)


def test_a_principal_point_of_the_turned_image_is_told():
    """As of cx and cy that are swapped; one of the image itself, or of a part, is not."""
    model = object_model(MeshStore("builtin").load("carton"))
    where = np.eye(4)
    where[2, 3] = 0.8
    depth = np.full((480, 640), 0.9)
    for cx, cy, told in ((241.3, 313.0, True), (313.0, 241.3, False), (100.0, 313.0, False)):
        K = np.array([[1066.0, 0, cx], [0, 1066.0, cy], [0, 0, 1]])
        found = find_warnings(where, model, depth, K)
        assert any("are cx and cy swapped" in one for one in found) is told
    square = np.array([[600.0, 0, 200], [0, 600.0, 205], [0, 0, 1]])
    assert not any(
        "swapped" in one for one in find_warnings(where, model, depth[:400, :400], square)
    )


def test_a_score_that_is_no_number_is_refused(tmp_path):
    row = "0,0,1,nan,1 0 0 0 1 0 0 0 1,0 0 500,1\n"
    (tmp_path / "poses.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n" + row)
    with pytest.raises(UserError, match="score is no number: 'nan'"):
        read_poses_csv(tmp_path / "poses.csv")


def test_a_list_beside_the_default_fractions_is_told(tmp_path):
    bop_scene(tmp_path / "000001", [[(2, pose())], [(2, pose())]])
    targets = tmp_path / "targets.json"
    targets.write_text(json.dumps([{"scene_id": 1, "im_id": i, "obj_id": 2} for i in (0, 1)]))
    split = {"train": 0.8, "val": 0.1, "test": str(targets)}
    data = PoseDataModule("bop", tmp_path, "obj_000002", split=split, workers=0, progress=False)
    with pytest.raises(UserError, match=r"typed in braces, such as 'data\.split=\{test: FILE\}'"):
        data.setup("test")


def test_a_dataset_that_is_not_ycb_v_has_no_object_of_ycb_by_its_number(tmp_path):
    """Whether a checkpoint is tested on it, poses are scored on it, or it is trained on."""
    name = "003_cracker_box"
    bop_scene(tmp_path / "test" / "000001", [[(2, pose())]])
    write_mesh(tmp_path / "meshes", name)
    options = {"meshes": tmp_path / "meshes", "workers": 0, "progress": False}
    data = PoseDataModule("bop", tmp_path / "test", name, split={"test": 1.0}, **options)
    data.setup("test")
    own = data.object_model(0)  # nothing is known of the dataset's models
    (tmp_path / "models").mkdir()
    info = tmp_path / "models" / "models_info.json"
    info.write_text(json.dumps({"2": {"diameter": 1000 * own.diameter + 1}}))
    data.object_model(0)
    for content in ({name: {"symmetries_discrete": []}}, {"2": {"symmetries_discrete": []}}):
        info.write_text(json.dumps(content))
        data.object_model(0)  # no diameter to compare
    info.write_text(json.dumps({"2": {"diameter": 120.0}}))
    refused = rf"object 2 has a diameter of 120 mm, and {name}"
    with pytest.raises(UserError, match=refused):
        data.object_to_learn()
    with pytest.raises(UserError, match=refused):
        object_to_judge(data, own)
    own_models = PoseDataModule("bop", tmp_path / "test", "obj_000002", **options)
    own_models.reader.check_diameter("obj_000002", own.diameter)  # the dataset's own mesh


def test_instances_of_one_image_are_counted_as_such(tmp_path, caplog):
    bop_scene(tmp_path / "000001", [[(2, pose()), (2, pose(position=(0.1, 0.05, 0.6)))]])
    options = {"workers": 0, "progress": False}
    data = PoseDataModule("bop", tmp_path, "obj_000002", split={"test": 1.0}, **options)
    data.setup("test")
    own = data.describe()["splits"]["test"]
    assert (own["frames"], own["images"]) == (2, 1)


@pytest.mark.parametrize(
    ("cx", "size", "fits"),
    [
        (312.0, (640, 480), True),
        (-102.0, (125, 225), True),  # the part of an image that shows an object at its right
        (-376.0, (640, 480), True),  # a region of a sensor, beside the axis
        (1066.0, (640, 480), True),  # likewise, on the other side
        (2000.0, (640, 480), False),
        (-1600.0, (125, 225), False),  # 57 degrees beside the axis
    ],
)
def test_a_part_of_an_image_may_lie_beside_the_axis(cx, size, fits):
    K = np.array([[1066.0, 0, cx], [0, 1066.0, 240.0], [0, 0, 1]])
    assert (find_center_flaw(K, *size) == "") == fits
