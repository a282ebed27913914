"""Cameras that turn: the protocol that a camera of your own implements, and the scene around it."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol, TypeAlias, cast

import torch
from torch import Tensor

from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture, resized
from semfov.errors import DataError, InputError, check, check_number, type_of
from semfov.head.scenes import Flat, Panorama, Sphere, World, check_fields, check_limits
from semfov.head.speeds import Speeds
from semfov.sensor.sphere import Camera, panorama_directions

_TRIES = 25  # largest number of frames that are asked for until one is from the right direction
_WIDEST = 8192  # pixels of the panorama in which objects are located
_DRAWING_WIDTH = 480  # width of the frames that are kept for drawing
_DRAWN = 1280  # pixels across the panorama of its frames


@dataclass(frozen=True)
class CameraFrame:
    """A frame of a camera, with the direction in which it was really taken.

    Attributes:
        image: the frame, of any common kind (`semfov.as_image`).
        direction: pan and tilt in degrees when it was taken.
        field: field of view in degrees when it was taken; None for the one that was asked for.

    >>> CameraFrame(torch.rand(3, 30, 40), direction=(29.5, 0.2)).field is None
    True
    """

    image: ImageLike
    direction: tuple[float, float]
    field: float | None = None


class PanTiltCamera(Protocol):
    """Base of cameras that turn; a subclass needs `look_at`, `size`, and attributes that differ from the defaults.

    Angles are in degrees. Pan is positive to the right and tilt is positive upwards; (0, 0) is straight ahead. The lens
    is taken to be without distortion.

    Attributes:
        size: `(width, height)` of a frame in pixels.
        pan: limits of pan, left and right; (-180, 180) for a camera that turns all the way round.
        tilt: limits of tilt, down and up.
        fields: fields of view across, narrowest first; more than one for a camera that zooms.
        speeds: speeds of the motors, and the time until a frame is sharp after a movement.
        rate: rate at which what was seen is forgotten, per second, for a scene that changes; 0: never.

    >>> class Still(PanTiltCamera):
    ...     size, pan, tilt = (40, 30), (-90, 90), (-20, 20)
    ...
    ...     def look_at(self, direction, field):
    ...         return torch.rand(3, 30, 40)
    >>> open_scene(Still()).view(torch.tensor([30.0, 10.0, 60.0]))[0].shape
    torch.Size([3, 30, 40])
    """

    size: tuple[int, int]
    pan: tuple[float, float] = (-180.0, 180.0)
    tilt: tuple[float, float] = (-90.0, 90.0)
    fields: tuple[float, ...] = (60.0,)
    speeds: Speeds = Speeds()
    rate: float = 0.0

    @abstractmethod
    def look_at(self, direction: tuple[float, float], field: float) -> ImageLike | CameraFrame:
        """Turn to a direction, wait until the camera is there, and take a frame.

        Args:
            direction: pan and tilt in degrees, between the limits.
            field: field of view across, in degrees, one of `fields`.

        Returns:
            The frame, of any common kind (`semfov.as_image`); or a `CameraFrame` where the camera knows its direction.
            One from another direction, such as one that was taken before the camera arrived, is asked for again.
        """


class _CameraScene(Sphere):
    """The scene around a camera that turns, with a motor for pan and one for tilt, which move at the same time."""

    still = False

    def __init__(self, camera: PanTiltCamera, color: Color) -> None:
        _check_camera(camera)
        fields = check_fields(camera.fields)
        # As many pixels to a degree as the narrowest view has.
        width = min(_WIDEST, 2 * round(180 * camera.size[0] / fields[0]))
        super().__init__(
            (width, width // 2), camera.size, pan=camera.pan, tilt=camera.tilt, fields=fields, speeds=camera.speeds
        )
        self.rate = getattr(camera, "rate", 0.0)
        check_number(self.rate, "rate", 0, 100)
        self.camera = camera
        self.color = color
        # By the pose that was asked for, a small copy of the last frame, and the pose where it was taken.
        self._frames: dict[tuple[float, ...], tuple[Tensor, Tensor]] = {}

    def view(self, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Turn the camera and take a frame; a frame that is off by more than a tenth of its field is taken again."""
        pan, tilt, field = pose.tolist()
        for _ in range(_TRIES):
            frame = self.camera.look_at((pan, tilt), field)
            if not isinstance(frame, CameraFrame):
                return self._image_of(frame, pose, pose)
            real_field = field if frame.field is None else frame.field
            real_pose = pose.new_tensor([*frame.direction, real_field])
            # Between the optical axes: `turn` of this scene is that of the motors.
            turn_error = float(super().turn(real_pose, pose))
            field_error = abs(float(real_pose[2]) - field)
            if max(turn_error, field_error) <= field / 10:
                return self._image_of(frame.image, real_pose, pose)
        expected = f"a frame from pan {pan:.1f}°, tilt {tilt:.1f}°, field {field:.1f}° after {_TRIES} attempts"
        got = "pan {:.1f}°, tilt {:.1f}°, field {:.1f}°".format(*real_pose.tolist())
        raise DataError(f"camera: expected {expected}, got {got}; wait in look_at until the camera has arrived")

    def _image_of(self, picture: ImageLike, real_pose: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
        """Take a frame as an image of the right size, with its real pose; a small copy is kept for drawing."""
        image = as_image(picture, color=self.color, argument="frame")
        got = image.shape[-1], image.shape[-2]
        check(got == tuple(self.size), "frame", f"{self.size[0]} × {self.size[1]} pixels, as `size` has it", got)
        width = min(self.size[0], _DRAWING_WIDTH)
        height = max(1, round(width * self.size[1] / self.size[0]))
        small = resized(image.mul(255).byte().cpu(), (height, width))[0]
        self._frames[tuple(pose.tolist())] = small, real_pose
        return image, real_pose

    def turn(self, one: Tensor, other: Tensor) -> Tensor:
        """Compute the larger of the movements in pan and tilt."""
        pan = (one[..., 0] - other[..., 0]).abs()
        if self.around:
            pan = torch.minimum(pan, 360 - pan)
        tilt = (one[..., 1] - other[..., 1]).abs()
        return torch.maximum(pan, tilt)

    def image(self) -> Tensor | None:
        """Draw a panorama of the last frames from all poses, grey where none was; None before the first."""
        if not self._frames:
            return None
        columns = min(_DRAWN, self.picture[0])
        rows = columns // 2
        y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
        pixels = torch.stack([x, y], -1).flatten(0, 1).float()
        directions = panorama_directions(pixels, (columns, rows))
        canvas = torch.full((3, columns * rows), 0.5)
        for frame, pose in self._frames.values():
            height, width = frame.shape[-2:]
            points, inside = Camera(pose, (width, height)).points(directions)
            column, row = points[inside].round().long().unbind(-1)
            nearest = frame[:, row.clamp(0, height - 1), column.clamp(0, width - 1)]
            canvas[:, inside] = nearest.float() / 255
        return canvas.unflatten(-1, (rows, columns))


def _check_camera(camera: object) -> None:
    """Raise `InputError` unless this is a camera with all that a scene around it needs, its limits in degrees."""
    if isinstance(camera, type):
        raise InputError(f"camera: expected a camera, got the class {camera.__name__}; give {camera.__name__}(…)")
    names = ("look_at", "size", "pan", "tilt", "fields", "speeds")
    missing = [name for name in names if not hasattr(camera, name)]
    got = f"{type(camera).__name__} without {', '.join(missing)}; derive it from semfov.head.PanTiltCamera"
    check(not missing, "camera", f"a camera with {', '.join(names)}", got)
    for name in ("pan", "tilt"):
        check_limits(name, getattr(camera, name))


SceneLike: TypeAlias = World | PanTiltCamera | LargePicture | ImageLike
"""Anything that a head can look around in: a `Panorama`, a `Flat`, a camera that turns, or a picture."""


def open_scene(scene: SceneLike, color: Color = "rgb") -> World:
    """Make the scene that a head looks around in.

    Args:
        scene: a `Panorama` or a `Flat`; a camera that turns (`PanTiltCamera`); or a picture of any common kind, a
            `Panorama` if it is twice as wide as high, else a `Flat`.
        color: order of the channels of an array, a tensor, or the frames of a camera (`semfov.as_image`).

    Returns:
        The scene.

    Raises:
        InputError: it is none of these, or `color` is given for a scene that has its picture already.
        DataError: a file cannot be read.

    >>> type(open_scene(torch.rand(3, 64, 128))).__name__, type(open_scene(torch.rand(3, 96, 128))).__name__
    ('Panorama', 'Flat')
    """
    if isinstance(scene, World):
        check(color == "rgb", "color", f"rgb for {type_of(scene)}, which was made with its own color", color)
        return scene
    if hasattr(scene, "look_at"):
        return _CameraScene(cast(PanTiltCamera, scene), color)
    opened = open_large(scene, color=color)
    width, height = opened.size
    if width % 2 or abs(width - 2 * height) > 1:
        return Flat(opened)
    return Panorama(opened.read((0, 0, width, height)))
