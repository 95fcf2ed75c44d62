"""Bags in and out: the library's poses in ROS's conventions, and only what was there."""

import dataclasses
import io
import json
import math
import os
import signal
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

pytest.importorskip("rosbags", reason="needs the extra bags")

from rosbags.rosbag2 import Reader, StoragePlugin, Writer

import posefilter
from posefilter.cli import run_command
from posefilter.errors import UserError
from posefilter.geometry.pose import move_about
from posefilter.geometry.rotation import log_so3, quat_xyzw_from_matrix, random_rotation
from posefilter.ros.bags import BagReader, BagWriter, Topics
from posefilter.ros.detections import make_detections, to_ros_covariance
from posefilter.ros.messages import (
    CAMERA_INFO,
    COMPRESSED,
    DETECTIONS,
    IMAGE,
    decode_color,
    decode_depth,
    decode_intrinsics,
    make_message,
    open_types,
    rectify,
)

HOME = Path(__file__).parents[2]
SCENE = HOME / "docs" / "scenes" / "003_cracker_box" / "mixed" / "scene0000_0"
NAME = "003_cracker_box"
FEW = ["filter.particles=40", "filter.initial_particles=60", "filter.steps=3", "filter/refine=none"]
TOPICS = Topics("/rgb", "/depth", "/info")
TYPED = ["color=/rgb", "depth=/depth", "camera_info=/info"]


def read_scene() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color (H, W, 3) uint8, depth (H, W) uint16 [mm] and K (3, 3) of a scene that ships."""
    stem = min(SCENE.glob("*.left.jpg")).name.removesuffix(".left.jpg")
    rgb = np.ascontiguousarray(cv2.imread(str(SCENE / f"{stem}.left.jpg"))[..., ::-1])
    depth = cv2.imread(str(SCENE / f"{stem}.left.depth.png"), cv2.IMREAD_UNCHANGED) / 10
    (camera,) = json.loads((SCENE / "_camera_settings.json").read_text())["camera_settings"][:1]
    own = camera["intrinsic_settings"]
    K = np.array([[own["fx"], 0, own["cx"]], [0, own["fy"], own["cy"]], [0, 0, 1]])
    return rgb, depth.round().astype(np.uint16), K


def make_header(milliseconds: int) -> Any:
    seconds, rest = divmod(milliseconds, 1000)
    stamp = make_message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest * 1_000_000)
    return make_message("std_msgs/msg/Header", stamp=stamp, frame_id="camera_optical")


def make_image(pixels: np.ndarray, encoding: str, time: int = 0, **fields: Any) -> Any:
    height, width = pixels.shape[:2]
    row = pixels.reshape(height, -1).view(np.uint8).reshape(height, -1)
    given = {
        "header": make_header(time), "height": height, "width": width, "encoding": encoding,
        "is_bigendian": 0, "step": row.shape[1], "data": row.reshape(-1),
    }  # fmt: skip
    return make_message(IMAGE, **{**given, **fields})


def make_info(K: np.ndarray, width: int = 0, height: int = 0) -> Any:
    region = make_message(
        "sensor_msgs/msg/RegionOfInterest",
        x_offset=0, y_offset=0, height=0, width=0, do_rectify=False,
    )  # fmt: skip
    P = np.concatenate([K, np.zeros((3, 1))], axis=1)
    return make_message(
        CAMERA_INFO, header=make_header(0), height=height, width=width,
        distortion_model="plumb_bob", d=np.zeros(5), k=K.reshape(9), r=np.eye(3).reshape(9),
        p=P.reshape(12), binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip


def write_bag(path: Path, messages: list[tuple[str, str, int, Any]]) -> Path:
    """Write a bag of (topic, type, time [ms], message), and return its .mcap file."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {}
        for topic, kind, time, message in messages:
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=open_types())
            raw = open_types().serialize_cdr(message, kind)
            writer.write(topics[topic], time * 1_000_000, raw)
    (file,) = path.glob("*.mcap")
    return file


def write_scene(
    path: Path, depth_after: tuple[int, ...] = (5, 3), depth_share: float = 1.0, stray: int = 0
) -> Path:
    """Write a bag of one scene, once every 100 ms; the depth of each comes so many ms later. A few
    pixels have the depth `stray`, if it is not 0.
    """
    rgb, depth, K = read_scene()
    depth = (depth * depth_share).astype(np.uint16)
    if stray:
        depth[::40, ::40] = stray
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for number, after in enumerate(depth_after):
        time = 100 * (number + 1)
        messages += [
            ("/rgb", IMAGE, time, make_image(rgb, "rgb8", time)),
            ("/depth", IMAGE, time + after, make_image(depth, "16UC1", time + after)),
        ]
    return write_bag(path, messages)


def read_bag(path: Path) -> Iterator[tuple[str, int, bytes]]:
    with Reader(path) as reader:
        for connection, time, raw in reader.messages():
            yield connection.topic, time, bytes(raw)


def test_detections_are_the_librarys_results(tmp_path: Path, capfd) -> None:
    bag, out = write_scene(tmp_path / "in", (5, 3, 40)), tmp_path / "found.mcap"
    typed = [
        str(bag),
        str(out),
        f"checkpoint={NAME}",
        *TYPED,
        *FEW,
        "console=json",
        "copy_messages=true",
    ]
    assert run_command("convert_bag", HOME, typed) == 0
    assert '"images": 2' in capfd.readouterr().out
    stored = [*read_bag(out)]
    raw = [(time, raw) for topic, time, raw in stored if topic == "/detections"]
    assert [time for time, _ in raw] == [100_000_000, 200_000_000]  # the third has no depth near
    copied = sorted((topic, time, raw) for topic, time, raw in stored if topic != "/detections")
    assert copied == sorted(read_bag(bag))
    alone = tmp_path / "tracked.mcap"
    typed = [str(bag), str(alone), f"checkpoint={NAME}", *TYPED, *FEW, "track=true"]
    assert run_command("convert_bag", HOME, typed) == 0
    assert [(topic, time) for topic, time, _ in read_bag(alone)] == [
        ("/detections", 100_000_000), ("/detections", 200_000_000)
    ]  # fmt: skip
    found = open_types().deserialize_cdr(raw[1][1], DETECTIONS)
    assert (found.header.stamp.nanosec, found.header.frame_id) == (200_000_000, "camera_optical")
    rgb, depth, K = read_scene()
    estimator = posefilter.load(NAME, overrides=FEW, device="cpu")
    result = estimator.predict(rgb, depth.astype(np.float32) * np.float32(1e-3), K)
    (detection,) = found.detections
    pose = detection.results[0].pose
    place, turn = pose.pose.position, pose.pose.orientation
    np.testing.assert_allclose([place.x, place.y, place.z], result.pose[:3, 3], atol=1e-6)
    quaternion = quat_xyzw_from_matrix(torch.from_numpy(result.pose[:3, :3])).numpy()
    assert abs(np.dot([turn.x, turn.y, turn.z, turn.w], quaternion)) == pytest.approx(1, abs=1e-9)
    own = result.belief
    # that of the pose beside it, which is not the particles' mean
    wanted = to_ros_covariance(own.covariance_about(result.pose), result.pose, own.center)
    assert np.trace(wanted[:3, :3]) > 1.01 * np.trace(
        to_ros_covariance(own.covariance, own.mean, own.center)[:3, :3]
    )
    np.testing.assert_allclose(pose.covariance.reshape(6, 6), wanted, rtol=1e-6, atol=1e-12)
    assert detection.id == detection.results[0].hypothesis.class_id == NAME
    assert np.isnan(detection.results[0].hypothesis.score)  # another filter than was calibrated
    size = detection.bbox.size
    assert sorted([size.x, size.y, size.z]) == pytest.approx([0.07, 0.16, 0.21], abs=0.015)


def test_raw_images_are_rectified_as_the_camera_tells(tmp_path: Path, capfd) -> None:
    rgb, depth, K = read_scene()
    depth = depth.astype(np.uint16)
    new = K.copy()
    new[0, 0] *= 0.9
    images = [
        ("/rgb", IMAGE, 10, make_image(rgb, "rgb8", 10)),
        ("/depth", IMAGE, 12, make_image(depth, "16UC1", 12)),
    ]
    lens = np.array([-0.3, 0.1, 0.001, 0.0, 0.0])
    tell = {"d": lens, "p": np.concatenate([new, np.zeros((3, 1))], axis=1).reshape(12)}
    camera = dataclasses.replace(make_info(K), **tell)
    bag = write_bag(tmp_path / "in", [("/info", CAMERA_INFO, 0, camera), *images])
    with BagReader(bag, TOPICS, 0.01, rectify=True) as reader:
        (frame,) = reader.frames()
        assert not reader.distorted
    z = depth * np.float32(1e-3)
    color, z = posefilter.undistort(rgb, z, K, lens, new_intrinsics=new)
    assert np.array_equal(frame.rgb, color)
    assert np.array_equal(frame.depth, z)
    assert np.array_equal(frame.intrinsics, new)

    typed = [str(bag), str(tmp_path / "out.mcap"), f"checkpoint={NAME}", *TYPED, *FEW]
    assert run_command("convert_bag", HOME, typed) == 0
    assert "rectify=true" in capfd.readouterr().out
    typed[1] = str(tmp_path / "rectified.mcap")
    assert run_command("convert_bag", HOME, [*typed, "rectify=true"]) == 0
    assert "lens distortion" not in capfd.readouterr().out

    fisheye = {"distortion_model": "equidistant", "d": lens[:4]}
    own = dataclasses.replace(camera, **fisheye)
    bag = write_bag(tmp_path / "fisheye", [("/info", CAMERA_INFO, 0, own), *images])
    with BagReader(bag, TOPICS, 0.01, rectify=True) as reader:
        (frame,) = reader.frames()
    z = depth * np.float32(1e-3)
    color, _ = posefilter.undistort(rgb, z, K, lens[:4], fisheye=True, new_intrinsics=new)
    assert np.array_equal(frame.rgb, color)

    # no coefficients and no rotation told, but another matrix: zoomed, as ROS has it
    own = dataclasses.replace(camera, d=np.zeros(0), r=np.zeros(9))
    bag = write_bag(tmp_path / "zoomed", [("/info", CAMERA_INFO, 0, own), *images])
    with BagReader(bag, TOPICS, 0.01, rectify=True) as reader:
        (frame,) = reader.frames()
    color, _ = posefilter.undistort(rgb, z, K, (0.0,) * 4, new_intrinsics=new)
    assert np.array_equal(frame.rgb, color)
    assert not np.array_equal(frame.rgb, rgb)
    assert np.array_equal(frame.intrinsics, new)

    turned = cv2.Rodrigues(np.array([0, 0.1, 0]))[0].reshape(9)
    for number, (wrong, said) in enumerate(
        (
            ({"r": turned}, "stereo pair"),
            ({"distortion_model": "spiral"}, "spiral is not one of"),
            ({"k": np.zeros(9)}, "no matrix K"),
        )
    ):
        own = dataclasses.replace(camera, **wrong)
        bag = write_bag(tmp_path / str(number), [("/info", CAMERA_INFO, 0, own), *images])
        reader = BagReader(bag, TOPICS, 0.01, rectify=True)
        with reader, pytest.raises(UserError, match=said):
            [*reader.frames()]


def test_covariance_is_that_of_the_origin_and_turns_about_the_cameras_axes() -> None:
    torch.manual_seed(1)
    mean = torch.eye(4, dtype=torch.float64)
    mean[:3, :3], mean[:3, 3] = random_rotation(1)[0].double(), torch.tensor([0.1, 0.2, 0.9])
    center = torch.tensor([0.05, -0.1, 0.2], dtype=torch.float64)
    root = 1e-3 * torch.randn(6, 6, dtype=torch.float64)
    moved = move_about(
        mean.expand(20_000, 4, 4), torch.randn(20_000, 6, dtype=torch.float64) @ root.T, center
    )
    shift = moved[:, :3, 3] - mean[:3, 3]
    turn = log_so3(moved[:, :3, :3] @ mean[:3, :3].T)
    seen = np.cov(torch.cat([shift, turn], dim=1).numpy().T)
    ours = to_ros_covariance((root @ root.T).numpy(), mean.numpy(), center.numpy())
    np.testing.assert_allclose(ours, seen, atol=0.05 * np.abs(seen).max())


def test_what_is_absent_or_lost_is_no_detection() -> None:
    rgb, depth, K = read_scene()
    estimator = posefilter.load(NAME, overrides=FEW, device="cpu")
    result = estimator.predict(rgb, depth.astype(np.float32) * np.float32(1e-3), K)
    there = dataclasses.replace(result, probability=0.93, presence=0.99)
    gone = dataclasses.replace(result, probability=0.01, presence=0.02)
    assert (there.verdict, gone.verdict) == ("found", "absent")
    message = make_detections([there, gone], make_header(0))
    assert [one.results[0].hypothesis.score for one in message.detections] == [0.93]


def test_images_are_read_in_every_layout() -> None:
    draw = np.random.default_rng(0)
    rgb = draw.integers(0, 256, (6, 5, 3), dtype=np.uint8)
    padded = np.concatenate([rgb.reshape(6, 15), np.full((6, 4), 7, np.uint8)], axis=1)
    cases = [
        make_image(rgb, "rgb8"),
        make_image(np.ascontiguousarray(rgb[..., ::-1]), "bgr8"),
        make_image(np.dstack([rgb, rgb[..., :1]]), "rgba8"),
        make_image(rgb, "rgb8", step=19, data=padded.reshape(-1)),
    ]
    for message in cases:
        np.testing.assert_array_equal(decode_color(message, "/rgb"), rgb)
    png = cv2.imencode(".png", rgb[..., ::-1])[1].reshape(-1)
    packed = make_message(COMPRESSED, header=make_header(0), format="png", data=png)
    np.testing.assert_array_equal(decode_color(packed, "/rgb"), rgb)
    meters = np.float32([[0.5, np.nan, 1.25], [0, np.inf, -1]])
    kept = np.float32([[0.5, 0, 1.25], [0, 0, 0]])
    np.testing.assert_array_equal(decode_depth(make_image(meters, "32FC1"), "/d"), kept)
    big = np.array([[500, 0, 1250]], dtype=">u2")
    message = make_image(big, "16UC1", is_bigendian=1)
    np.testing.assert_allclose(decode_depth(message, "/d"), kept[:1], rtol=1e-6)
    K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
    np.testing.assert_array_equal(decode_intrinsics(make_info(K), (480, 640)), K)


def test_a_jpeg_that_says_it_is_turned_is_read_as_it_is_stored() -> None:
    """As the depth and the camera_info beside it."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3  # upside down
    stored, data = np.zeros((16, 32, 3), np.uint8), io.BytesIO()
    stored[:8] = 200
    Image.fromarray(stored).save(data, "JPEG", exif=exif)
    read = decode_color(make_compressed("rgb8; jpeg compressed bgr8", data.getvalue()), "/rgb")
    np.testing.assert_allclose(read, stored, atol=3)


@pytest.mark.parametrize(
    ("form", "swapped"),
    [
        ("rgb8; png compressed bgr8", False),
        ("rgb8; png compressed rgb8", True),
        ("bgr8; png compressed rgb8", True),
        ("rgb8; png compressed ", False),
        ("png", False),
    ],
)
def test_red_and_blue_are_where_the_format_says(form: str, swapped: bool) -> None:
    """The subscriber of `compressed` takes what is packed as `rgb8` for red first."""
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 0] = 250
    packed = cv2.imencode(".png", red if swapped else red[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(decode_color(make_compressed(form, packed), "/rgb"), red)


def make_png(width: int, height: int) -> bytes:
    """Return a PNG of one color whose header names another size."""
    data = bytearray(cv2.imencode(".png", np.zeros((2, 2, 3), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", width, height)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    return bytes(data)


def make_compressed(form: str, data: bytes) -> Any:
    fields = {"header": make_header(0), "format": form, "data": np.frombuffer(data, np.uint8)}
    return make_message(COMPRESSED, **fields)


def test_compressed_depth_is_read() -> None:
    """As compressed_depth_image_transport writes it: a header of 12 bytes, and a PNG."""
    millimeters = np.uint16([[500, 0, 1250], [65535, 2, 9000]])
    wanted = np.float32([[0.5, 0, 1.25], [0, 0.002, 9]])
    png = cv2.imencode(".png", millimeters)[1].tobytes()
    plain, header = make_image(millimeters, "16UC1"), struct.pack("<iff", 0, 0, 0)
    for message in (
        plain,
        make_compressed("16UC1; compressedDepth png", header + png),
        make_compressed("16UC1; compressedDepth", header + png),
        make_compressed("16UC1; png compressed ", png),
    ):
        np.testing.assert_allclose(decode_depth(message, "/d"), wanted, rtol=1e-6)
    a, b = 100 * 101.0, 1 - 100 * 101 / 10  # its defaults: quantization 100, at most 10 m
    kept = np.where(wanted > 1, a / np.maximum(wanted, 1) + b, 0).round().astype(np.uint16)
    data = struct.pack("<iff", 0, a, b) + cv2.imencode(".png", kept)[1].tobytes()
    found = decode_depth(make_compressed("32FC1; compressedDepth png", data), "/d")
    np.testing.assert_allclose(found, np.where(wanted > 1, wanted, 0), rtol=0.01)


@pytest.mark.parametrize(
    ("form", "data", "told"),
    [
        ("16UC1; compressedDepth rvl", bytes(40), "format '16UC1; compressedDepth rvl' is not"),
        ("jpeg", cv2.imencode(".png", np.zeros((2, 2), np.uint16))[1].tobytes(), "format 'jpeg'"),
        ("16UC1; png compressed ", make_png(2, 2), r"uint8 \(2, 2, 3\), not 16 bits"),
        ("16UC1; compressedDepth png", bytes(12) + make_png(2, 2)[:-20], "the PNG has no end"),
        ("16UC1; compressedDepth png", b"", "is not known"),
    ],
)
def test_compressed_depth_that_cannot_be_read_is_named(form: str, data: bytes, told: str) -> None:
    with pytest.raises(UserError, match=f"^depth=/d: .*{told}"):
        decode_depth(make_compressed(form, data), "/d")


def test_a_camera_that_is_not_calibrated_is_named() -> None:
    with pytest.raises(UserError, match="camera_info=/info: the camera is not calibrated"):
        decode_intrinsics(make_info(np.zeros((3, 3))), (480, 640), "/info")


@pytest.mark.parametrize("told", [True, False])
def test_a_region_of_interest_and_binning_move_the_matrix(told: bool) -> None:
    """The matrices of a CameraInfo are of the whole sensor, those of an image of its part."""
    K = np.array([[600.0, 0, 330], [0, 620, 250], [0, 0, 1]])
    info = make_info(K, *((640, 480) if told else ()))
    point = np.array([0.05, 0.03, 0.8])
    whole = (K @ point / point[2])[:2]
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 100, 60, 320, 240
    for binning, size in (((0, 0), (240, 320)), ((2, 4), (60, 160))):
        info.binning_x, info.binning_y = binning
        part = decode_intrinsics(info, size)
        seen = (part @ point / point[2])[:2]
        np.testing.assert_allclose(seen, (whole - [100, 60]) / np.maximum(binning, 1))
        assert part[2].tolist() == [0, 0, 1]
        with pytest.raises(UserError, match=f"is of images of {size[1]}x{size[0]} pixels"):
            decode_intrinsics(info, (size[0], size[1] + 1))
    # a driver that tells the size and the matrix of the image itself, and the binning beside it
    if told:
        np.testing.assert_array_equal(decode_intrinsics(info, (480, 640)), K)
    own = make_info(K, *((640, 480) if told else ()))
    own.binning_x = own.binning_y = 2
    half = decode_intrinsics(own, (240, 320))
    np.testing.assert_allclose(half[:2], K[:2] / 2)


def test_a_part_of_a_raw_image_is_rectified_about_its_own_axis() -> None:
    rgb, depth, K = read_scene()
    depth = depth.astype(np.float32)
    lens = (-0.3, 0.1, 0.0, 0.0, 0.0)
    height, width = depth.shape
    info = dataclasses.replace(make_info(K, width, height), d=np.array(lens))
    whole, _ = rectify(rgb, depth, info)
    info.roi.x_offset, info.roi.y_offset = 40, 20
    info.roi.width, info.roi.height = width - 80, height - 50
    cut = np.s_[20 : height - 30, 40 : width - 40]
    part, z = rectify(rgb[cut], depth[cut], info)
    inner = np.s_[30:-30, 30:-30]  # what the part shows of the whole
    assert part.shape[:2] == z.shape
    # by as much as interpolation rounds
    assert np.abs(part[inner].astype(int) - whole[cut][inner]).max() <= 2


@pytest.mark.parametrize(
    "broken",
    [
        {"encoding": "bayer_rggb16"}, {"data": np.zeros(3, np.uint8)}, {"step": 2}, {"width": 0},
        {"height": 2**31},
    ],
)  # fmt: skip
def test_a_damaged_image_is_named(broken: dict[str, Any]) -> None:
    message = dataclasses.replace(make_image(np.zeros((4, 4, 3), np.uint8), "rgb8"), **broken)
    with pytest.raises(UserError, match="color=/rgb"):
        decode_color(message, "/rgb")


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "the file is empty"),
        (make_png(2, 2)[:-20], "the PNG has no end"),
        (make_png(60_000, 60_000), "image too large"),
    ],
    ids=["empty", "cut off", "a bomb"],
)
def test_a_damaged_compressed_image_is_named(data: bytes, told: str, capfd) -> None:
    fields = {"header": make_header(0), "format": "png"}
    message = make_message(COMPRESSED, **fields, data=np.frombuffer(data, np.uint8))
    with pytest.raises(UserError, match=f"^color=/rgb: .*{told}"):
        decode_color(message, "/rgb")
    assert capfd.readouterr().err == ""


def test_a_bag_that_claims_more_than_the_memory_has_is_named(tmp_path: Path) -> None:
    """The record after a file's magic bytes is its header: a byte of its kind, then its length."""
    content = bytearray(write_scene(tmp_path / "in").read_bytes())
    content[9:17] = struct.pack("<Q", 1 << 60)
    (tmp_path / "bag.mcap").write_bytes(content)
    with pytest.raises(UserError, match=r"bag\.mcap: cannot be read as a ROS 2 bag \("):
        BagReader(tmp_path / "bag.mcap", TOPICS, 0.01)


def test_a_bag_that_was_being_written_is_in_nobodys_way(tmp_path: Path) -> None:
    """Of a process that was killed nothing is left; beside one that lives there is no second."""
    path = tmp_path / "out.mcap"
    number = os.fork()
    if number == 0:
        BagWriter(path, "/d").__enter__()
        os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(number, 0)
    assert [one.name for one in tmp_path.iterdir()] == [".out.mcap.part"]
    with BagWriter(path, "/d"):
        number = os.fork()
        if number == 0:
            with suppress(UserError):
                BagWriter(path, "/d")
                os._exit(1)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(number, 0)[1]) == 0
    assert [one.name for one in tmp_path.iterdir()] == ["out.mcap"]


def test_each_image_has_the_depth_nearest_in_time(tmp_path: Path) -> None:
    K = np.array([[100.0, 0, 2], [0, 100, 2], [0, 0, 1]])
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for number in range(6):
        color = np.full((4, 4, 3), number, np.uint8)
        depth = np.full((4, 4), 1000 + number, np.uint16)
        time = 33 * (number + 1)
        messages.append(("/rgb", IMAGE, time, make_image(color, "rgb8", time)))
        if number != 3:  # which has none
            # it arrives late, after the next image
            messages.append(("/depth", IMAGE, time + 40, make_image(depth, "16UC1", time + 4)))
    bag = write_bag(tmp_path / "in", sorted(messages, key=lambda one: one[2]))
    with BagReader(bag, TOPICS, 0.01) as reader:
        frames = [*reader.frames()]
        assert reader.unpaired == 1
    pairs = [(int(one.rgb[0, 0, 0]), round(float(one.depth[0, 0]) * 1000)) for one in frames]
    assert pairs == [(number, 1000 + number) for number in (0, 1, 2, 4, 5)]


@pytest.mark.parametrize(
    ("stamps", "tolerance", "wanted"),
    [
        # depth faster than color: the first within the tolerance is not the nearest
        (["c8", "d0", "d8", "c41", "d33", "d41"], 0.01, [(8, 8), (41, 41)]),
        (["d0", "d8", "c8", "c41", "d44"], 0.01, [(8, 8), (41, 44)]),
        # color faster than depth: the depth is the later image's
        (["c0", "d15", "c16", "c33", "c49", "d48"], 0.02, [(16, 15), (49, 48)]),
        (["c0", "c30", "d9", "d39"], 0.01, [(0, 9), (30, 39)]),
    ],
)
def test_color_and_depth_are_nearest_to_one_another(
    stamps: list[str], tolerance: float, wanted: list[tuple[int, int]], tmp_path: Path
) -> None:
    """Whatever is recorded first."""
    K = np.array([[100.0, 0, 2], [0, 100, 2], [0, 0, 1]])
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for order, (topic, time) in enumerate([(one[0], int(one[1:])) for one in stamps], 1):
        color = np.full((4, 4, 3), time, np.uint8)
        image = make_image(color, "rgb8", time)
        if topic == "d":
            image = make_image(np.full((4, 4), 1000 + time, np.uint16), "16UC1", time)
        messages.append(("/rgb" if topic == "c" else "/depth", IMAGE, order, image))
    with BagReader(write_bag(tmp_path / "in", messages), TOPICS, tolerance) as reader:
        frames = [*reader.frames()]
        assert reader.unpaired == sum(one[0] == "c" for one in stamps) - len(wanted)
    depths = [round(float(one.depth[0, 0]) * 1000) - 1000 for one in frames]
    assert [*zip([int(one.rgb[0, 0, 0]) for one in frames], depths, strict=True)] == wanted


def write_marked(path: Path, order: list[tuple[str, int, int]]) -> Path:
    """Write a bag of small images: color (`c`) or depth (`d`), the header's time and that of the
    recording [ms]; depth is the header's time [mm], and color its number.
    """
    K = np.array([[100.0, 0, 2], [0, 100, 2], [0, 0, 1]])
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for kind, time, recorded in order:
        image = make_image(np.full((4, 4), 1000 + time, np.uint16), "16UC1", time)
        if kind == "c":
            image = make_image(np.full((4, 4, 3), time // 33, np.uint8), "rgb8", time)
        messages.append(("/rgb" if kind == "c" else "/depth", IMAGE, recorded, image))
    return write_bag(path, sorted(messages, key=lambda one: one[2]))


def test_depth_may_be_recorded_seconds_after_its_color(tmp_path: Path) -> None:
    """As by a node that aligns it and lags; what comes later is counted, and the reason says so."""
    times = [33 * number for number in range(1, 101)]
    order = [(kind, t, t + 2000 * (kind == "d")) for t in times for kind in "cd"]
    with BagReader(write_marked(tmp_path / "in", order), TOPICS, 0.01) as reader:
        frames = [*reader.frames()]
        assert reader.unpaired == 0
    assert [int(one.rgb[0, 0, 0]) for one in frames] == [*range(1, 101)]
    late = [(kind, t, t + 9000 * (kind == "d")) for t in times for kind in "cd"]
    with BagReader(write_marked(tmp_path / "late", late), TOPICS, 0.01) as reader:
        assert not [*reader.frames()]
        assert reader.unpaired == 100
        assert "depth within max_time_difference=0.01 s that was recorded within 5 s of it" in (
            reader.explain_none()
        )


def test_what_waits_is_bounded_in_memory(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("posefilter.ros.bags._MEMORY", 40 * 48)  # 40 small color images
    times = [33 * number for number in range(1, 101)]
    order = [(kind, t, t + 2000 * (kind == "d")) for t in times for kind in "cd"]
    with BagReader(write_marked(tmp_path / "in", order), TOPICS, 0.01) as reader:
        frames = [*reader.frames()]
        assert reader.unpaired == 100 - len(frames)
        assert 30 < len(frames) < 100


def test_images_that_were_recorded_in_another_order_come_in_that_of_time(tmp_path: Path) -> None:
    order = [("c", 33, 1), ("c", 0, 2), ("d", 0, 3), ("d", 33, 4), ("c", 66, 66), ("d", 66, 67)]
    with BagReader(write_marked(tmp_path / "in", order), TOPICS, 0.01) as reader:
        assert [int(one.rgb[0, 0, 0]) for one in reader.frames()] == [0, 1, 2]


@pytest.mark.slow
def test_mistakes_are_one_line(tmp_path: Path, capfd) -> None:
    bag = write_scene(tmp_path / "in", (50,))
    near = write_scene(tmp_path / "near", (5,), depth_share=0.01)
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(bag.read_bytes()[: bag.stat().st_size // 2])
    (tmp_path / "there.mcap").write_text("mine")
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "killed_0.mcap").write_bytes(bag.read_bytes())
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(4096))
    cases = [
        ([str(bag)], ["color=/nothing"], "/rgb (sensor_msgs/msg/Image)"),
        ([str(bag)], ["color=/info"], "has type sensor_msgs/msg/CameraInfo"),
        ([str(bag)], ["depth=/rgb"], "depth=/rgb: is the topic of color, too"),
        ([str(bag)], [], "within max_time_difference=0.01 s; the nearest is 0.05 s away"),
        ([str(bag)], ["on_error=maybe"], "choose raise or skip"),
        ([str(broken)], [], "it was cut off; `mcap recover` saves"),
        ([str(tmp_path / "killed")], [], "it has no metadata.yaml, as after a recorder that was"),
        ([str(tmp_path / "old.bag")], [], "it is of ROS 1"),
        ([str(tmp_path / "no.mcap")], [], "no such file"),
        ([str(bag), str(tmp_path / "there.mcap")], [], "already exists"),
        ([str(bag), str(tmp_path / "new.db3")], [], "bags are written as MCAP"),
        ([str(bag)], ["track=maybe"], "choose true or false"),
        ([str(bag)], ["detections=my topic"], "is no name of a topic"),
        ([str(near)], [], "image of 0.100 s: depth: the median would be 0.01"),
    ]
    for places, settings, said in cases:
        places = places if len(places) == 2 else [*places, str(tmp_path / "new.mcap")]
        typed = [*places, f"checkpoint={NAME}", *TYPED, *FEW, *settings]
        assert run_command("convert_bag", HOME, typed) == 2, said
        error = capfd.readouterr().err.strip()
        assert said in error
        assert "\n" not in error
    assert [*tmp_path.glob("new.*")] == []
    assert [one.name for one in tmp_path.glob(".*")] == []
    assert (tmp_path / "there.mcap").read_text() == "mine"


def test_a_camera_of_another_image_is_named_and_early_images_are_counted(tmp_path: Path) -> None:
    rgb, depth, K = read_scene()
    color, z = make_image(rgb, "rgb8"), make_image(depth, "16UC1")
    height, width = depth.shape
    images = [("/rgb", IMAGE, 2, color), ("/depth", IMAGE, 3, z)]
    info = ("/info", CAMERA_INFO, 1, make_info(K, width, height))
    early = [("/rgb", IMAGE, 0, color), ("/depth", IMAGE, 0, z)]
    for name, messages, counts in (
        ("a", [*early, info, *images], (1, 1, 0)),
        ("c", [early[0], info, images[1]], (1, 0, 0)),  # its depth comes when the camera is known
        ("d", [early[1], info, images[0]], (1, 0, 0)),
        ("e", [early[0], info, ("/depth", IMAGE, 9, make_image(depth, "16UC1", 900))], (0, 0, 1)),
    ):
        with BagReader(write_bag(tmp_path / name, messages), TOPICS, 0.1) as reader:
            assert (len([*reader.frames()]), reader.early, reader.unpaired) == counts
    other = [("/info", CAMERA_INFO, 1, make_info(K, 2 * width, 2 * height))]
    with (
        BagReader(write_bag(tmp_path / "b", [*other, *images]), TOPICS, 0.1) as reader,
        pytest.raises(UserError, match=rf"/info: is of images of {2 * width}x{2 * height} pixels"),
    ):
        list(reader.frames())


@pytest.mark.parametrize("stray", [0, 20, 900])
def test_an_image_without_depth_has_no_object(stray: int, tmp_path: Path, capfd) -> None:
    """A camera that starts or is covered sends some, with noise: they end no conversion."""
    bag = write_scene(tmp_path / "in", depth_share=0, stray=stray)
    out = tmp_path / "found.mcap"
    typed = [str(bag), str(out), f"checkpoint={NAME}", *TYPED, *FEW]
    assert run_command("convert_bag", HOME, typed) == 0
    assert "warning: 2 of 2 images have no depth, or one color" in capfd.readouterr().out
    found = [open_types().deserialize_cdr(raw, DETECTIONS) for _, _, raw in read_bag(out)]
    assert [len(one.detections) for one in found] == [0, 0]


def test_a_bag_can_be_played_by_humble(tmp_path: Path) -> None:
    """From version 9 on quality of service is a list in the metadata, which Humble cannot read."""
    with BagWriter(tmp_path / "out", "/found") as writer:
        writer.write(make_detections([], make_header(5)), 5)
    metadata = (tmp_path / "out" / "metadata.yaml").read_text()
    assert "version: 8\n" in metadata
    assert "offered_qos_profiles: ''" in metadata


def test_a_topic_of_several_connections_is_copied(tmp_path: Path) -> None:
    """As of a merged bag, or a recorder that keeps one for each publisher."""
    message = open_types().serialize_cdr(make_image(np.zeros((2, 2, 3), np.uint8), "rgb8"), IMAGE)
    with Writer(tmp_path / "in", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        first = writer.add_connection("/rgb", IMAGE, typestore=open_types())
        writer.write(first, 1, message)
    second = first._replace(id=first.id + 1)
    with BagWriter(tmp_path / "out", "/found") as out:
        out.add_connections([first, second])
        out.copy(iter([(first, 1, message), (second, 2, message)]))
    assert [one[:2] for one in read_bag(tmp_path / "out")] == [("/rgb", 1), ("/rgb", 2)]


def test_copies_have_the_definitions_that_a_bag_of_humble_lacks(tmp_path: Path) -> None:
    """A viewer of MCAP reads no message without; of a type that is not ROS's own there is none."""
    with Writer(tmp_path / "in", version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        known = writer.add_connection("/rgb", IMAGE, typestore=open_types())
        bare = known._replace(msgdef=known.msgdef._replace(data=""), digest="")
        own = bare._replace(id=2, topic="/own", msgtype="own_msgs/msg/Own")
        writer.write(known, 1, b"")
    with BagWriter(tmp_path / "out", "/found") as out:
        out.add_connections([bare, own])
    with Reader(tmp_path / "out") as reader:
        written = {one.topic: one for one in reader.connections}
    assert "uint32 height" in written["/rgb"].msgdef.data
    assert written["/rgb"].digest == known.digest
    assert written["/own"].msgdef.data == ""


def test_a_topic_that_is_there_is_refused_before_the_work(
    tmp_path: Path, capfd, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = write_scene(tmp_path / "in")
    monkeypatch.delattr(posefilter.Estimator, "predict_batch")
    typed = [
        *(str(bag), str(tmp_path / "out.mcap"), f"checkpoint={NAME}", *TYPED, *FEW),
        *("copy_messages=true", "detections=/rgb"),
    ]
    assert run_command("convert_bag", HOME, typed) == 2
    assert "the bag has this topic already" in capfd.readouterr().err


def test_progress_counts_every_color_image(
    tmp_path: Path, bar_tasks: Callable[[str], list[Any]]
) -> None:
    """Also those without depth, so that the bar comes to its end."""
    seen = bar_tasks("posefilter.cli.convert_bag.bars")
    bag = write_scene(tmp_path / "in", (5, 3))
    typed = [str(bag), str(tmp_path / "out.mcap"), f"checkpoint={NAME}", *TYPED, *FEW]
    assert run_command("convert_bag", HOME, typed) == 0
    assert [(one.completed, one.total) for one in seen] == [(2, 2)]


def test_mosaics_and_yuv_become_color() -> None:
    """A flat color in each layout; a mosaic's rows begin as its name does."""
    red, green, blue = 200, 120, 40
    flat = np.full((8, 8, 3), (red, green, blue), np.uint8)
    of = {"r": red, "g": green, "b": blue}
    for letters in ("rggb", "bggr", "gbrg", "grbg"):
        tile = np.array([of[letter] for letter in letters], np.uint8).reshape(2, 2)
        mosaic, name = np.tile(tile, (4, 4)), f"bayer_{letters}8"
        np.testing.assert_array_equal(decode_color(make_image(mosaic, name), "/c"), flat)
        png = cv2.imencode(".png", mosaic)[1].tobytes()
        packed = make_compressed(f"{name}; png compressed ", png)
        np.testing.assert_array_equal(decode_color(packed, "/c"), flat)
        color = cv2.imencode(".png", flat[..., ::-1])[1].tobytes()  # as image_transport packs it
        packed = make_compressed(f"{name}; png compressed bgr8", color)
        np.testing.assert_array_equal(decode_color(packed, "/c"), flat)
    red_blue = 0.299 * red + 0.587 * green + 0.114 * blue  # BT.601, of 16 to 235 and 16 to 240
    y = 16 + 219 / 255 * red_blue
    u = 128 + 112 / 255 * (blue - red_blue) / 0.886
    v = 128 + 112 / 255 * (red - red_blue) / 0.701
    yuyv = np.tile(np.array([[y, u], [y, v]]).round().astype(np.uint8), (8, 4, 1))
    layouts = {
        "yuv422_yuy2": yuyv,
        "yuyv": yuyv,
        "yuv422": yuyv[..., ::-1],
        "uyvy": yuyv[..., ::-1],
    }
    for name, packed in layouts.items():
        message = make_image(np.ascontiguousarray(packed), name)
        assert np.abs(decode_color(message, "/c").astype(int) - flat).max() <= 2
        with pytest.raises(UserError, match="of an odd width"):
            decode_color(make_image(np.ascontiguousarray(yuyv[:, :7]), name), "/c")
    depth = cv2.imencode(".png", np.full((8, 8), 1000, np.uint16))[1].tobytes()
    with pytest.raises(UserError, match="is of depth, not of color"):
        decode_color(make_compressed("16UC1; png compressed ", depth), "/c")


def test_depth_may_be_in_other_units() -> None:
    tenths = np.array([[5000, 0, 12500]], np.uint16)
    meters = np.float32([[0.5, 0, 1.25]])
    found = decode_depth(make_image(tenths, "16UC1"), "/d", units=10_000)
    np.testing.assert_allclose(found, meters, rtol=1e-6)
    np.testing.assert_array_equal(decode_depth(make_image(meters, "32FC1"), "/d", 10_000), meters)
    png = bytes(12) + cv2.imencode(".png", tenths)[1].tobytes()
    packed = make_compressed("16UC1; compressedDepth", png)
    np.testing.assert_allclose(decode_depth(packed, "/d", 10_000), meters, rtol=1e-6)


def test_images_without_times_are_paired_by_the_time_of_recording(tmp_path: Path) -> None:
    """By their headers any color and any depth would be of one moment."""
    K = np.array([[100.0, 0, 2], [0, 100, 2], [0, 0, 1]])
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for number in range(8):
        color = make_image(np.full((4, 4, 3), number, np.uint8), "rgb8")
        messages.append(("/rgb", IMAGE, 100 * number, color))
        if number % 2 == 0:
            depth = make_image(np.full((4, 4), 1000 + number, np.uint16), "16UC1")
            messages.append(("/depth", IMAGE, 100 * number + 4, depth))
    with BagReader(write_bag(tmp_path / "in", messages), TOPICS, 0.01) as reader:
        pairs = [
            (int(one.rgb[0, 0, 0]), round(1000 * float(one.depth[0, 0])) - 1000)
            for one in reader.frames()
        ]
        assert pairs == [(0, 0), (2, 2), (4, 4), (6, 6)]
        (told,) = reader.warnings
        assert told.startswith("headers of /rgb have no time")


def read_pairs(path: Path) -> tuple[list[tuple[int, int]], list[str]]:
    """Return the numbers of the color and of the depth image of each pair, and the warnings."""
    with BagReader(path, TOPICS, 0.01) as reader:
        pairs = [
            (int(one.rgb[0, 0, 0]), round(1000 * float(one.depth[0, 0])) - 1000)
            for one in reader.frames()
        ]
        return pairs, reader.warnings


def make_stream(first: int, times: Sequence[int], lag: int, stamped: bool) -> list[Any]:
    """Return messages of numbered images, each depth image `lag` ms after its color."""
    stream = []
    for number, time in enumerate(times):
        rgb, depth = np.full((4, 4, 3), number, np.uint8), np.full((4, 4), 1000 + number, np.uint16)
        stamps = (time, time + lag) if stamped else (0, 0)
        if number >= first:
            stream.append(("/rgb", IMAGE, time, make_image(rgb, "rgb8", stamps[0])))
        stream.append(("/depth", IMAGE, time + lag, make_image(depth, "16UC1", stamps[1])))
    return sorted(stream, key=lambda one: one[2])


def test_images_without_times_that_alternate_are_paired_by_recording(tmp_path: Path) -> None:
    info = ("/info", CAMERA_INFO, 0, make_info(np.float64([[100, 0, 2], [0, 100, 2], [0, 0, 1]])))
    times = range(100, 600, 100)
    # the bag begins with a depth image whose color came before
    bag = write_bag(tmp_path / "a", [info, *make_stream(1, times, 2, stamped=False)])
    pairs, warnings = read_pairs(bag)
    assert pairs == [(1, 1), (2, 2), (3, 3), (4, 4)]
    assert "have no time" in warnings[0]
    bag = write_bag(tmp_path / "b", [info, *make_stream(0, times, 49, stamped=False)])
    assert read_pairs(bag)[0] == []
    # a single pair
    bag = write_bag(tmp_path / "c", [info, *make_stream(0, [100], 2, stamped=False)])
    pairs, warnings = read_pairs(bag)
    assert (pairs, len(warnings)) == ([(0, 0)], 1)
    # a simulation's clock begins at 0
    bag = write_bag(tmp_path / "d", [info, *make_stream(0, range(0, 300, 100), 0, stamped=True)])
    assert read_pairs(bag) == ([(0, 0), (1, 1), (2, 2)], [])


def test_depth_of_another_frame_is_told(tmp_path: Path) -> None:
    rgb, depth, K = read_scene()
    aligned, far = make_image(depth, "16UC1", 2), make_image(depth, "16UC1", 2)
    far.header.frame_id = "camera_depth_optical"
    color = make_image(rgb, "rgb8", 1)
    messages = [("/info", CAMERA_INFO, 0, make_info(K)), ("/rgb", IMAGE, 1, color)]
    warnings = []
    for name, image in (("a", aligned), ("b", far)):
        bag = write_bag(tmp_path / name, [*messages, ("/depth", IMAGE, 2, image)])
        with BagReader(bag, TOPICS, 0.01) as reader:
            assert len([*reader.frames()]) == 1
            warnings.append(reader.warnings)
    told = "depth=/depth is of the frame camera_depth_optical, the color of camera_optical: is it"
    assert warnings == [[], [f"{told} aligned to the color?"]]


@pytest.mark.slow
def test_a_wrong_unit_of_depth_is_told_and_no_probability_is_written(tmp_path: Path, capfd) -> None:
    bag, out = write_scene(tmp_path / "in", depth_share=1.4), tmp_path / "found.mcap"
    typed = [f"checkpoint={NAME}", *TYPED, "threads=1"]
    assert run_command("convert_bag", HOME, [str(bag), str(out), *typed]) == 0
    assert capfd.readouterr().out.count("times as large as its mesh") == 1  # once is enough
    scores = list_scores(out)
    assert len(scores) == 2
    assert all(map(math.isnan, scores))
    right = tmp_path / "right.mcap"
    assert run_command("convert_bag", HOME, [str(bag), str(right), *typed, "depth_scale=1400"]) == 0
    assert "times as large" not in capfd.readouterr().out
    assert [score > 0.8 for score in list_scores(right)] == [True, True]


def list_scores(bag: Path) -> list[float]:
    """Return the score of each detection of a bag."""
    found = [open_types().deserialize_cdr(raw, DETECTIONS) for _, _, raw in read_bag(bag)]
    return [one.results[0].hypothesis.score for each in found for one in each.detections]


def test_a_damaged_image_ends_nothing_that_was_found_before_it(tmp_path: Path, capfd) -> None:
    rgb, depth, K = read_scene()
    messages = [("/info", CAMERA_INFO, 0, make_info(K))]
    for time in (100, 200, 300):
        color = make_image(rgb, "rgb8", time)
        color = dataclasses.replace(color, step=3) if time == 200 else color
        messages += [("/rgb", IMAGE, time, color)]
        messages += [("/depth", IMAGE, time, make_image(depth, "16UC1", time))]
    bag = write_bag(tmp_path / "in", messages)
    typed = [f"checkpoint={NAME}", *TYPED, *FEW]
    assert run_command("convert_bag", HOME, [str(bag), str(tmp_path / "out.mcap"), *typed]) == 2
    error = capfd.readouterr().err
    assert "image of 0.200 s: color=/rgb: an image of" in error
    assert "on_error=skip leaves such images out; the 1 images before it are in" in error
    assert [time for _, time, _ in read_bag(tmp_path / "out.mcap")] == [100_000_000]
    typed = [str(bag), str(tmp_path / "all.mcap"), *typed, "on_error=skip"]
    assert run_command("convert_bag", HOME, typed) == 0
    assert "warning: 1 messages were left out; the first: bag=" in capfd.readouterr().out
    assert [time for _, time, _ in read_bag(tmp_path / "all.mcap")] == [100_000_000, 300_000_000]


def test_a_camera_without_distortion_is_rectified_by_any_model() -> None:
    rgb, depth, K = read_scene()
    info = dataclasses.replace(make_info(K), distortion_model="inverse_brown_conrady")
    assert rectify(rgb, depth, info)[0] is rgb
    wrong = dataclasses.replace(make_info(K), d=np.array([0.1, -0.2, 0.0]))
    told = r"^camera_info=/i: distortion=\[0.1, -0.2, 0.0\]: expected 4"
    with pytest.raises(UserError, match=told):
        rectify(rgb, depth, wrong, "/i")
