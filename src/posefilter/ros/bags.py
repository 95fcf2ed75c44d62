"""Frames out of a ROS 2 bag, and detections into another."""

import re
import shutil
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from posefilter.errors import Stopped, UserError, find_reason
from posefilter.locks import hold, release
from posefilter.ros.messages import (
    CAMERA_INFO,
    COMPRESSED,
    DETECTIONS,
    IMAGE,
    decode_color,
    decode_depth,
    decode_intrinsics,
    is_distorted,
    open_types,
    rectify,
    stamp_of,
)
from posefilter.ros.untrusted import check_bag

_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")  # of a topic, with its namespace
_MCAP, _ROS1 = b"\x89MCAP0\r\n", b"#ROSBAG V"  # that files begin with; the former ends with it, too
# how long a message waits for one of another topic [ns], by the recording; the oldest go before,
# where more than some messages and some memory [bytes] wait
_WAITING, _FEW, _MEMORY = 5_000_000_000, 30, 2**28


class Topics(NamedTuple):
    """Where the images of a bag are."""

    color: str
    depth: str
    camera_info: str


class BagFrame(NamedTuple):
    """Color and depth of one moment."""

    rgb: np.ndarray  # (H, W, 3) uint8
    depth: np.ndarray  # (H, W) float32 [m], 0 where unknown
    intrinsics: np.ndarray  # (3, 3) [px]
    header: Any  # of the color image
    time: int  # when it was recorded [ns]


class BagReader:
    """The frames of a bag, in the order of time as far as it was recorded so.

    Args:
        path: A bag's folder, or its .mcap or .db3 file.
        topics: Where its images are.
        tolerance: Largest difference between the times of color and depth [s].
        rectify: Whether to undo the lens distortion that the camera tells.
        units: Units of depth that is of whole numbers, a meter.
        skip: Leave out messages that are damaged, and count them.

    Raises:
        UserError: It cannot be read, or has no such topics.
    """

    def __init__(
        self,
        path: Path,
        topics: Topics,
        tolerance: float,
        rectify: bool = False,
        units: float = 1000.0,
        skip: bool = False,
    ) -> None:
        from rosbags.rosbag2 import Reader

        self.path, self.topics, self.tolerance = path, topics, int(tolerance * 1e9)
        self.rectify, self.units, self.skip = rectify, units, skip
        self.distorted = False  # whether a camera had a lens distortion that is not undone
        self.unpaired = 0  # color images without depth
        self.early = 0  # color images before the camera is known
        self.skipped = list[str]()  # why messages were left out
        self.warnings = list[str]()  # what is doubtful of the images; each is listed once
        self._nearest: int | None = None  # [ns] between color and depth that are not of one moment
        self._by_recording = False  # whether headers have no time
        try:
            check_bag(path)
            self.reader = Reader(path)
            self.reader.open()
        except UserError as error:
            raise UserError(f"bag={error}") from error
        except Exception as error:  # a damaged header decides what breaks, memory included
            reason = _find_remedy(path) or find_reason(error)[:200]
            raise UserError(f"bag={path}: cannot be read as a ROS 2 bag ({reason})") from error
        try:
            self._check_topics()
        except UserError:
            self.reader.close()
            raise

    def __enter__(self) -> "BagReader":
        """Return the reader."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bag."""
        self.reader.close()

    def _check_topics(self) -> None:
        kinds = {one.topic: one.msgtype for one in self.reader.connections}
        allowed = ((IMAGE, COMPRESSED), (IMAGE, COMPRESSED), (CAMERA_INFO,))
        for key, topic, fits in zip(Topics._fields, self.topics, allowed, strict=True):
            if topic not in kinds:
                some = ", ".join(f"{name} ({kind})" for name, kind in sorted(kinds.items())[:12])
                raise UserError(
                    f"{key}={topic}: the bag has no such topic; it has {some or 'none'}"
                )
            if kinds[topic] not in fits:
                raise UserError(f"{key}={topic}: has type {kinds[topic]}, not {' or '.join(fits)}")
        if self.topics.color == self.topics.depth:
            raise UserError(f"depth={self.topics.depth}: is the topic of color, too; name another")

    @property
    def images(self) -> int:
        """How many color images the bag has."""
        return self._count(self.topics.color)

    def _count(self, topic: str) -> int:
        """Return how many messages the bag has of a topic."""
        return sum(one.msgcount for one in self.reader.connections if one.topic == topic)

    def messages(self) -> Iterator[tuple[Any, int, bytes]]:
        """Yield each message as it is stored: its connection, when it was recorded, its bytes.

        Raises:
            UserError: The bag is damaged.
        """
        try:
            yield from self.reader.messages()
        except Exception as error:  # of storages and compressions, many kinds
            raise UserError(f"bag={self.path}: is damaged ({find_reason(error)[:200]})") from error

    def frames(self) -> Iterator[BagFrame]:
        """Yield each color image with the depth of its moment, once the camera is known.

        Raises:
            UserError: A message is damaged, or color, depth and camera are not of one size.
        """
        colors, depths = deque[tuple[int, int, Any]](), deque[tuple[int, int, Any]]()
        camera: Any = None
        last: dict[str, int] = {}  # a first time of 0 may be a simulation's; a second one is none
        for connection, time, raw in self.messages():
            if connection.topic not in self.topics:
                continue
            message = self._read(connection, raw)
            if message is None:
                continue
            if connection.topic == self.topics.camera_info:
                if camera is None:
                    self._drop_early(colors, depths)
                camera = message
                self.distorted |= is_distorted(message) and not self.rectify
                continue
            own = colors if connection.topic == self.topics.color else depths
            _drop_late(depths, time)
            self.unpaired += _drop_late(colors, time)
            stamp = time if self._by_recording else stamp_of(message)
            own.append((stamp, time, message))
            if not self._by_recording and stamp == last.get(connection.topic) == 0:
                self._go_by_recording(colors, depths, connection.topic)
            last[connection.topic] = stamp
            if camera is not None and (self._by_recording or 0 not in last.values()):
                yield from self._pair(colors, depths, camera)
        if not self._by_recording and last and not any(last.values()):  # no image has one
            self._go_by_recording(colors, depths, next(iter(last)))
        if camera is not None:
            yield from self._pair(colors, depths, camera, ended=True)
        self.unpaired += len(colors)

    def _pair(
        self, colors: deque[Any], depths: deque[Any], camera: Any, ended: bool = False
    ) -> Iterator[BagFrame]:
        """Yield each color image and the depth that are nearest to one another in time.

        That is known once both topics have told of a moment as late, or the bag has ended; what is
        yielded waits no longer.
        """
        for color in sorted(colors, key=lambda one: one[0]):
            near = min(depths, key=lambda one: abs(one[0] - color[0]), default=None)
            if near is None:
                continue
            if (apart := abs(near[0] - color[0])) > self.tolerance:
                self._nearest = apart if self._nearest is None else min(self._nearest, apart)
                continue
            own = min(colors, key=lambda one: abs(one[0] - near[0]))
            later = max(color[0], near[0])
            known = max(one[0] for one in colors) >= later <= max(one[0] for one in depths)
            if own is not color or not (known or ended):
                continue
            colors.remove(color)
            depths.remove(near)
            try:
                frame = self._make(color, near, camera)
            except UserError as error:
                self.leave_out(color[0], error)
            else:
                yield frame

    def leave_out(self, stamp: int, error: UserError) -> None:
        """Count an image that cannot be used.

        Args:
            stamp: Its time [ns].
            error: What is wrong with it.

        Raises:
            UserError: Damaged messages are not skipped; it names the bag and the time.
        """
        reason = f"bag={self.path}: image of {stamp / 1e9:.3f} s: {error}"
        if not self.skip:
            raise UserError(f"{reason}; on_error=skip leaves such images out") from error
        self.skipped.append(reason)

    def explain_none(self) -> str:
        """Return why not one image could be used."""
        if self.skipped:
            return f"no image could be used; the first: {self.skipped[0]}"
        named = zip(Topics._fields, self.topics, strict=True)
        empty = [f"{key}={topic}" for key, topic in named if not self._count(topic)]
        if empty:
            return f"has no messages of {', '.join(empty)}"
        limit = f"max_time_difference={self.tolerance / 1e9:g} s"
        if self.early:
            return f"camera_info={self.topics.camera_info}: its first message is after all images"
        none, soon = (
            f"no color image has depth within {limit}",
            f"within {_WAITING / 1e9:g} s of it",
        )
        if self._nearest is not None:
            away = f"{self._nearest / 1e9:.4g} s away"
            return f"{none}; the nearest is {away}, of what was recorded {soon}"
        return f"{none} that was recorded {soon}, after a first camera_info"

    def _warn(self, sentence: str) -> None:
        if sentence not in self.warnings:
            self.warnings.append(sentence)

    def _go_by_recording(self, colors: deque[Any], depths: deque[Any], topic: str) -> None:
        """Take the times of recording from now on, of messages that wait as well: without times in
        their headers, any color and depth would be of one moment.
        """
        self._by_recording = True
        for own in (colors, depths):
            kept = [(time, time, message) for _, time, message in own]
            own.clear()
            own.extend(kept)
        self._warn(
            f"headers of {topic} have no time: images are paired by the time of recording, and "
            "detections have no time either"
        )

    def _drop_early(self, colors: deque[Any], depths: deque[Any]) -> None:
        """Drop the pairs that came before the camera was known, and count them."""
        for one in [*colors]:
            near = min(depths, key=lambda other: abs(other[0] - one[0]), default=None)
            if near is not None and abs(near[0] - one[0]) <= self.tolerance:
                colors.remove(one)
                depths.remove(near)
                self.early += 1

    def _read(self, connection: Any, raw: bytes) -> Any:
        """Return a message; None where it is damaged and left out."""
        try:
            return open_types().deserialize_cdr(raw, connection.msgtype)
        except Exception as error:  # of struct, numpy and assertions
            reason = (
                f"bag={self.path}: a message of {connection.topic} is damaged "
                f"({find_reason(error)[:200]})"
            )
            if not self.skip:
                raise UserError(f"{reason}; on_error=skip leaves such messages out") from error
            self.skipped.append(reason)
            return None

    def _make(self, color: tuple[int, int, Any], depth: tuple[int, int, Any], camera: Any) -> Any:
        rgb = decode_color(color[2], self.topics.color)
        z = decode_depth(depth[2], self.topics.depth, self.units)
        if rgb.shape[:2] != z.shape:
            raise UserError(
                f"depth={self.topics.depth}: {z.shape[1]}x{z.shape[0]} pixels, but the color image "
                f"has {rgb.shape[1]}x{rgb.shape[0]}; name a topic of depth aligned to color"
            )
        self._compare_frames(color[2], depth[2], camera)
        K = decode_intrinsics(camera, z.shape, self.topics.camera_info)
        if self.rectify:
            rgb, z = rectify(rgb, z, camera, self.topics.camera_info)
        return BagFrame(rgb, z, K, color[2].header, color[1])

    def _compare_frames(self, color: Any, depth: Any, camera: Any) -> None:
        """Warn of depth or a camera that is of another place than the color: depth that is not
        aligned may have the color's size.
        """
        own = str(color.header.frame_id)
        for key, message in (("depth", depth), ("camera_info", camera)):
            other = str(message.header.frame_id)
            if own and other and own != other:
                advice = "is it aligned to the color?" if key == "depth" else "is it the color's?"
                topic = getattr(self.topics, key)
                self._warn(f"{key}={topic} is of the frame {other}, the color of {own}: {advice}")


def _drop_late(waiting: deque[Any], now: int) -> int:
    """Drop the messages that have waited in vain until a time of recording [ns], and return how
    many these are.
    """
    count = len(waiting)
    size = sum(one[2].data.nbytes for one in waiting)
    while waiting and (now - waiting[0][1] > _WAITING or (len(waiting) > _FEW and size > _MEMORY)):
        size -= waiting.popleft()[2].data.nbytes
    return count - len(waiting)


def _find_remedy(path: Path) -> str:
    """Return why a bag cannot be opened and what helps, "" where that is not known."""
    stored = sorted(one.name for ending in ("mcap", "db3") for one in path.glob(f"*.{ending}"))
    if path.is_dir() and stored and not (path / "metadata.yaml").exists():
        return (
            "it has no metadata.yaml, as after a recorder that was killed: name the file in it, "
            f"{path / stored[0]}, or run `ros2 bag reindex`"
        )
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(len(_ROS1))
            file.seek(max(0, path.stat().st_size - len(_MCAP)))
            tail = file.read()
        if head == _ROS1:
            return "it is of ROS 1; rosbags-convert makes a ROS 2 bag of it"
        if head.startswith(_MCAP) and tail != _MCAP:
            return "it was cut off; `mcap recover` saves what is there"
    return ""


class BagWriter:
    """A new bag. It comes to be when it is closed: whole, or with the images until an interruption
    or an error of the user's, if there are any.

    Args:
        path: The .mcap file to write, or without that ending a bag's folder.
        topic: Where detections go.

    Raises:
        UserError: The path already exists, is another kind of bag's, or another process is about to
            write it; or the topic's name is none.
    """

    def __init__(self, path: Path, topic: str) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer

        if path.exists():
            raise UserError(f"out={path}: already exists; choose another")
        if path.suffix in (".db3", ".bag"):
            raise UserError(f"out={path}: bags are written as MCAP; name an .mcap file or a folder")
        if not _NAME.fullmatch(topic):
            raise UserError(f"detections={topic}: is no name of a topic, such as /detections")
        self.path, self.topic = path, topic
        self.parts = path.with_name(f".{path.name}.part")
        hold(self.parts)
        name = path.stem if path.suffix == ".mcap" else path.name
        shutil.rmtree(self.parts / name, ignore_errors=True)  # of a process that was killed
        # version 9, of Jazzy, has metadata that Humble cannot read; all read 8
        self.writer = Writer(self.parts / name, version=8, storage_plugin=StoragePlugin.MCAP)
        self.copies: dict[int, Any] = {}
        self.count = 0  # messages with detections

    def __enter__(self) -> "BagWriter":
        """Open the bag."""
        self.writer.open()
        self.detections = self.writer.add_connection(self.topic, DETECTIONS, typestore=open_types())
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the bag, and put it into its place; after an error of the program's, or before the
        first image, nothing is left.
        """
        try:
            self.writer.close()
            kept = kind is not None and issubclass(kind, (UserError, KeyboardInterrupt, Stopped))
            if kind is None or (kept and self.count):
                whole = self.writer.path
                if self.path.suffix == ".mcap":
                    (whole,) = whole.glob("*.mcap")
                whole.rename(self.path)
        finally:
            release(self.parts)
            shutil.rmtree(self.parts, ignore_errors=True)

    def write(self, message: Any, time: int) -> None:
        """Write a Detection3DArray at a time [ns]."""
        self.writer.write(self.detections, time, open_types().serialize_cdr(message, DETECTIONS))
        self.count += 1

    def add_connections(self, connections: Sequence[Any]) -> None:
        """Add the topics of another bag, whose messages `copy` is to write.

        A topic may have several connections, as some recorders and merged bags have.

        Raises:
            UserError: One is the topic of the detections.
        """
        added: list[tuple[Any, Any]] = []
        for one in connections:
            if one.topic == self.topic:
                raise UserError(
                    f"detections={self.topic}: the bag has this topic already; name another"
                )
            kind = (one.topic, one.msgtype, one.ext)
            same = next((copy for other, copy in added if other == kind), None)
            types = open_types()
            # SQLite bags of Humble have no definitions, which viewers of MCAP need
            known = not one.msgdef.data and one.msgtype in types.fielddefs
            self.copies[one.id] = same or self.writer.add_connection(
                one.topic,
                one.msgtype,
                typestore=types,
                msgdef=None if known else one.msgdef.data,
                rihs01=None if known else one.digest or "RIHS01_",
                serialization_format=one.ext.serialization_format,
                offered_qos_profiles=one.ext.offered_qos_profiles,
            )
            added.append((kind, self.copies[one.id]))

    def copy(self, messages: Iterator[tuple[Any, int, bytes]]) -> None:
        """Write the messages of another bag, as they are, whose topics were added."""
        for connection, time, raw in messages:
            self.writer.write(self.copies[connection.id], time, raw)
