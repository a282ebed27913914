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
        self.node = node
        self.size = size
        self.joints = joints
        self.pan = pan
        self.tilt = tilt
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
        image = self.next_image()
        pan, tilt = (-math.degrees(self.angles[joint]) for joint in self.joints)
        return CameraFrame(ros.picture(image), (pan, tilt))

    def next_image(self) -> Image:
        """Wait for an image that is newer than the last one, and for new angles of the joints."""
        earliest = stamp(self.image)
        self.image = None
        self.angles.clear()
        deadline = time.monotonic() + self.patience
        while stamp(self.image) <= earliest or not self.angles.keys() >= {*self.joints}:
            if time.monotonic() > deadline:
                raise DataError("head: expected an image and the angles of its joints, got none; check the topics")
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return self.image

    def goal(self, direction: tuple[float, float]) -> FollowJointTrajectory.Goal:
        """Make the goal of the action: one point, at the time that the speeds allow."""
        turns = []
        for joint, angle in zip(self.joints, direction, strict=True):
            present = -math.degrees(self.angles.get(joint, 0.0))
            turns.append(abs(present - angle))
        # The joints turn together, so the longer way decides.
        seconds = max(float(self.speeds.turn(torch.tensor(max(turns)))), 0.1)

        point = JointTrajectoryPoint()
        point.positions = [-math.radians(angle) for angle in direction]
        point.time_from_start.sec = int(seconds)
        point.time_from_start.nanosec = int(seconds % 1 * 1e9)
        goal = FollowJointTrajectory.Goal()
        goal.trajectory.joint_names = list(self.joints)
        goal.trajectory.points = [point]
        return goal

    def result(self, future: Any) -> Any:
        """Wait for the result of a message."""
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=self.patience)
        if not future.done():
            raise DataError(f"head: its controller does not answer within {self.patience:g} s")
        return future.result()


def stamp(image: Image | None) -> float:
    """Read the time of an image in seconds; before all others where there is none."""
    if image is None:
        return -math.inf
    return image.header.stamp.sec + image.header.stamp.nanosec / 1e9


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
