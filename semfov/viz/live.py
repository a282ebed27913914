"""The view and belief of an agent drawn into frames of a camera or a video, and video files of such frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import DataError
from semfov.io.files import replacing
from semfov.paths import FoveaMoment, Moment, WindowMoment
from semfov.paths.stimulus import in_bytes
from semfov.viz.style import FOUND, GAZE, TARGET

if TYPE_CHECKING:
    from PIL import Image

_Frame = NDArray[np.uint8]
_Box = tuple[float, float, float, float]

_LONGEST = 640
_LONGEST_OF_WINDOWS = 1280  # small objects of large frames are to be seen
# Containers and codecs in the order in which they are tried; every build of OpenCV has the last one.
VIDEO_CODECS = {".mp4": "mp4v", ".avi": "MJPG"}
"""Suffixes of videos that can be written, and their codecs."""


def draw_moment(image: Tensor, moment: Moment, text: str) -> _Frame:
    """Draw what is known at a frame, and where the next look goes, into the frame.

    Of a fovea, the opacity of the colour over a cell is proportional to the probability that the cell holds the target,
    or in an exploration any object. A circle marks the present gaze, and a line leads to the point of the next one. A
    frame around the box of the target replaces the circle if the look is a closer one.

    Of windows, a frame marks the present window, a thin one the next, and boxes the objects: those that are confirmed
    in their own colour.

    Shapes: image `(3, H, W)` → `(h, w, 3)`.
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = image.shape[-2:]
    longest = _LONGEST_OF_WINDOWS if isinstance(moment, WindowMoment) else _LONGEST
    scale = min(1.0, longest / max(width, height))
    size = max(2, round(width * scale / 2) * 2), max(2, round(height * scale / 2) * 2)
    pixels = in_bytes(image) if image.is_floating_point() else image
    picture = Image.fromarray(pixels.permute(1, 2, 0).cpu().numpy()).resize(size)
    across, down = size[0] / width, size[1] / height

    def to_drawing(box: Sequence[float]) -> _Box:
        """The box in pixels of the drawing."""
        x1, y1, x2, y2 = (c * s for c, s in zip(box, (across, down) * 2, strict=True))
        return min(x1, x2), min(y1, y2), max(x1, x2), max(y1, y2)

    if isinstance(moment, FoveaMoment):
        _draw_gaze(picture, moment, (across, down), to_drawing)
    elif isinstance(moment, WindowMoment):
        _draw_windows(picture, moment, to_drawing)
    draw = ImageDraw.Draw(picture)
    if moment.decision is not None and moment.decision.box is not None:
        draw.rectangle(to_drawing(moment.decision.box.tolist()), outline=FOUND, width=3)
    draw.rectangle((0, 0, size[0], 22), fill="black")
    # Pillow's own font has no such sign.
    draw.text((6, 2), text.replace("×", "x"), fill="white", font=ImageFont.load_default(14))
    return np.asarray(picture)


def _draw_gaze(
    picture: Image.Image, moment: FoveaMoment, scale: tuple[float, float], to_drawing: Callable[[Sequence[float]], _Box]
) -> None:
    """Draw belief, gaze and closer look of a fovea."""
    from PIL import Image, ImageDraw

    grid, size = moment.grid, picture.size
    chance = moment.probability.detach().float().clamp(0, 1).reshape(grid.rows, grid.columns).cpu().numpy()
    strength = Image.fromarray((chance * 160).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    picture.paste(Image.new("RGB", size, TARGET), mask=strength)
    draw = ImageDraw.Draw(picture)
    x, y = ((c + 0.5) * s for c, s in zip(moment.fixation.tolist(), scale, strict=True))
    u, v = ((c + 0.5) * s for c, s in zip(grid.centres[moment.next_cell].tolist(), scale, strict=True))
    draw.line((x, y, u, v), fill=GAZE, width=2)
    if moment.closer is None:
        mark, here = draw.ellipse, (x - 9, y - 9, x + 9, y + 9)
    else:
        left, top, right, bottom = to_drawing(moment.closer.box.tolist())
        mark, here = draw.rectangle, (left - 6, top - 6, right + 6, bottom + 6)
    mark(here, outline="white", width=5)
    mark(here, outline=GAZE, width=3)


def _draw_windows(picture: Image.Image, moment: WindowMoment, to_drawing: Callable[[Sequence[float]], _Box]) -> None:
    """Draw the present and the next window, and the objects."""
    from PIL import ImageDraw

    draw = ImageDraw.Draw(picture)
    for box, sure in zip(moment.objects.boxes.tolist(), moment.confirmed.tolist(), strict=True):
        draw.rectangle(to_drawing(box), outline=FOUND if sure else TARGET, width=2)
    draw.rectangle(to_drawing(moment.next_window.region(moment.lattice)), outline=GAZE, width=1)
    here = to_drawing(moment.window.region(moment.lattice))
    draw.rectangle(here, outline="white", width=5)
    draw.rectangle(here, outline=GAZE, width=3)


def video_suffix() -> str:
    """Suffix of the videos that OpenCV can write here: `.mp4`, or `.avi` where it was built without FFmpeg."""
    return next(suffix for suffix, codec in VIDEO_CODECS.items() if suffix == ".avi" or _writes(suffix, codec))


@contextmanager
def video(path: Path, rate: float) -> Iterator[Callable[[_Frame], None]]:
    """Write frames to a video, whole or not at all."""
    try:
        import cv2
    except ImportError:
        raise DataError(f"{path}: videos need OpenCV: pip install opencv-python-headless") from None
    codec = VIDEO_CODECS[path.suffix.lower()]
    with replacing(path) as temporary:
        # OpenCV chooses the container by the suffix.
        named = temporary.with_name(temporary.name + path.suffix)
        writer: Any = None
        try:

            def add(frame: _Frame) -> None:
                nonlocal writer
                if writer is None:
                    code = cv2.VideoWriter.fourcc(*codec)
                    writer = cv2.VideoWriter(str(named), code, rate, (frame.shape[1], frame.shape[0]))
                    if not writer.isOpened():
                        other = f"{path.stem}{video_suffix()}"
                        raise DataError(f"cannot write {path}: OpenCV has no {codec} encoder; name it {other}")
                writer.write(np.ascontiguousarray(frame[..., ::-1]))

            yield add
            if writer is not None:
                writer.release()
                named.replace(temporary)
        finally:
            if writer is not None:
                writer.release()
            named.unlink(missing_ok=True)


def _writes(suffix: str, codec: str) -> bool:
    """Whether OpenCV has this encoder."""
    import tempfile

    import cv2

    with tempfile.TemporaryDirectory() as folder:
        writer = cv2.VideoWriter(f"{folder}/try{suffix}", cv2.VideoWriter.fourcc(*codec), 10, (64, 64))
        opened = bool(writer.isOpened())
        writer.release()
    return opened
