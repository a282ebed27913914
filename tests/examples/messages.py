"""Stand-ins of ROS 2's message classes, as strict as those that rosidl generates."""

from typing import ClassVar

DEFINITIONS = {
    "builtin_interfaces/Time": {"sec": "int32", "nanosec": "uint32"},
    "std_msgs/Header": {"stamp": "builtin_interfaces/Time", "frame_id": "string"},
    "geometry_msgs/Point": dict.fromkeys("xyz", "double"),
    "geometry_msgs/PointStamped": {"header": "std_msgs/Header", "point": "geometry_msgs/Point"},
    "geometry_msgs/Quaternion": dict.fromkeys("xyzw", "double"),
    "geometry_msgs/Pose": {"position": "geometry_msgs/Point", "orientation": "geometry_msgs/Quaternion"},
    "geometry_msgs/PoseWithCovariance": {"pose": "geometry_msgs/Pose", "covariance": "double[36]"},
    "vision_msgs/Point2D": {"x": "double", "y": "double"},
    "vision_msgs/Pose2D": {"position": "vision_msgs/Point2D", "theta": "double"},
    "vision_msgs/BoundingBox2D": {"center": "vision_msgs/Pose2D", "size_x": "double", "size_y": "double"},
    "vision_msgs/ObjectHypothesis": {"class_id": "string", "score": "double"},
    "vision_msgs/ObjectHypothesisWithPose": {
        "hypothesis": "vision_msgs/ObjectHypothesis",
        "pose": "geometry_msgs/PoseWithCovariance",
    },
    "vision_msgs/Detection2D": {
        "header": "std_msgs/Header",
        "results": "sequence<vision_msgs/ObjectHypothesisWithPose>",
        "bbox": "vision_msgs/BoundingBox2D",
        "id": "string",
    },
    "vision_msgs/Detection2DArray": {"header": "std_msgs/Header", "detections": "sequence<vision_msgs/Detection2D>"},
    "sensor_msgs/Image": {
        "header": "std_msgs/Header",
        "height": "uint32",
        "width": "uint32",
        "encoding": "string",
        "is_bigendian": "uint8",
        "step": "uint32",
        "data": "sequence<uint8>",
    },
    "sensor_msgs/JointState": {
        "header": "std_msgs/Header",
        "name": "sequence<string>",
        "position": "sequence<double>",
    },
    "builtin_interfaces/Duration": {"sec": "int32", "nanosec": "uint32"},
    "trajectory_msgs/JointTrajectoryPoint": {
        "positions": "sequence<double>",
        "time_from_start": "builtin_interfaces/Duration",
    },
    "trajectory_msgs/JointTrajectory": {
        "header": "std_msgs/Header",
        "joint_names": "sequence<string>",
        "points": "sequence<trajectory_msgs/JointTrajectoryPoint>",
    },
    "control_msgs/FollowJointTrajectory_Goal": {"trajectory": "trajectory_msgs/JointTrajectory"},
}
PLAIN = {"string": str, "double": float, "int32": int, "uint32": int, "uint8": int}


class Message:
    """Base class of the stand-ins: fields have defaults, and values of another type are refused."""

    FIELDS: ClassVar[dict[str, str]] = {}

    def __init__(self, **values):
        for name, kind in self.FIELDS.items():
            empty = [] if "[" in kind or "<" in kind else PLAIN[kind]() if kind in PLAIN else KINDS[kind]()
            object.__setattr__(self, name, empty)
        for name, value in values.items():
            setattr(self, name, value)

    @classmethod
    def get_fields_and_field_types(cls):
        return dict(cls.FIELDS)

    def __setattr__(self, name, value):
        kind = self.FIELDS[name]
        if kind.startswith("sequence<"):
            inner = kind[len("sequence<") : -1]
            assert inner in PLAIN or all(type(each) is KINDS[inner] for each in value), name
        else:
            assert type(value) is (PLAIN[kind] if kind in PLAIN else KINDS[kind]), f"{name}: {type(value)}"
        object.__setattr__(self, name, value)


KINDS = {kind: type(kind.partition("/")[2], (Message,), {"FIELDS": fields}) for kind, fields in DEFINITIONS.items()}


def plain(message):
    """A message as a dictionary."""
    if isinstance(message, list):
        return [plain(each) for each in message]
    return {name: plain(getattr(message, name)) for name in message.FIELDS} if isinstance(message, Message) else message
