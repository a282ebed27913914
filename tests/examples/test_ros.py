"""Messages of ROS 2: dictionaries fill stand-ins of the message classes, and image messages become pictures."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import semfov
from examples import ros_messages as ros
from semfov import Detections, InputError
from semfov.belief.observers import Semantic
from semfov.decision import Decision
from semfov.gaze.policies import Policy
from semfov.observation.thresholds import Thresholds
from tests.examples.messages import KINDS, plain
from tests.refusals import refused
from tests.small import Coloured, Sure

CLASSES = ("cup", "cat", "car")
ARRAY, DETECTION = KINDS["vision_msgs/Detection2DArray"], KINDS["vision_msgs/Detection2D"]
HYPOTHESIS, POINT = KINDS["vision_msgs/ObjectHypothesisWithPose"], KINDS["geometry_msgs/PointStamped"]


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def seen(request, device):
    boxes = torch.tensor([[[10.0, 20, 40, 80], [0, 0, 5, 5], [1, 1, 2, 2]]], dtype=request.param)
    scores = torch.tensor([[[0.125, 0.25, 0.5, 0.125], [0.875, 0.0625, 0.0625, 0], [1, 0, 0, 0]]], dtype=request.param)
    return Detections(boxes, scores, torch.tensor([[True, True, False]])).to(device)


def test_dictionaries_of_detections_have_the_fields_of_the_message(seen):
    head = {"stamp": {"sec": 3, "nanosec": 250_000_000}, "frame_id": "camera"}
    bbox = {"center": {"position": {"x": 25.0, "y": 50.0}, "theta": 0.0}, "size_x": 30.0, "size_y": 60.0}
    named = [("cat", 0.5), ("cup", 0.25), ("car", 0.125)]
    results = [{"hypothesis": {"class_id": name, "score": score}} for name, score in named]
    expected = {"header": head, "detections": [{"header": head, "results": results, "bbox": bbox, "id": ""}]}
    got = ros.detection_array(seen, CLASSES, stamp=3.25, frame="camera")
    assert got == expected
    assert ros.detection_array(seen[0], CLASSES, stamp=3.25, frame="camera") == expected
    one = ros.detection_array(seen, CLASSES, stamp=3.25, frame="camera", most=1)
    assert one["detections"][0]["results"] == results[:1]
    low = ros.detection_array(seen, CLASSES, stamp=0, frame="", least=0.05)
    assert [len(each["results"]) for each in low["detections"]] == [3, 2]


def test_a_found_target_is_a_detection_with_the_probability_of_its_place():
    box = torch.tensor([10.0, 20, 40, 80])
    head = {"stamp": {"sec": 3, "nanosec": 0}, "frame_id": "camera"}
    bbox = {"center": {"position": {"x": 25.0, "y": 50.0}, "theta": 0.0}, "size_x": 30.0, "size_y": 60.0}
    for place, score in ((0.75, 0.75), (None, 0.5)):
        got = ros.found_array(Decision("found", 0.5, 3, box, place), "cat", stamp=3, frame="camera")
        results = [{"hypothesis": {"class_id": "cat", "score": score}}]
        assert got == {"header": head, "detections": [{"header": head, "results": results, "bbox": bbox, "id": ""}]}
        message = ros.fill(ARRAY(), got, DETECTION, HYPOTHESIS)
        assert message.detections[0].results[0].hypothesis.score == score
    for nothing in (None, Decision("absent", 0.1), Decision("undecided", 0.5)):
        assert ros.found_array(nothing, "cat", stamp=3, frame="camera") == {"header": head, "detections": []}


def test_messages_are_filled_from_dictionaries(seen):
    values = ros.detection_array(seen, CLASSES, stamp=3.25, frame="camera")
    message = ros.fill(ARRAY(), values, DETECTION, HYPOTHESIS)
    got = plain(message)
    for detection in got["detections"]:
        for result in detection["results"]:
            assert result.pop("pose") == plain(KINDS["geometry_msgs/PoseWithCovariance"]())
    assert got == values
    # The stamp of another message is used unchanged.
    again = ros.detection_array(seen, CLASSES, stamp=message.header.stamp, frame="camera")
    assert again == values


@given(st.floats(0, 2**31 - 1))
def test_stamps_are_whole_seconds_and_nanoseconds(seconds):
    stamp = ros.header(seconds, "f")["stamp"]
    assert 0 <= stamp["nanosec"] < 10**9
    assert stamp["sec"] + stamp["nanosec"] / 1e9 == pytest.approx(seconds, abs=1e-6)
    ros.fill(KINDS["std_msgs/Header"](), ros.header(seconds, "f"))


def test_gaze_is_a_point_in_pixels_or_on_the_ray_of_the_camera():
    point = ros.fill(POINT(), ros.gaze_point(torch.tensor([30.0, 40.0]), stamp=1, frame="image"))
    assert plain(point)["point"] == {"x": 30.0, "y": 40.0, "z": 0.0}
    matrix = np.array([[500.0, 0, 320], [0, 400, 240], [0, 0, 1]])
    u, v = 100.0, 333.0
    got = ros.gaze_point((u, v), stamp=1, frame="optical", camera=(500, 400, 320, 240))["point"]
    ray = np.linalg.solve(matrix, [u, v, 1])
    np.testing.assert_allclose([got["x"], got["y"], got["z"]], ray)


def image(pixels, encoding, pad=0):
    rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, pad)), constant_values=77)
    size = {"height": pixels.shape[0], "width": pixels.shape[1], "step": rows.shape[1]}
    return KINDS["sensor_msgs/Image"](encoding=encoding, data=list(rows.tobytes()), **size)


@pytest.mark.parametrize("pad", [0, 5])
def test_images_of_every_encoding_give_the_same_picture(pad):
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    alpha = np.full((4, 6, 1), 9, dtype=np.uint8)
    forms = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], -1),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], -1),
    }
    for encoding, pixels in forms.items():
        np.testing.assert_array_equal(ros.picture(image(pixels, encoding, pad)), rgb)
    grey = ros.picture(image(rgb[..., :1], "mono8", pad))
    np.testing.assert_array_equal(grey, rgb[..., :1].repeat(3, -1))
    assert semfov.as_image(grey).shape == (3, 4, 6)


def test_bad_input(seen):
    refused("one image", ros.detection_array, Detections.stack([seen, seen]), CLASSES, stamp=0, frame="")
    refused(r"detections\.scores", ros.detection_array, seen, CLASSES[:2], stamp=0, frame="")
    refused("stamp", ros.header, -1.0, "f")
    with pytest.raises(InputError, match="Detection2D among them"):
        ros.fill(ARRAY(), ros.detection_array(seen, CLASSES, stamp=0, frame=""), HYPOTHESIS)
    refused("'colour'", ros.fill, POINT(), {"colour": 1})
    refused("focal lengths", ros.gaze_point, (1, 1), stamp=0, frame="", camera=(0, 1, 0, 0))
    refused("cv_bridge", ros.picture, image(np.zeros((2, 2, 3), np.uint8), "yuv422"))
    cut = image(np.zeros((2, 2, 3), np.uint8), "rgb8")
    cut.height = 3
    refused("data", ros.picture, cut)


class Node:
    """A stand-in for the node class of rclpy."""

    def __init__(self, name):
        self.name, self.published, self.subscribed, self.logged = name, {}, {}, []

    def declare_parameter(self, name, value):
        return SimpleNamespace(value=value)

    def create_publisher(self, kind, topic, depth):
        def publish(message):
            assert type(message) is kind
            self.published.setdefault(topic, []).append(message)

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind, topic, callback, depth):
        self.subscribed[topic] = callback

    def get_logger(self):
        return SimpleNamespace(info=self.logged.append)


def test_the_node_publishes_detections_and_the_next_fixation(monkeypatch):
    def module(name, **members):
        made = ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    by_package = {}
    for kind, message in KINDS.items():
        by_package.setdefault(kind.partition("/")[0], {})[message.__name__] = message
    for package, members in by_package.items():
        module(package)
        module(f"{package}.msg", **members)
    module("rclpy")
    module("rclpy.node", Node=Node)
    monkeypatch.delitem(sys.modules, "examples.ros_node", raising=False)
    node_module = importlib.import_module("examples.ros_node")
    eye = semfov.Eye(semfov.Foveation(40.0), Coloured(CLASSES, (64, 64), score=0.9), reference=64.0)
    searching, exploring = (Semantic(4), Policy("non-predictive")), (Semantic(4), Policy("random"))
    sure = Sure(thresholds=Thresholds(0.7, 0.01, 0.3))
    agent = semfov.ActivePerception(eye, searching, exploring, verification=sure)
    monkeypatch.setattr(semfov.ActivePerception, "recommended", lambda name: agent)
    node = node_module.GazeNode()
    pixels = np.full((48, 64, 3), 100, np.uint8)
    pixels[30:40, 50:60] = (230, 20, 20)
    message = image(pixels, "rgb8")
    message.header.stamp.sec, message.header.frame_id = 7, "camera"
    for _ in range(3):
        node.subscribed["image"](message)
    found, gaze, target = (node.published[topic] for topic in ("detections", "gaze", "found"))
    assert len(found) == len(gaze) == len(target) == 3
    assert all(each.header.stamp.sec == 7 and each.header.frame_id == "camera" for each in (*found, *gaze, *target))
    best = found[-1].detections[0]
    assert best.results[0].hypothesis.class_id == "cup"
    centre = best.bbox.center.position
    assert (centre.x, centre.y) == pytest.approx((55, 35), abs=6)
    # The next fixation is where the target is likely: the second look is at the red square.
    assert (gaze[0].point.x, gaze[0].point.y) == pytest.approx((55, 35), abs=12)
    # The third frame is a closer look, which finds the square.
    assert [len(each.detections) for each in target] == [0, 0, 1]
    assert target[-1].detections[0].results[0].hypothesis.score == pytest.approx(0.982, abs=1e-3)
    centre = target[-1].detections[0].bbox.center.position
    assert (centre.x, centre.y) == pytest.approx((55, 35), abs=1.5)
    # A recording that begins anew, and its second image.
    seconds = [
        node.passed(SimpleNamespace(sec=sec, nanosec=nanosec)) for sec, nanosec in ((9, 0), (3, 0), (3, 250_000_000))
    ]
    assert seconds == [2, 0, 0.25]
    sys.modules.pop("examples.ros_node")
