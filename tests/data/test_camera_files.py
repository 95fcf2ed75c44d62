"""Intrinsics out of the files that cameras, calibrations and datasets come with."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from posefilter.cli.predict import check_depth_scale, read_intrinsics
from posefilter.data.camera_files import CameraFile, read_camera_file
from posefilter.errors import BadData, UserError

K = np.array([[1066.778, 0, 312.9869], [0, 1067.487, 241.3109], [0, 0, 1]])
FOUR = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
REALSENSE = {"width": 640, "height": 480, "fx": K[0, 0], "fy": K[1, 1], "ppx": K[0, 2]}
REALSENSE |= {"ppy": K[1, 2], "model": "distortion.brown_conrady", "coeffs": [0.0] * 5}
ROS = f"""
image_width: 640
image_height: 480
camera_name: camera
camera_matrix: {{rows: 3, cols: 3, data: {K.ravel().tolist()}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
projection_matrix: {{rows: 3, cols: 4, data: {np.c_[K, np.zeros(3)].ravel().tolist()}}}
"""
SIZE = (480, 640)
KALIBR = f"""
camera_model: pinhole
distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
distortion_model: radtan
intrinsics: {[float(one) for one in FOUR.values()]}
resolution: [640, 480]
"""
NERF = {"w": 640, "h": 480, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
NERF |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV", "frames": []}


@pytest.mark.parametrize(
    ("name", "content", "size"),
    [
        ("bop.json", FOUR | {"depth_scale": 0.1, "width": 640, "height": 480}, SIZE),
        ("realsense.json", REALSENSE, SIZE),
        ("inner.json", {"intrinsics": REALSENSE}, SIZE),
        ("open3d.json", {"width": 640, "height": 480, "intrinsic_matrix": K.T.ravel()}, SIZE),
        ("beside.json", {"intrinsics": FOUR, "width": 640, "height": 480}, SIZE),
        (
            "parameters.json",
            {"extrinsic": [1], "intrinsic": {"intrinsic_matrix": K.T.ravel()}},
            None,
        ),
        (
            "both.json",  # depth is aligned to the color image
            {"depth_intrinsics": FOUR | {"fx": 420.0}, "color_intrinsics": FOUR},
            None,
        ),
        ("rows.json", {"K": K}, None),
        ("bare.json", K, None),
        ("four.json", list(FOUR.values()), None),
        ("scene_camera.json", {"0": {"cam_K": K.ravel()}, "7": {"cam_K": K.ravel()}}, None),
        ("info.yaml", f"height: 480\nwidth: 640\nk: {K.ravel().tolist()}\nd: []\n", SIZE),
        ("echo.yaml", f"height: 480\nwidth: 640\nk: {K.ravel().tolist()}\nd: []\n---\n", SIZE),
        ("calibration.yml", ROS, SIZE),
        ("kalibr.yaml", "cam0:" + KALIBR.replace("\n", "\n  "), SIZE),
        ("sensor.yaml", KALIBR.replace("radtan", "radial-tangential"), SIZE),  # EuRoC's
        ("transforms.json", NERF, SIZE),
        ("matrix.txt", "\n".join(" ".join(map(str, row)) for row in K), None),
        ("matrix.csv", str(K.tolist()), None),
        ("four.txt", "1066.778 1067.487, 312.9869 241.3109\n", None),
    ],
)
def test_a_camera_is_read_of_any_form(
    name: str, content: Any, size: tuple[int, int] | None, tmp_path: Path
) -> None:
    path = tmp_path / name
    text = content if isinstance(content, str) else json.dumps(content, default=np.ndarray.tolist)
    path.write_text(text)
    camera = read_intrinsics(str(path))
    np.testing.assert_array_equal(camera.K, K)
    assert camera.size == size


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.json", "[1, 2]", "holds no camera"),
        ("a.json", '[1, 2, "a", 3]', "'intrinsics' is not numbers"),
        ("a.json", '{"width": 640}', r"expected fx, fy, cx, cy or a matrix; it has width"),
        ("a.json", '{"K": [1, 2, 3]}', "wrong size"),
        ("a.json", '{"fx": "a", "fy": 1, "cx": 1, "cy": 1}', "'fx' is not numbers"),
        ("a.json", '{"fx": -1, "fy": 1, "cx": 1, "cy": 1}', "no camera matrix"),
        ("a.json", "{", "not readable as JSON"),
        ("a.json", json.dumps(FOUR | {"width": "x", "height": 1}), "'width' is not numbers"),
        ("a.json", json.dumps(FOUR | {"width": 1.5, "height": 1}), "should be a whole number"),
        ("a.yaml", "a: [", "is no YAML"),
        ("a.yaml", "k: 1\n---\nk: 2\n", "is no YAML .it has several documents: keep one"),
        ("a.yaml", "cam0: {}\ncam1: {}\n", "holds several cameras: cam0, cam1 .keep one"),
        ("a.yaml", KALIBR.replace("pinhole", "eucm"), "its camera_model is eucm .only pinhole"),
        ("a.yaml", "intrinsics: [1, [2], 3, 4]", "'intrinsics' is not numbers"),
        ("a.npz", "PK", "is an archive of arrays"),
        ("a.xml", "<a>", "is no XML"),
        ("a.xml", "<a/>", "expected opencv_storage, found a"),
        ("a.xml", "<opencv_storage><K>1</K></opencv_storage>", "expected fx, fy, cx, cy .*has K"),
        (
            "a.xml",
            '<!DOCTYPE a [<!ENTITY b "b"><!ENTITY c "&b;&b;">]><opencv_storage/>',
            "has XML's declarations",
        ),
        ("a.txt", "1 2 3", r"3 words; expected a matrix \(3, 3\), or fx, fy, cx, cy"),
        ("a.txt", "1 2 3 4 5 6 7 8 9", "no camera matrix"),
    ],
)
def test_what_is_no_camera_is_told(name: str, content: str, told: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(BadData, match=told) as caught:
        read_camera_file(tmp_path / name)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "default", "refused"),
    [
        (FOUR | {"depth_scale": 0.1}, 10000, False),  # of BOP: millimeters a unit
        (FOUR | {"depth_scale": 1.0}, 10000, True),
        (FOUR | {"depth_scale": 1.0}, 1000, False),
        (FOUR | {"depth_scale": 1000}, 1000, False),  # units in a meter
        (FOUR | {"depth_scale": 0.001}, 1000, False),  # meters a unit
        ({"0": {"cam_K": K.ravel(), "depth_scale": 1.0}}, 10000, True),
        (FOUR, 10000, False),
    ],
)
def test_another_depth_scale_than_the_default_is_asked_for(
    content: Any, default: float, refused: bool, tmp_path: Path
) -> None:
    (tmp_path / "camera.json").write_text(json.dumps(content, default=np.ndarray.tolist))
    camera = read_camera_file(tmp_path / "camera.json")
    if not refused:
        check_depth_scale(camera, default, "intrinsics=camera.json")
        return
    with pytest.raises(UserError, match=r"its depth_scale is 1, which .* depth_scale=1000 here"):
        check_depth_scale(camera, default, "intrinsics=camera.json")


@pytest.mark.parametrize(
    ("own", "told"),
    [
        (0.001, "which in meters a unit means depth_scale=1000 here, and"),
        (0.01, "BOP's files. means depth_scale=100000 here, or in meters a unit means .*=100 here"),
        (5000.0, "which in units in a meter means depth_scale=5000 here, and"),
        (20.0, "is 20, and"),
    ],
)
def test_no_reading_of_a_depth_scale_is_advised_that_no_camera_has(own: float, told: str) -> None:
    """A RealSense's `get_depth_scale` is meters a unit, which as BOP's would be 1e+06."""
    with pytest.raises(UserError, match=rf"{told}.* 10000 is the default; type depth_scale=$"):
        check_depth_scale(CameraFile(K, depth_scales=(own,)), 10000, "intrinsics=camera.json")


def test_depth_scales_that_differ_from_image_to_image_are_asked_for(tmp_path: Path) -> None:
    """Also where the default is that of one of them."""
    content = {str(i): {"cam_K": K.ravel().tolist(), "depth_scale": 10.0**-i} for i in range(2)}
    (tmp_path / "scene_camera.json").write_text(json.dumps(content))
    camera = read_camera_file(tmp_path / "scene_camera.json")
    told = (
        r"^intrinsics=scene_camera\.json: .* different depth scales \(0\.1, 1\); type depth_scale="
    )
    for default in (1000, 10000):
        with pytest.raises(UserError, match=told):
            check_depth_scale(camera, default, "intrinsics=scene_camera.json")


def test_cameras_that_differ_from_image_to_image_are_told(tmp_path: Path) -> None:
    other = K + np.array([[1, 0, 0], [0, 0, 0], [0, 0, 0]])
    content = {"0": {"cam_K": K.ravel().tolist()}, "1": {"cam_K": other.ravel().tolist()}}
    (tmp_path / "scene_camera.json").write_text(json.dumps(content))
    with pytest.raises(BadData, match="has another camera for each image"):
        read_camera_file(tmp_path / "scene_camera.json")


@pytest.mark.parametrize("name", ["camera.yaml", "old.yml", "camera.json", "camera.xml"])
def test_what_opencv_writes_is_read(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([[0.1, -0.2, 0, 0, 1e-7]]))
    storage.release()
    if path.stem == "old":
        path.write_text("%YAML:1.0\n" + path.read_text().split("\n", 1)[1])
    camera = read_camera_file(path)
    np.testing.assert_array_equal(camera.K, K)
    assert (camera.size, camera.distortion) == (SIZE, (0.1, -0.2, 0, 0, 1e-7))


def test_a_distortion_is_not_passed_over(tmp_path: Path) -> None:
    """What the message advises is read, either way."""
    path = tmp_path / "camera.yaml"
    path.write_text(
        ROS.replace("[0, 0, 0, 0, 0]", "[0.1, -0.2, 0, 0, 0]").replace("1066.778", "900", 1)
    )
    with pytest.raises(UserError, match="tells a distortion of the lens") as caught:
        read_intrinsics(str(path))
    rectified, raw = (part.split(" ")[0] for part in str(caught.value).split("intrinsics=")[2:])
    np.testing.assert_allclose(read_intrinsics(rectified.rstrip(",")).K, K)
    assert read_intrinsics(raw).K[0, 0] == 900
    assert "distortion=0.1,-0.2,0,0,0" in str(caught.value)
    assert read_intrinsics(str(path), distorted=True).K[0, 0] == 900


def test_typed_matrices_are_judged_as_those_of_files_are() -> None:
    """A skew that moves points by less than a pixel is no reason to refuse a calibration."""
    assert read_intrinsics("900,0.4,320,0,900,240,0,0,1").K[0, 1] == 0.4
    with pytest.raises(UserError, match="skew 40 px"):
        read_intrinsics("900,40,320,0,900,240,0,0,1")
    with pytest.raises(UserError, match="transposed"):
        read_intrinsics("900,0,0,0,900,0,320,240,1")


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ({"intrinsics": FOUR, "distortion": [0.1, -0.2, 0, 0, 0]}, "0.1,-0.2,0,0,0"),
        (FOUR | {"p2": 0.01, "k1": 0.1, "k3": 0.2}, "0.1,0,0,0.01,0.2"),
        (FOUR | {"distortion": {"k1": 0.1, "k6": 0.3}}, "0.1,0,0,0,0,0,0,0.3"),
        (FOUR | {"k2": 0.1}, "0,0.1,0,0,0"),
        (FOUR | {"K1": 0.1, "P1": [0] * 12}, "0.1,0,0,0,0"),
        (FOUR | {"dist_coeff": [[0.1, -0.2, 0, 0]]}, "0.1,-0.2,0,0"),
        (FOUR | {"distCoeffs": [[0.1], [-0.2], [0], [0]]}, "0.1,-0.2,0,0"),
        (NERF | {"k1": 0.1, "p2": 0.3}, "0.1,0,0,0.3,0"),
        (FOUR | {"dist": [0.1, -0.2, 0, 0]}, "0.1,-0.2,0,0"),
        (FOUR | {"Distortion_Coefficients": {"data": [0.1, -0.2, 0, 0]}}, "0.1,-0.2,0,0"),
    ],
)
def test_a_distortion_is_found_where_it_is_told(content: Any, told: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(UserError, match=f"distortion={told}$"):
        read_intrinsics(str(path))


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (NERF | {"frames": [{"fl_x": 600.0}]}, "has another camera for each image"),
        ({"camera_angle_x": 0.7, "frames": []}, "has an angle of view, and no fx, fy, cx, cy"),
        (FOUR | {"k0": 0.1}, "'k0' is a distortion in a form that is not read"),
        (FOUR | {"distortion": {"radial": [0.1, 0.2]}}, "'distortion' is a distortion in a form"),
        (FOUR | {"distortion": {"k1": 0, "b": [0.2]}}, "'distortion' is a distortion in a form"),
    ],
)
def test_what_would_be_read_in_part_is_refused(content: Any, told: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    with pytest.raises(BadData, match=rf"camera\.json: {told}"):
        read_camera_file(path)


@pytest.mark.parametrize(
    ("content", "model"),
    [
        (NERF | {"camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE"),
        (NERF | {"k4": 0.1}, "NeRF's k4"),
        (FOUR | {"model": "equidistant", "D": [0] * 4}, "equidistant"),
        (FOUR | {"model": "Kannala_Brandt4"}, "Kannala_Brandt4"),
        (
            FOUR | {"camera_model": "omni", "distortion_model": "radtan", "D": [0.1, 0, 0, 0]},
            "omni",
        ),
    ],
)
def test_a_lens_that_is_no_pinhole_is_none_where_its_coefficients_are_0(
    content: Any, model: str, tmp_path: Path
) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(content))
    for distorted in (False, True):  # typed beside the file, or not
        with pytest.raises(UserError, match=rf"tells a distortion \({model}\)"):
            read_intrinsics(str(path), distorted)


@pytest.mark.parametrize(
    ("line", "fy", "distortion"),
    [
        ("PINHOLE 640 480 600 601 320 240", 601, ()),
        ("SIMPLE_PINHOLE 640 480 600 320 240", 600, ()),
        ("SIMPLE_RADIAL 640 480 600 320 240 0.1", 600, (0.1, 0, 0, 0, 0)),
        ("RADIAL 640 480 600 320 240 0.1 -0.2", 600, (0.1, -0.2, 0, 0, 0)),
        ("OPENCV 640 480 600 601 320 240 0.1 -0.2 0.3 0.4", 601, (0.1, -0.2, 0.3, 0.4, 0)),
    ],
)
def test_a_camera_of_colmap_is_read(
    line: str, fy: float, distortion: tuple[float, ...], tmp_path: Path
) -> None:
    """The center of COLMAP's first pixel is at 0.5, not at 0."""
    path = tmp_path / "cameras.txt"
    path.write_text(f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {line}\n")
    camera = read_camera_file(path)
    np.testing.assert_array_equal(camera.K, [[600, 0, 319.5], [0, fy, 239.5], [0, 0, 1]])
    assert (camera.size, camera.distortion) == (SIZE, distortion)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("1 OPENCV_FISHEYE 640 480 6 6 3 2 0 0 0 0", "camera model OPENCV_FISHEYE is not read"),
        ("1 PINHOLE 640 480 6 6 3 2\n2 PINHOLE 640 480 6 6 3 2", "several cameras: 2 lines"),
        ("1 PINHOLE 640 480 6 6 3", "'parameters' has the wrong size"),
    ],
)
def test_other_cameras_of_colmap_are_refused(content: str, told: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text(content)
    with pytest.raises(BadData, match=told):
        read_camera_file(tmp_path / "cameras.txt")


def test_a_distortion_of_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "matlab.json"
    lens = {"RadialDistortion": [0.1, -0.2], "TangentialDistortion": [0, 0]}
    path.write_text(json.dumps(FOUR | lens))
    with pytest.raises(BadData, match=r"matlab.json: 'RadialDistortion' is a distortion in a form"):
        read_camera_file(path)
    path.write_text(json.dumps(FOUR | {"RadialDistortion": [0, 0], "distances": [1, 2]}))
    assert read_camera_file(path).distortion == ()


@pytest.mark.parametrize(
    "told",
    [
        {"resolution": [640, 480]},
        {"image_size": [480, 640]},
        {"imageSize": {"width": 640, "height": 480}},
        {"imageWidth": 640, "imageHeight": 480},
        {"img_size": [640, 480]},
    ],
)
def test_a_size_is_found_where_it_is_told(told: Any, tmp_path: Path) -> None:
    """An image of another size has other intrinsics."""
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(FOUR | told))
    assert read_camera_file(path).size == SIZE


def test_named_coefficients_of_0_are_no_distortion(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(FOUR | dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0)))
    np.testing.assert_array_equal(read_intrinsics(str(path)).K, K)


def test_coefficients_of_another_model_are_not_advised_as_opencvs(tmp_path: Path) -> None:
    path = tmp_path / "fisheye.yaml"
    lens = ROS.replace("[0, 0, 0, 0, 0]", "[-0.03, 0.01, -0.02, 0.005]")
    path.write_text(lens.replace("plumb_bob", "equidistant"))
    for distorted in (False, True):  # typed beside the file, or not
        with pytest.raises(UserError, match=r"tells a distortion \(equidistant\)") as caught:
            read_intrinsics(str(path), distorted)
        assert "distortion=-0.03" not in str(caught.value)
    (tmp_path / "kalibr.yaml").write_text(
        KALIBR.replace("0.0, 0.0", "0.1, 0.2", 1).replace("radtan", "equidistant")
    )
    with pytest.raises(UserError, match=r"tells a distortion \(equidistant\)"):
        read_intrinsics(str(tmp_path / "kalibr.yaml"))
    (tmp_path / "nerf.json").write_text(
        json.dumps(NERF | {"k1": 0.1, "camera_model": "OPENCV_FISHEYE"})
    )
    with pytest.raises(UserError, match=r"tells a distortion \(OPENCV_FISHEYE\)"):
        read_intrinsics(str(tmp_path / "nerf.json"))
    camera = tmp_path / "realsense.json"
    for model, known in (("brown_conrady", True), ("inverse_brown_conrady", False)):
        own = REALSENSE | {"model": f"distortion.{model}", "coeffs": [0.01, -0.02, 0, 0, 0]}
        camera.write_text(json.dumps(own))
        with pytest.raises(UserError) as caught:
            read_intrinsics(str(camera))
        assert ("distortion=0.01,-0.02,0,0,0" in str(caught.value)) == known
    camera.write_text(json.dumps(REALSENSE | {"model": "distortion.inverse_brown_conrady"}))
    np.testing.assert_array_equal(read_intrinsics(str(camera)).K, K)


def test_numbers_are_four_or_a_matrix() -> None:
    for typed in (
        "1066.778,1067.487,312.9869,241.3109",
        [*K.ravel()],
        "1066.778,0,312.9869,0,1067.487,241.3109,0,0,1",
    ):
        np.testing.assert_array_equal(read_intrinsics(typed).K, K)
    for wrong in ("1,2,3", [*K.T.ravel()], "none.json", "1,2,x,4", None):
        with pytest.raises(UserError, match=r"^intrinsics="):
            read_intrinsics(wrong)
    with pytest.raises(UserError, match=r"intrinsics=none\.json: no such file"):
        read_intrinsics("none.json")


def test_a_matrix_that_numpy_saved_is_read(tmp_path: Path) -> None:
    file = tmp_path / "K.npy"
    np.save(file, K)
    np.testing.assert_allclose(read_camera_file(file).K, K)
    np.save(file, [*FOUR.values()])
    np.testing.assert_allclose(read_camera_file(file).K, K)
    np.save(file, np.eye(4))
    with pytest.raises(BadData, match=r"K\.npy: holds no camera \(16 words; expected a matrix"):
        read_camera_file(file)
    text = tmp_path / "K.txt"
    for values, delimiter in ((K, " "), (K, ","), ([*FOUR.values()], " ")):
        np.savetxt(text, values, delimiter=delimiter, header="camera 1\nfx, 2020", footer="end")
        np.testing.assert_allclose(read_camera_file(text).K, K)
