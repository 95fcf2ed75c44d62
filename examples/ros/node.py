"""A ROS 2 node that finds objects: color, aligned depth and camera_info in, Detection3DArray out.

Needs ROS 2 Jazzy or later (rclpy, message_filters, vision_msgs) beside posefilter; docs/ros.md says
how to install both.  The tests run it with stand-ins for ROS's packages.

    python node.py --ros-args -p checkpoints:="['003_cracker_box', '025_mug']" \
        -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info \
        -r depth:=/camera/aligned_depth_to_color/image_raw
"""

import sys
from collections import Counter
from contextlib import suppress
from queue import Empty, Queue
from threading import Thread
from typing import Any

import message_filters
import numpy as np
import rclpy
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, Quaternion, Vector3
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import BoundingBox3D, Detection3D, Detection3DArray, ObjectHypothesisWithPose

import posefilter
from posefilter.result import Result
from posefilter.ros.detections import (
    choose_score,
    list_shown,
    make_quaternion,
    measure_box,
    to_ros_covariance,
)
from posefilter.ros.messages import decode_color, decode_depth, decode_intrinsics, is_distorted

_WAITING = 10  # messages of a topic that wait for those of the others: depth may come frames later
_SILENCE = 5.0  # [s] without images after which a warning says so
_KINDS = {"color": Image, "depth": Image, "camera_info": CameraInfo}


class PoseNode(Node):
    """Track the objects of one checkpoint or several.

    A thread of its own tracks, so that the executor is never blocked.  It takes the newest images;
    those that come while it is busy are dropped, and its answers do not lag behind.
    """

    def __init__(self) -> None:
        super().__init__("posefilter")
        checkpoints = self.declare_parameter("checkpoints", ["003_cracker_box"]).value
        self.slop = self.declare_parameter("max_time_difference", 0.01).value  # [s]
        self.tracker = posefilter.Tracker(posefilter.load(checkpoints))
        self.publisher = self.create_publisher(Detection3DArray, "detections", 10)
        self.newest: Queue[Any] = Queue(maxsize=1)
        self.error: BaseException | None = None  # that ended the worker
        self.seen: Counter[str] = Counter()
        topics = [self.listen(name) for name in _KINDS]
        self.sync = message_filters.ApproximateTimeSynchronizer(topics, _WAITING, self.slop)
        self.sync.registerCallback(lambda *messages: self.keep(messages))
        self.timer = self.create_timer(_SILENCE, self.warn_of_silence)
        self.worker = Thread(target=self.work)
        self.worker.start()

    def listen(self, name: str) -> Any:
        """Subscribe to a topic, and count its messages."""
        kind, quality = _KINDS[name], qos_profile_sensor_data
        topic = message_filters.Subscriber(self, kind, name, qos_profile=quality)
        topic.registerCallback(lambda _: self.seen.update([name]))
        return topic

    def keep(self, messages: Any) -> None:
        """Let messages wait for the worker in place of those that waited before; None ends it."""
        with suppress(Empty):
            self.newest.get_nowait()
        self.newest.put(messages)
        self.seen["together"] += 1

    def work(self) -> None:
        """Answer the newest images until told to end."""
        try:
            while (messages := self.newest.get()) is not None:
                self.answer(*messages)
        except BaseException as error:
            self.error = error
            raise
        finally:
            rclpy.try_shutdown()  # after an error here: a node that only listens helps nobody

    def answer(self, color: Image, depth: Image, camera: CameraInfo) -> None:
        """Publish what one image shows."""
        try:
            rgb = decode_color(color, "color")
            intrinsics = decode_intrinsics(camera, rgb.shape[:2])
            results = self.tracker.update_all(rgb, decode_depth(depth, "depth"), intrinsics)
        except posefilter.UserError as error:  # of this image; the next may be as it should be
            self.get_logger().error(str(error), throttle_duration_sec=_SILENCE)
            return
        frames = {one.header.frame_id for one in (color, depth, camera)} - {""}
        if len(frames) > 1:
            self.get_logger().warning(
                f"color, depth and camera_info are of the frames {', '.join(sorted(frames))}: is "
                "depth aligned to the color?",
                throttle_duration_sec=_SILENCE,
            )
        if is_distorted(camera):
            self.get_logger().warning(
                "camera_info tells a lens distortion, and images are taken as rectified ones: are "
                "color and depth rectified, as by image_proc?",
                once=True,
            )
        for one in results:
            if one.wrong_size or one.blank:
                self.get_logger().warning("; ".join(one.warnings), throttle_duration_sec=_SILENCE)
        shown = [make_detection(one, color.header) for one in list_shown(results)]
        if self.context.ok():  # it may have been shut down meanwhile
            self.publisher.publish(Detection3DArray(header=color.header, detections=shown))

    def warn_of_silence(self) -> None:
        """Say which messages came where none came together."""
        if not self.seen["together"]:
            came = ", ".join(f"{self.seen[name]} of {name}" for name in _KINDS)
            self.get_logger().warning(
                f"no color, depth and camera_info within {self.slop} s of each other in the last "
                f"{_SILENCE:g} s; messages: {came}"
            )
        self.seen.clear()

    def close(self) -> None:
        """End the worker, after the image that it is at."""
        self.keep(None)
        self.worker.join()
        self.tracker.close()


def make_detection(result: Result, header: object) -> Detection3D:
    """Return a result as a detection."""
    covariance = to_ros_covariance(result.covariance, result.pose, result.belief.center)
    found = ObjectHypothesisWithPose()
    found.hypothesis.class_id = result.object
    found.hypothesis.score = choose_score(result)
    found.pose = PoseWithCovariance(
        pose=make_pose(result.pose), covariance=covariance.reshape(36).tolist()
    )
    center, (x, y, z) = measure_box(result)
    box = BoundingBox3D(center=make_pose(center), size=Vector3(x=x, y=y, z=z))
    return Detection3D(header=header, results=[found], bbox=box, id=result.object)


def make_pose(pose: np.ndarray) -> Pose:
    """Return a pose (4, 4) [m] as a message."""
    x, y, z = pose[:3, 3].tolist()
    qx, qy, qz, qw = make_quaternion(pose)
    return Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def main() -> int:
    """Run until interrupted; the status is 0, 1 after an error, or 2 if the node cannot start."""
    rclpy.init()
    node = None
    try:
        node = PoseNode()
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except posefilter.UserError as error:
        print(error, file=sys.stderr)
        return 2
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()  # a signal has shut down already, and shutdown() would raise
    return 0 if node is None or node.error is None else 1


if __name__ == "__main__":
    sys.exit(main())
