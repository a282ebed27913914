"""Detections and gaze as ROS 2 messages: dictionaries with the messages' fields, and messages filled from them.

Nothing here imports ROS. The dictionaries have the fields of `vision_msgs/Detection2DArray` (version 4 of the package)
and `geometry_msgs/PointStamped`. A complete node is in `ros_node.py`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.decision import Decision
from semfov.detection import Detections
from semfov.errors import check, check_number, check_shape

_Values = dict[str, Any]
Message = TypeVar("Message")


class _Encoding(NamedTuple):
    """Layout of a pixel: where red, green and blue are, and its number of bytes."""

    channels: tuple[int, int, int]
    bytes: int


_ENCODINGS = {
    "rgb8": _Encoding((0, 1, 2), 3),
    "bgr8": _Encoding((2, 1, 0), 3),
    "rgba8": _Encoding((0, 1, 2), 4),
    "bgra8": _Encoding((2, 1, 0), 4),
    "mono8": _Encoding((0, 0, 0), 1),
}


def header(stamp: Any, frame: str) -> _Values:
    """Make a `std_msgs/Header`.

    >>> header(1.5, "camera")
    {'stamp': {'sec': 1, 'nanosec': 500000000}, 'frame_id': 'camera'}
    """
    if hasattr(stamp, "nanosec"):
        return {"stamp": {"sec": int(stamp.sec), "nanosec": int(stamp.nanosec)}, "frame_id": frame}
    check_number(stamp, "stamp", 0, 2**31 - 1)
    total = round(float(stamp) * 1e9)
    return {"stamp": {"sec": total // 10**9, "nanosec": total % 10**9}, "frame_id": frame}


def detection_array(
    detections: Detections,
    classes: Sequence[str],
    *,
    stamp: Any,
    frame: str,
    least: float = 0.1,
    most: int = 5,
) -> _Values:
    """Make a `vision_msgs/Detection2DArray`: boxes in pixels, each with its most likely classes."""
    mask = detections.mask
    check(mask.ndim == 1 or len(mask) == 1, "detections", "detections of one image", f"a batch of {len(mask)}")
    check_shape(detections.scores, "detections.scores", None, len(classes) + 1)
    of_image = detections if mask.ndim == 1 else detections[0]
    boxes = of_image.boxes[of_image.mask].tolist()
    scores = of_image.scores[of_image.mask, 1:]  # without background
    head = header(stamp, frame)
    entries = []
    for box, scores_of_box in zip(boxes, scores, strict=True):
        hypotheses = []
        top = scores_of_box.topk(min(most, len(classes)))
        for score, index in zip(top.values.tolist(), top.indices.tolist(), strict=True):
            if score >= least:
                hypotheses.append(_hypothesis(classes[index], score))
        if hypotheses:
            entries.append(_entry(head, hypotheses, box))
    return {"header": head, "detections": entries}


def found_array(decision: Decision | None, name: str, *, stamp: Any, frame: str) -> _Values:
    """Make a `vision_msgs/Detection2DArray` of a decision: the box of the target if it was found, otherwise none.

    >>> found_array(None, "cup", stamp=0, frame="camera")["detections"]
    []
    """
    head = header(stamp, frame)
    entries = []
    if decision is not None and decision.box is not None:
        score = decision.probability if decision.place is None else decision.place
        entries.append(_entry(head, [_hypothesis(name, score)], decision.box.tolist()))
    return {"header": head, "detections": entries}


def _hypothesis(name: str, score: float) -> _Values:
    """Make a `vision_msgs/ObjectHypothesisWithPose` of a class."""
    return {"hypothesis": {"class_id": name, "score": score}}


def _entry(head: _Values, hypotheses: list[_Values], box: Sequence[float]) -> _Values:
    """Make a `vision_msgs/Detection2D`."""
    return {"header": head, "results": hypotheses, "bbox": _bounds(box), "id": ""}


def _bounds(box: Sequence[float]) -> _Values:
    """Make a `vision_msgs/BoundingBox2D`; centre and box are in pixels from the image's left and upper edge."""
    x1, y1, x2, y2 = box
    position = {"x": (x1 + x2) / 2, "y": (y1 + y2) / 2}
    return {"center": {"position": position, "theta": 0.0}, "size_x": x2 - x1, "size_y": y2 - y1}


def gaze_point(
    fixation: Tensor | Sequence[float],
    *,
    stamp: Any,
    frame: str,
    camera: tuple[float, float, float, float] | None = None,
) -> _Values:
    r"""Make a `geometry_msgs/PointStamped` of a fixation.

    For a pinhole camera the point is

    .. math:: \left( \frac{u - c_x}{f_x}, \; \frac{v - c_y}{f_y}, \; 1 \right)

    in the camera's optical frame (z ahead, x right, y down). A head that turns towards this point looks at the
    fixation.

    `fixation` is `(u, v)` in pixels, pixel centres at integers. `camera` is `(f_x, f_y, c_x, c_y)` in pixels, from
    `sensor_msgs/CameraInfo.k`; without it the point stays in pixels, with z = 0.

    >>> gaze_point((420.0, 240.0), stamp=0, frame="camera_optical", camera=(500.0, 500.0, 320.0, 240.0))["point"]
    {'x': 0.2, 'y': 0.0, 'z': 1.0}
    """
    u, v = (float(value) for value in fixation)
    point = {"x": u, "y": v, "z": 0.0}
    if camera is not None:
        focal_x, focal_y, centre_x, centre_y = (float(value) for value in camera)
        check(focal_x > 0 and focal_y > 0, "camera", "focal lengths above 0", (focal_x, focal_y))
        point = {"x": (u - centre_x) / focal_x, "y": (v - centre_y) / focal_y, "z": 1.0}
    return {"header": header(stamp, frame), "point": point}


def fill(message: Message, values: Mapping[str, Any], *kinds: type) -> Message:
    """Fill a message from a dictionary, field by field."""
    fields: Mapping[str, str] = message.get_fields_and_field_types()  # type: ignore[attr-defined]
    for name, value in values.items():
        check(name in fields, "values", f"fields of {type(message).__name__} ({', '.join(fields)})", repr(name))
        if isinstance(value, Mapping):
            fill(getattr(message, name), value, *kinds)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            kind = _kind_of_elements(fields[name], kinds)
            setattr(message, name, [fill(kind(), element, *kinds) for element in value])
        else:
            setattr(message, name, value)
    return message


def _kind_of_elements(field: str, kinds: Sequence[type]) -> type:
    """Find the class of the messages in a list by the type of its field, such as `sequence<std_msgs/Header, 3>`."""
    element = field.removeprefix("sequence<").partition(">")[0].split(",")[0]
    kind_name = element.partition("/")[2]
    by_name = {kind.__name__: kind for kind in kinds}
    check(kind_name in by_name, "kinds", f"{kind_name} among them", ", ".join(by_name) or "none")
    return by_name[kind_name]


def picture(message: Any) -> NDArray[np.uint8]:
    """Read the pixels of a `sensor_msgs/Image`, `(h, w, 3)`."""
    name = str(message.encoding)
    got = f"{name!r}; convert it with image_proc or cv_bridge"
    check(name in _ENCODINGS, "encoding", f"one of {', '.join(_ENCODINGS)}", got)
    encoding = _ENCODINGS[name]
    height = int(message.height)
    width = int(message.width)
    step = int(message.step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    length = width * encoding.bytes
    is_complete = height > 0 and width > 0 and step >= length and len(data) >= height * step
    expected = f"{width} × {height} pixels of {encoding.bytes} bytes"
    check(is_complete, "data", expected, f"{len(data)} bytes, {step} in each row")
    rows = data[: height * step].reshape(height, step)
    pixels = rows[:, :length].reshape(height, width, encoding.bytes)
    return np.ascontiguousarray(pixels[..., list(encoding.channels)])
