"""A ROS 2 node that finds objects: color, aligned depth and camera_info in, Detection3DArray out.

Untested here: it needs ROS 2 (rclpy, message_filters, vision_msgs) beside posefilter. What it makes
of an image is what `convert_bag` makes, which is tested.

    ros2 run ... or: python node.py --ros-args -p checkpoint:=003_cracker_box \
        -r color:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info \
        -r depth:=/camera/aligned_depth_to_color/image_raw
"""

import math

import message_filters
import rclpy
from geometry_msgs.msg import Point, Pose, PoseWithCovariance, Quaternion
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

import posefilter
from posefilter.result import Result
from posefilter.ros.detections import list_shown, make_quaternion, to_ros_covariance
from posefilter.ros.messages import decode_color, decode_depth, decode_intrinsics


class PoseNode(Node):
    """Track the objects of one checkpoint or several."""

    def __init__(self) -> None:
        super().__init__("posefilter")
        checkpoint = self.declare_parameter("checkpoint", "003_cracker_box").value
        self.tracker = posefilter.Tracker(posefilter.load(checkpoint))
        self.publisher = self.create_publisher(Detection3DArray, "detections", 10)
        kinds = (("color", Image), ("depth", Image), ("camera_info", CameraInfo))
        topics = [
            message_filters.Subscriber(self, kind, name, qos_profile=qos_profile_sensor_data)
            for name, kind in kinds
        ]
        # one message each, so that a slow estimate drops images rather than lagging behind
        self.pairs = message_filters.ApproximateTimeSynchronizer(topics, 1, 0.01)
        self.pairs.registerCallback(self.answer)

    def answer(self, color: Image, depth: Image, camera: CameraInfo) -> None:
        """Publish what one image shows."""
        results = self.tracker.update_all(
            decode_color(color, "color"), decode_depth(depth, "depth"), decode_intrinsics(camera)
        )
        shown = [make_detection(one, color.header) for one in list_shown(results)]
        self.publisher.publish(Detection3DArray(header=color.header, detections=shown))


def make_detection(result: Result, header: object) -> Detection3D:
    """Return a result as a detection."""
    belief = result.belief
    x, y, z = result.pose[:3, 3].tolist()
    qx, qy, qz, qw = make_quaternion(result.pose)
    covariance = to_ros_covariance(belief.covariance_about(result.pose), result.pose, belief.center)
    found = ObjectHypothesisWithPose()
    found.hypothesis.class_id = result.object
    found.hypothesis.score = math.nan if result.probability is None else result.probability
    found.pose = PoseWithCovariance(
        pose=Pose(position=Point(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw)),
        covariance=covariance.reshape(36).tolist(),
    )
    return Detection3D(header=header, results=[found], id=result.object)


def main() -> None:
    """Run until interrupted."""
    rclpy.init()
    node = PoseNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
