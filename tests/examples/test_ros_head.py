"""The head of a ROS 2 robot, with stand-ins for rclpy, the messages and the robot's controller."""

import importlib
import math
import sys
from types import ModuleType, SimpleNamespace

import pytest
import torch

import semfov
from semfov import Panorama
from semfov.head import Speeds
from semfov.settings import ExploreSettings
from tests.examples.messages import KINDS
from tests.refusals import unusable
from tests.small import Coloured

GOAL = KINDS["control_msgs/FollowJointTrajectory_Goal"]


class Robot:
    """Its head stands in a panorama; its joints turn to the left and down, in radians.

    `spin_once` delivers what has happened since: an image, which shows the head before it turned if `is_late`, and the
    angles of the joints among those of others.
    """

    def __init__(self, panorama, size):
        self.world, self.size = Panorama(panorama, size), size
        self.callbacks, self.goals, self.yaw, self.pitch, self.clock = {}, [], 0.3, 0.1, 7
        self.accepts, self.answers, self.sends = True, True, True

    def create_subscription(self, kind, topic, callback, depth):
        self.callbacks[topic] = kind, callback

    def send(self, topic, message):
        kind, callback = self.callbacks[topic]
        assert type(message) is kind
        callback(message)

    def send_goal_async(self, goal):
        assert type(goal) is GOAL
        (point,) = goal.trajectory.points
        self.goals.append(goal)
        where = dict(zip(goal.trajectory.joint_names, point.positions, strict=True))
        self.yaw, self.pitch = where["head_pan_joint"], where["head_tilt_joint"]
        handle = SimpleNamespace(accepted=self.accepts, get_result_async=lambda: future("succeeded", True))
        return future(handle, self.answers)

    def spin_once(self, node, timeout_sec):
        if not self.sends:
            return
        pan, tilt = -math.degrees(self.yaw), -math.degrees(self.pitch)
        pixels = self.world.look_at((pan, tilt), 60.0).mul(255).byte().permute(1, 2, 0).contiguous().numpy()
        self.clock += 1
        header = KINDS["std_msgs/Header"](stamp=KINDS["builtin_interfaces/Time"](sec=self.clock))
        width, height = self.size
        data = list(pixels.tobytes())
        image = KINDS["sensor_msgs/Image"](
            header=header, height=height, width=width, encoding="rgb8", step=3 * width, data=data
        )
        names, angles = ["wheel", "head_tilt_joint", "head_pan_joint"], [1.5, self.pitch, self.yaw]
        self.send("joint_states", KINDS["sensor_msgs/JointState"](header=header, name=names, position=angles))
        self.send("image", image)


def future(result, done):
    return SimpleNamespace(done=lambda: done, result=lambda: result)


@pytest.fixture
def panorama():
    """With a blue square, 30 degrees to the right and 10 up."""
    image = torch.zeros(3, 180, 360)
    image[2, 75:85, 205:215] = 1
    return image


@pytest.fixture
def robot(panorama):
    return Robot(panorama, (104, 78))


@pytest.fixture
def head(monkeypatch, robot):
    """Makes the head of the robot, by the example."""

    def module(name, **members):
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    for package in ("sensor_msgs", "trajectory_msgs"):
        named = {kind.partition("/")[2]: message for kind, message in KINDS.items() if kind.startswith(f"{package}/")}
        module(package)
        module(f"{package}.msg", **named)
    module("control_msgs")
    module("control_msgs.action", FollowJointTrajectory=SimpleNamespace(Goal=GOAL))
    module("rclpy", spin_once=robot.spin_once, spin_until_future_complete=lambda node, future, timeout_sec: None)
    module("rclpy.node", Node=Robot)
    module("rclpy.action", ActionClient=lambda node, kind, name: node)
    monkeypatch.delitem(sys.modules, "examples.ros_head", raising=False)
    example = importlib.import_module("examples.ros_head")
    yield lambda **options: example.JointHead(robot, robot.size, speeds=Speeds(settle=0.0), **options)
    sys.modules.pop("examples.ros_head")


def test_joints_turn_to_the_left_and_down_and_the_frame_has_their_angles(head, robot):
    camera = head()
    for direction in ((30.0, 10.0), (-90.0, -30.0), (0.0, 45.0)):
        frame = camera.look_at(direction, 60.0)
        assert (robot.yaw, robot.pitch) == pytest.approx(tuple(-math.radians(angle) for angle in direction))
        assert frame.direction == pytest.approx(direction, abs=1e-4)
        expected = robot.world.look_at(direction, 60.0)
        torch.testing.assert_close(semfov.as_image(frame.image), expected, atol=1 / 255, rtol=0)
    seconds = [goal.trajectory.points[0].time_from_start for goal in robot.goals]
    assert seconds[1].sec + seconds[1].nanosec / 1e9 == pytest.approx(float(Speeds().turn(torch.tensor(120.0))), 1e-3)


def test_the_agent_finds_a_target_by_the_head(head, robot):
    torch.manual_seed(0)
    eye = semfov.Eye(semfov.Foveation(100.0, growth=2.0), Coloured(("red", "green", "blue"), (416, 312)))
    model = semfov.FovealObservationModel.identity(["red", "green", "blue"], [0.2])
    agent = semfov.HeadAgent(eye, model, model).eval().requires_grad_(False)
    path = agent.explore(head(), ExploreSettings(passes=24))
    assert len(robot.goals) == 24
    regions = [path.places(look, 0.5)[0] for look in range(24)]
    middles = [path.views.world.angles_of(each.samples(3)[:1, 4])[0].tolist() for each in regions if len(each)]
    assert middles
    for middle in middles:
        assert middle == pytest.approx((30, 10), abs=5)  # less than a cell


def test_a_head_that_does_not_turn_or_show_anything_is_an_error(head, robot):
    camera = head(patience=0.0)
    robot.accepts = False
    unusable("its controller refuses to turn", camera.look_at, (0.0, 0.0), 60.0)
    robot.accepts, robot.answers = True, False
    unusable("does not answer within 0 s", camera.look_at, (0.0, 0.0), 60.0)
    robot.answers, robot.sends = True, False
    unusable("expected an image and the angles of its joints", camera.look_at, (0.0, 0.0), 60.0)
