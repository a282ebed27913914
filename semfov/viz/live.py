"""The view and belief of an agent drawn into frames of a camera or a video, and video files of such frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.sources import has_frames
from semfov.detection.objects import NO_TRACK
from semfov.errors import DataError, needing
from semfov.io.files import replacing
from semfov.paths import Moment
from semfov.paths.look import Box
from semfov.paths.stimulus import in_bytes
from semfov.viz.style import FOUND, GAZE, TARGET

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

_Frame = NDArray[np.uint8]

_LONGEST = 640
_LONGEST_OF_WINDOWS = 1280  # small objects of large frames are to be seen
# Containers and codecs in the order in which they are tried; every build of OpenCV has the last one.
VIDEO_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}  # suffixes of videos that can be written, and their codecs


def reduced(size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Reduce `(width, height)` to a longer side, with even sides, as codecs of videos need them."""
    scale = min(1.0, longest / max(size))
    width, height = (max(2, round(side * scale / 2) * 2) for side in size)
    return width, height


def draw_moment(image: Tensor, moment: Moment, text: str, size: tuple[int, int] | None = None) -> _Frame:
    """Draw what is known at a frame, and where the next look goes, into the frame.

    Args:
        image: `(3, H, W)`, the frame, of bytes or in [0, 1].
        moment: the record of the frame.
        text: line above the drawing.
        size: `(width, height)` of the drawing; None takes that of a frame of the video that is written.

    Returns:
        `(h, w, 3)`, bytes.
    """
    from PIL import Image

    height, width = image.shape[-2:]
    if size is None:
        size = reduced((width, height), _LONGEST if moment.next_region is None else _LONGEST_OF_WINDOWS)
    pixels = in_bytes(image) if image.is_floating_point() else image
    picture = Image.fromarray(pixels.permute(1, 2, 0).cpu().numpy()).resize(size)
    drawing = _MomentDrawing(picture, moment, (size[0] / width, size[1] / height))
    drawing.draw_belief()
    if moment.next_region is None:
        drawing.draw_fixations()
    else:
        drawing.draw_windows(moment.next_region)
    drawing.draw_decision()
    drawing.write(text)
    return np.asarray(picture)


class _MomentDrawing:
    """Drawing of a moment into a picture.

    Args:
        picture: the reduced frame, which is drawn on.
        moment: the record of the frame.
        scale: pixels of the drawing for each pixel of the frame, across and down.
    """

    def __init__(self, picture: PillowImage, moment: Moment, scale: tuple[float, float]) -> None:
        from PIL import ImageDraw

        self.picture = picture
        self.moment = moment
        self.scale = scale
        self.draw = ImageDraw.Draw(picture)

    def draw_belief(self) -> None:
        """Draw the probability in each cell, where there is a map."""
        from PIL import Image

        believed = self.moment.belief_map(self.moment.looks[-1].index)
        if believed is None:
            return
        grid, chances = believed
        size = self.picture.size
        table = chances.detach().float().clamp(0, 1).reshape(grid.rows, grid.columns).cpu().numpy()
        # The colour covers at most five eighths, so that the frame stays visible.
        strength = Image.fromarray((table * 160).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
        self.picture.paste(Image.new("RGB", size, TARGET), mask=strength)

    def draw_windows(self, next_region: Box) -> None:
        """Draw the objects and their ways, the next window, and the window of this look."""
        moment = self.moment
        self._draw_ways()
        # This look's window comes last, over the others.
        for box, confirmed in zip(moment.objects.boxes.tolist(), moment.confirmed.tolist(), strict=True):
            self.draw.rectangle(self._scaled(box), outline=FOUND if confirmed else TARGET, width=2)
        self.draw.rectangle(self._scaled(next_region), outline=GAZE, width=1)
        self._mark(self.draw.rectangle, self._scaled(moment.looks[-1].region))

    def _draw_ways(self) -> None:
        """Draw where the objects were in the last frames, and their numbers."""
        objects = self.moment.objects
        if objects.track_ids is None:
            return
        for track in self.moment.ways.values():
            points = [self._scaled_point(point) for point in track]
            self.draw.line(points, fill=GAZE, width=2)
        from PIL import ImageFont

        font = ImageFont.load_default(11)
        for number, box in zip(objects.track_ids.tolist(), objects.boxes.tolist(), strict=True):
            if number != NO_TRACK:
                x1, y1, _, _ = self._scaled(box)
                self.draw.text((x1, y1 - 13), str(number), fill="white", font=font, stroke_width=1, stroke_fill="black")

    def draw_fixations(self) -> None:
        """Draw a line to the next fixation, and a ring at this one, or a box around what was examined closely."""
        x, y = self._scaled_point(self.moment.looks[-1].fixation)
        self.draw.line((x, y, *self._scaled_point(self.moment.next_point)), fill=GAZE, width=2)
        if self.moment.examined is None:
            self._mark(self.draw.ellipse, (x - 9, y - 9, x + 9, y + 9))
        else:
            self._mark(self.draw.rectangle, self._scaled(self.moment.examined.box.tolist(), 6))

    def draw_decision(self) -> None:
        """Draw the box of the decision, where there is one."""
        decision = self.moment.decision
        if decision is not None and decision.box is not None:
            self.draw.rectangle(self._scaled(decision.box.tolist()), outline=FOUND, width=3)

    def write(self, text: str) -> None:
        """Write a line of text at the upper border."""
        from PIL import ImageFont

        self.draw.rectangle((0, 0, self.picture.size[0], 22), fill="black")
        # Pillow's own font has no such sign.
        self.draw.text((6, 2), text.replace("×", "x"), fill="white", font=ImageFont.load_default(14))

    def _mark(self, shape: Callable[..., None], box: Box) -> None:
        """Draw a shape twice: a light line under a coloured one."""
        shape(box, outline="white", width=5)
        shape(box, outline=GAZE, width=3)

    def _scaled(self, box: Sequence[float], margin: int = 0) -> Box:
        """Convert a box to pixels of the drawing, with a margin."""
        x_scale, y_scale = self.scale
        left, right = sorted((box[0] * x_scale, box[2] * x_scale))
        top, bottom = sorted((box[1] * y_scale, box[3] * y_scale))
        return left - margin, top - margin, right + margin, bottom + margin

    def _scaled_point(self, point: Sequence[float]) -> tuple[float, float]:
        """Convert a point to pixels of the drawing."""
        return (point[0] + 0.5) * self.scale[0], (point[1] + 0.5) * self.scale[1]


def video_suffix() -> str:
    """Find the suffix of the videos that OpenCV can write here: `.mp4`, or `.avi` where it was built without FFmpeg."""
    *suffixes, last = VIDEO_CODECS
    return next(filter(_can_be_written, suffixes), last)


def _can_be_written(suffix: str) -> bool:
    """Tell whether OpenCV has the codec of a kind of video, which it says only of a file that it opens."""
    import tempfile

    import cv2

    with tempfile.TemporaryDirectory() as folder:
        code = cv2.VideoWriter.fourcc(*VIDEO_CODECS[suffix])
        writer = cv2.VideoWriter(f"{folder}/try{suffix}", code, 10, (64, 64))
        is_open = bool(writer.isOpened())
        writer.release()
    return is_open


@contextmanager
def video(path: Path, rate: float) -> Iterator[Callable[[_Frame], None]]:
    """Open a video to write frames to, whole or not at all.

    Args:
        path: the file, whose suffix is one of `VIDEO_CODECS`.
        rate: frames a second.

    Yields:
        A function that adds a frame `(h, w, 3)`; all have the size of the first one.

    Raises:
        DataError: OpenCV is not installed, or cannot write such a video, as on a full disk.
    """
    with needing("OpenCV", path, "opencv-python-headless", DataError):
        import cv2  # noqa: F401
    with replacing(path) as temporary:
        # OpenCV chooses the container by the suffix.
        named = temporary.with_name(temporary.name + path.suffix)
        writer = _FrameWriter(named, path, rate)
        try:
            yield writer.add
            if writer.close():
                writer.check()
                named.replace(temporary)
        finally:
            writer.close()
            named.unlink(missing_ok=True)


class _FrameWriter:
    """Writer of the frames of a video, which is opened with the first frame, whose size all have.

    Args:
        file: the file that is written.
        path: what the video is called in the end, whose suffix says its codec.
        rate: frames a second.
    """

    def __init__(self, file: Path, path: Path, rate: float) -> None:
        self._file = file
        self._path = path
        self._rate = rate
        self._frames = 0
        self._writer: Any = None

    def add(self, frame: _Frame) -> None:
        """Add a frame `(h, w, 3)`, RGB."""
        if self._writer is None:
            self._open(frame.shape[1], frame.shape[0])
        self._writer.write(np.ascontiguousarray(frame[..., ::-1]))  # OpenCV writes BGR
        self._frames += 1

    def _open(self, width: int, height: int) -> None:
        """Open the file for frames of a size; raises `DataError` where OpenCV has no encoder."""
        import cv2

        codec = VIDEO_CODECS[self._path.suffix.lower()]
        self._writer = cv2.VideoWriter(str(self._file), cv2.VideoWriter.fourcc(*codec), self._rate, (width, height))
        if not self._writer.isOpened():
            other = f"{self._path.stem}{video_suffix()}"
            raise DataError(f"cannot write {self._path}: OpenCV has no {codec} encoder; name it {other}")

    def close(self) -> bool:
        """Close the file; returns whether there was a frame."""
        if self._writer is None:
            return False
        self._writer.release()
        return True

    def check(self) -> None:
        """Raise `DataError` where the file does not end with the last frame: OpenCV says nothing of a full disk."""
        if not has_frames(self._file, self._frames):
            raise DataError(
                f"cannot write {self._path}: the disk may be full; make room, and give the same command again"
            )
