"""The example of a live node, with stand-ins for ROS's packages."""

import runpy
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="needs the extra bags")

from tests.ros.test_bags import FEW, NAME, make_header, make_image, make_info, read_scene

import posefilter
from posefilter.api import load
from posefilter.ros.detections import make_detections

FILE = Path(__file__).parents[2] / "examples" / "ros" / "node.py"


class Message(SimpleNamespace):
    """Any message: fields that were not given are messages."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        setattr(self, name, Message())
        return getattr(self, name)


class Topic:
    """A subscriber or a synchronizer: hands on what it is given."""

    def __init__(self, *given: Any, **_: Any) -> None:
        self.given, self.callbacks = given, []

    def registerCallback(self, callback: Callable[..., None]) -> None:  # noqa: N802
        self.callbacks.append(callback)

    def send(self, *messages: Any) -> None:
        for one in self.callbacks:
            one(*messages)


class Node:
    """A node whose messages and log are lists."""

    def __init__(self, name: str) -> None:
        self.published: list[Any] = []
        self.log: list[str] = []
        self.context = SimpleNamespace(ok=lambda: True)

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=default)

    def create_publisher(self, *_: Any) -> Any:
        return SimpleNamespace(publish=self.published.append)

    def create_timer(self, seconds: float, callback: Callable[[], None]) -> None: ...

    def get_logger(self) -> Any:
        def say(sentence: str, **_: Any) -> None:
            self.log.append(sentence)

        return SimpleNamespace(error=say, warning=say)

    def destroy_node(self) -> None: ...


class Stopped(Exception):  # noqa: N818
    """What a signal raises in rclpy."""


class Tracker:
    """Counts images by their first pixel; each waits until it may go on."""

    def __init__(self, _: Any) -> None:
        self.may_go, self.started = threading.Semaphore(0), threading.Semaphore(0)
        self.seen: list[int] = []
        self.closed = False

    def update_all(self, rgb: np.ndarray, depth: np.ndarray, K: np.ndarray) -> list[Any]:
        self.started.release()
        assert self.may_go.acquire(timeout=60)
        self.seen.append(int(rgb[0, 0, 0]))
        return []

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return what the example defines."""

    def fail() -> None:
        raise RuntimeError("rcl_shutdown already called on the given context")

    def spin(node: Any) -> None:
        raise Stopped

    message = {"__getattr__": lambda name: Message}
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {
            "init": lambda: None, "spin": spin, "shutdown": fail, "try_shutdown": lambda: None
        },
        "rclpy.executors": {"ExternalShutdownException": Stopped},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "message_filters": {"Subscriber": Topic, "ApproximateTimeSynchronizer": Topic},
        **{f"{name}_msgs": {} for name in ("geometry", "sensor", "vision")},
        **{f"{name}_msgs.msg": message for name in ("geometry", "sensor", "vision")},
    }  # fmt: skip
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(posefilter, "load", lambda names: names, raising=False)
    monkeypatch.setattr(posefilter, "Tracker", Tracker, raising=False)
    return runpy.run_path(str(FILE))


def make_messages(number: int) -> tuple[Any, Any, Any]:
    color, depth = np.full((4, 4, 3), number, np.uint8), np.full((4, 4), 900, np.uint16)
    return make_image(color, "rgb8"), make_image(depth, "16UC1"), make_info(np.eye(3))


def test_the_newest_images_are_answered(example: dict[str, Any]) -> None:
    node = example["PoseNode"]()
    try:
        node.sync.send(*make_messages(0))
        assert node.tracker.started.acquire(timeout=60)
        for number in (1, 2, 3):  # while it is busy
            node.sync.send(*make_messages(number))
        node.tracker.may_go.release(2)
        assert node.tracker.started.acquire(timeout=60)
    finally:
        node.tracker.may_go.release(9)
        node.close()
    assert node.tracker.seen == [0, 3]
    assert len(node.published) == 2
    assert node.tracker.closed


def test_depth_may_come_frames_later(example: dict[str, Any]) -> None:
    node = example["PoseNode"]()
    node.close()
    _, waiting, slop = node.sync.given
    assert waiting >= 5
    assert slop == 0.01


def test_an_image_that_cannot_be_used_ends_nothing(example: dict[str, Any]) -> None:
    node = example["PoseNode"]()
    node.tracker.may_go.release(9)
    color, depth, camera = make_messages(7)
    color.encoding = "bayer_rggb16"
    node.answer(color, depth, camera)
    node.answer(*make_messages(8))
    node.close()
    assert node.tracker.seen == [8]
    (said,) = node.log
    assert said.startswith("color=color: encoding bayer_rggb16 is not known")


def test_a_lens_distortion_is_told(example: dict[str, Any]) -> None:
    node = example["PoseNode"]()
    node.tracker.may_go.release(9)
    color, depth, camera = make_messages(7)
    node.answer(color, depth, camera)
    assert not node.log
    camera.d = np.array([0.1, -0.2, 0, 0, 0])
    node.answer(color, depth, camera)
    node.close()
    (said,) = node.log
    assert said.startswith("camera_info tells a lens distortion")


def test_silence_is_told(example: dict[str, Any]) -> None:
    node = example["PoseNode"]()
    node.tracker.may_go.release(9)
    color, _, camera = node.sync.given[0]
    color.send(None)
    camera.send(None)
    node.warn_of_silence()
    node.sync.send(*make_messages(1))
    node.warn_of_silence()
    node.close()
    (said,) = node.log
    assert said.endswith("messages: 1 of color, 0 of depth, 1 of camera_info")


def test_a_signal_ends_it_without_an_error(example: dict[str, Any]) -> None:
    before = threading.enumerate()
    assert example["main"]() == 0
    assert set(threading.enumerate()) <= set(before)


def test_an_error_of_the_worker_ends_the_node(example: dict[str, Any]) -> None:
    ended = threading.Event()
    sys.modules["rclpy"].try_shutdown = ended.set  # type: ignore[attr-defined]
    node = example["PoseNode"]()
    node.tracker.update_all = None
    hook, threading.excepthook = threading.excepthook, lambda _: None
    try:
        node.sync.send(*make_messages(1))
        assert ended.wait(60)
        node.close()
        assert isinstance(node.error, TypeError)
    finally:
        threading.excepthook = hook


def test_a_node_that_cannot_start_says_why_in_one_line(
    example: dict[str, Any], monkeypatch, capsys
) -> None:
    def fail(*_: object) -> None:
        raise posefilter.UserError("checkpoint=nothing.ckpt: no such file")

    monkeypatch.setattr(posefilter, "load", fail, raising=False)
    assert example["main"]() == 2
    assert capsys.readouterr().err == "checkpoint=nothing.ckpt: no such file\n"


def test_detections_are_those_of_bags(example: dict[str, Any]) -> None:
    rgb, depth, K = read_scene()
    estimator = load(NAME, overrides=FEW, device="cpu")
    result = estimator.predict(rgb, depth.astype(np.float32) * np.float32(1e-3), K)
    header = make_header(100)
    ours = example["make_detection"](result, header)
    (theirs,) = make_detections([result], header).detections
    assert flatten(ours) == flatten(theirs)
    assert ours.header is header


def flatten(message: Any) -> Any:
    """Return the fields of a message, and of those within, as plain Python."""
    if isinstance(message, list | np.ndarray):
        return [flatten(one) for one in message]
    if hasattr(message, "__dict__"):
        return {
            name: flatten(one) for name, one in vars(message).items() if not name.startswith("_")
        }
    return str(message)
