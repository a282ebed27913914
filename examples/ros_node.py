"""A ROS 2 node that searches a camera's images: it publishes detections, the target, and the point to look at next.

Source ROS 2 first, then run it: python -m examples.ros_node --ros-args -p target:=cup -r image:=/camera/image_raw
"""

import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2D, Detection2DArray, ObjectHypothesisWithPose

import semfov
from examples import ros_messages as ros


class GazeNode(Node):
    """Look once at every image, and move the gaze."""

    def __init__(self) -> None:
        super().__init__("semfov_gaze")
        target = self.declare_parameter("target", "cup").value
        detector = self.declare_parameter("detector", "yolox-nano").value
        self.agent = semfov.ActivePerception.recommended(detector)
        self.target = target
        self.live = self.agent.live(target)
        self.time: float | None = None
        self.detections = self.create_publisher(Detection2DArray, "detections", 1)
        self.decision = self.create_publisher(Detection2DArray, "found", 1)
        self.gaze = self.create_publisher(PointStamped, "gaze", 1)
        self.create_subscription(Image, "image", self.look, 1)

    def look(self, message: Image) -> None:
        """Look at an image, and publish the detections, the box of a found target and the next gaze point."""
        moment = self.live.step(ros.picture(message), self.passed(message.header.stamp))
        origin = {"stamp": message.header.stamp, "frame": message.header.frame_id}
        detections = ros.detection_array(moment.seen, self.agent.classes[1:], **origin)
        self.detections.publish(ros.fill(Detection2DArray(), detections, Detection2D, ObjectHypothesisWithPose))
        found = ros.found_array(moment.decision, self.target, **origin)
        self.decision.publish(ros.fill(Detection2DArray(), found, Detection2D, ObjectHypothesisWithPose))
        point = ros.gaze_point(moment.next_point, **origin)
        self.gaze.publish(ros.fill(PointStamped(), point))

    def passed(self, stamp: Time) -> float:
        """Compute the seconds since the image before; 0 for the first one, and where a recording begins anew."""
        before = self.time
        self.time = stamp.sec + stamp.nanosec / 1e9
        return 0.0 if before is None else max(self.time - before, 0.0)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    rclpy.spin(GazeNode())


if __name__ == "__main__":
    main()
