"""Detections and gaze as ROS 2 messages: dictionaries with the messages' fields, and messages filled from them.

Nothing here imports ROS. The dictionaries have the fields of `vision_msgs/Detection2DArray` (version 4 of the package)
and `geometry_msgs/PointStamped`. A complete node is in `ros_node.py`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.decision import Decision
from semfov.detection import Detections
from semfov.errors import check, check_number, check_shape

_Values = dict[str, Any]
Message = TypeVar("Message")

_CHANNELS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0), "mono8": (0, 0, 0)}
_BYTES = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1}


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
    detections: Detections, classes: Sequence[str], *, stamp: Any, frame: str, least: float = 0.1, most: int = 5
) -> _Values:
    """Make a `vision_msgs/Detection2DArray`: boxes in pixels, each with its most likely classes."""
    boxes, scores, mask = detections.boxes, detections.scores, detections.mask
    check(mask.ndim == 1 or len(mask) == 1, "detections", "detections of one image", f"a batch of {len(mask)}")
    check_shape(scores, "detections.scores", None, len(classes) + 1)
    if mask.ndim > 1:
        boxes, scores, mask = boxes[0], scores[0], mask[0]
    head, entries = header(stamp, frame), []
    for box, each in zip(boxes[mask].tolist(), scores[mask, 1:], strict=True):
        top = each.topk(min(most, len(classes)))
        hypotheses = [
            {"hypothesis": {"class_id": classes[index], "score": score}}
            for score, index in zip(top.values.tolist(), top.indices.tolist(), strict=True)
            if score >= least
        ]
        if hypotheses:
            entries.append({"header": head, "results": hypotheses, "bbox": _bounds(box), "id": ""})
    return {"header": head, "detections": entries}


def found_array(decision: Decision | None, name: str, *, stamp: Any, frame: str) -> _Values:
    """Make a `vision_msgs/Detection2DArray` of a decision: the box of the target if it was found, otherwise none.

    >>> found_array(None, "cup", stamp=0, frame="camera")["detections"]
    []
    """
    head, entries = header(stamp, frame), []
    if decision is not None and decision.box is not None:
        score = decision.probability if decision.place is None else decision.place
        result = {"hypothesis": {"class_id": name, "score": score}}
        entries.append({"header": head, "results": [result], "bbox": _bounds(decision.box.tolist()), "id": ""})
    return {"header": head, "detections": entries}


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
            kind_name = fields[name].removeprefix("sequence<").partition(">")[0].partition("/")[2].split(",")[0]
            named = {kind.__name__: kind for kind in kinds}
            check(kind_name in named, "kinds", f"{kind_name} among them", ", ".join(named) or "none")
            setattr(message, name, [fill(named[kind_name](), each, *kinds) for each in value])
        else:
            setattr(message, name, value)
    return message


def picture(message: Any) -> NDArray[np.uint8]:
    """Read the pixels of a `sensor_msgs/Image`; → `(h, w, 3)`."""
    encoding, step = str(message.encoding), int(message.step)
    height, width = int(message.height), int(message.width)
    check(
        encoding in _CHANNELS,
        "encoding",
        f"one of {', '.join(_CHANNELS)}",
        f"{encoding!r}; convert it with image_proc or cv_bridge",
    )
    size, data = _BYTES[encoding], np.frombuffer(bytes(message.data), np.uint8)
    whole = height > 0 and width > 0 and step >= width * size and len(data) >= height * step
    check(whole, "data", f"{width} × {height} pixels of {size} bytes", f"{len(data)} bytes, {step} in each row")
    rows = data[: height * step].reshape(height, step)[:, : width * size].reshape(height, width, size)
    return np.ascontiguousarray(rows[..., list(_CHANNELS[encoding])])
