"""Search with the head of a ROS 2 robot: an action turns its joints, JointState has their angles, Image the frames.

Source ROS 2 first, then run it: python -m examples.ros_head --ros-args -p target:=cup -r image:=/camera/image_raw
"""

import math
import time
from typing import Any

import rclpy
import torch
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.node import Node
from sensor_msgs.msg import Image, JointState
from trajectory_msgs.msg import JointTrajectoryPoint

import semfov
from examples import ros_messages as ros
from semfov.errors import DataError
from semfov.head import CameraFrame, PanTiltCamera, Speeds


class JointHead(PanTiltCamera):
    """The head of a robot with a joint for pan and one for tilt.

    Joints count radians, to the left and down (REP 103), and the agent counts degrees to the right and up.

    Args:
        node: receives `joint_states` and `image`, and sends `head_controller/follow_joint_trajectory`.
        size: `(width, height)` of the images.
        joints: names of the joints for pan and tilt.
        pan: limits in degrees, left and right.
        tilt: limits in degrees, down and up.
        field: field of view across in degrees.
        speeds: of the joints; `settle` is waited for after each movement.
        patience: largest number of seconds for a movement and its image.
    """

    def __init__(
        self,
        node: Node,
        size: tuple[int, int] = (640, 480),
        *,
        joints: tuple[str, str] = ("head_pan_joint", "head_tilt_joint"),
        pan: tuple[float, float] = (-90.0, 90.0),
        tilt: tuple[float, float] = (-30.0, 45.0),
        field: float = 60.0,
        speeds: Speeds | None = None,
        patience: float = 10.0,
    ) -> None:
        self.node, self.size, self.joints, self.pan, self.tilt = node, size, joints, pan, tilt
        self.fields = (field,)
        self.speeds = Speeds(eye_start=0.0, eye=0.0, settle=0.2) if speeds is None else speeds
        self.patience = patience
        self.angles: dict[str, float] = {}
        self.image: Image | None = None
        node.create_subscription(JointState, "joint_states", self.take_angles, 10)
        node.create_subscription(Image, "image", self.take_image, 1)
        self.client = ActionClient(node, FollowJointTrajectory, "head_controller/follow_joint_trajectory")

    def take_angles(self, message: JointState) -> None:
        """Keep the angles of the joints that a message has."""
        self.angles.update(zip(message.name, message.position, strict=True))

    def take_image(self, message: Image) -> None:
        """Keep an image."""
        self.image = message

    def look_at(self, direction: tuple[float, float], field: float) -> CameraFrame:
        """Turn the joints, wait for an image that was taken afterwards, and return it with the angles of the joints."""
        handle = self.result(self.client.send_goal_async(self.goal(direction)))
        if not handle.accepted:
            raise DataError(f"head: its controller refuses to turn to {direction}")
        self.result(handle.get_result_async())
        time.sleep(self.speeds.settle)
        self.image, before = None, self.image
        self.angles.clear()
        until = time.monotonic() + self.patience
        while self.image is None or stamp(self.image) <= stamp(before) or not self.angles.keys() >= {*self.joints}:
            if time.monotonic() > until:
                raise DataError("head: expected an image and the angles of its joints, got none; check the topics")
            rclpy.spin_once(self.node, timeout_sec=0.1)
        pan, tilt = (-math.degrees(self.angles[joint]) for joint in self.joints)
        return CameraFrame(ros.picture(self.image), (pan, tilt))

    def goal(self, direction: tuple[float, float]) -> FollowJointTrajectory.Goal:
        """Make the goal of the action: one point, at the time that the speeds allow."""
        goal, point = FollowJointTrajectory.Goal(), JointTrajectoryPoint()
        point.positions = [-math.radians(angle) for angle in direction]
        farthest = max(
            (abs(math.degrees(self.angles.get(joint, 0.0)) + angle))
            for joint, angle in zip(self.joints, direction, strict=True)
        )
        seconds = max(float(self.speeds.turn(torch.tensor(farthest))), 0.1)
        point.time_from_start.sec, point.time_from_start.nanosec = int(seconds), int(seconds % 1 * 1e9)
        goal.trajectory.joint_names, goal.trajectory.points = list(self.joints), [point]
        return goal

    def result(self, future: Any) -> Any:
        """Wait for the result of a message."""
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=self.patience)
        if not future.done():
            raise DataError(f"head: its controller does not answer within {self.patience:g} s")
        return future.result()


def stamp(image: Image | None) -> float:
    """Time of an image in seconds; before all others where there is none."""
    return -math.inf if image is None else image.header.stamp.sec + image.header.stamp.nanosec / 1e9


def main() -> None:
    """Search around the robot, and log where the target is."""
    rclpy.init()
    node = Node("semfov_head")
    target = node.declare_parameter("target", "cup").value
    agent = semfov.ActivePerception.recommended()
    path: Any = agent.search(JointHead(node), target)
    pan, tilt = path.direction(-1)
    node.get_logger().info(f"{path.summary()} The last gaze was at pan {pan:.1f}°, tilt {tilt:.1f}°.")
    rclpy.shutdown()


if __name__ == "__main__":
    main()
