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
        self.target, self.live = target, self.agent.live(target)
        self.time: float | None = None
        self.detections = self.create_publisher(Detection2DArray, "detections", 1)
        self.decision = self.create_publisher(Detection2DArray, "found", 1)
        self.gaze = self.create_publisher(PointStamped, "gaze", 1)
        self.create_subscription(Image, "image", self.look, 1)

    def look(self, message: Image) -> None:
        """Look at an image, and publish the detections, the box of a found target and the next gaze point."""
        moment = self.live.step(ros.picture(message), self.passed(message.header.stamp))
        of = {"stamp": message.header.stamp, "frame": message.header.frame_id}
        array = ros.detection_array(moment.seen, self.agent.classes[1:], **of)
        self.detections.publish(ros.fill(Detection2DArray(), array, Detection2D, ObjectHypothesisWithPose))
        array = ros.found_array(moment.decision, self.target, **of)
        self.decision.publish(ros.fill(Detection2DArray(), array, Detection2D, ObjectHypothesisWithPose))
        self.gaze.publish(ros.fill(PointStamped(), ros.gaze_point(moment.next_point, **of)))

    def passed(self, stamp: Time) -> float:
        """Seconds since the image before; none where a recording begins anew."""
        before, self.time = self.time, stamp.sec + stamp.nanosec / 1e9
        return 0.0 if before is None else max(self.time - before, 0.0)


def main() -> None:
    """Run the node until it is stopped."""
    rclpy.init()
    rclpy.spin(GazeNode())


if __name__ == "__main__":
    main()
