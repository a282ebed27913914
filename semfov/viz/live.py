"""The view and belief of an agent drawn into frames of a camera or a video, and video files of such frames."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import DataError, needing
from semfov.io.files import replacing
from semfov.paths import Moment
from semfov.paths.stimulus import in_bytes
from semfov.viz.style import FOUND, GAZE, TARGET

_Frame = NDArray[np.uint8]
_Box = tuple[float, float, float, float]

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
    """Draw what is known at a frame, and where the next look goes, into the frame `(3, H, W)`; `(h, w, 3)`.

    The drawing has a `(width, height)`, or None for that of a frame of the video that is written.
    """
    from PIL import Image, ImageDraw, ImageFont

    (height, width), look, ahead = image.shape[-2:], moment.looks[-1], moment.next_region
    size = size or reduced((width, height), _LONGEST if ahead is None else _LONGEST_OF_WINDOWS)
    pixels = in_bytes(image) if image.is_floating_point() else image
    picture = Image.fromarray(pixels.permute(1, 2, 0).cpu().numpy()).resize(size)
    across, down = size[0] / width, size[1] / height

    def drawn(box: Sequence[float], margin: int = 0) -> _Box:
        """The box in pixels of the drawing."""
        x1, y1, x2, y2 = (c * s for c, s in zip(box, (across, down) * 2, strict=True))
        return min(x1, x2) - margin, min(y1, y2) - margin, max(x1, x2) + margin, max(y1, y2) + margin

    believed = moment.belief_map(look.number)
    if believed is not None:
        grid, chances = believed
        table = chances.detach().float().clamp(0, 1).reshape(grid.rows, grid.columns).cpu().numpy()
        strength = Image.fromarray((table * 160).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
        picture.paste(Image.new("RGB", size, TARGET), mask=strength)
    draw = ImageDraw.Draw(picture)
    mark: Any = draw.rectangle
    here = drawn(look.region)
    if ahead is not None:
        for box, sure in zip(moment.objects.boxes.tolist(), moment.confirmed.tolist(), strict=True):
            draw.rectangle(drawn(box), outline=FOUND if sure else TARGET, width=2)
        draw.rectangle(drawn(ahead), outline=GAZE, width=1)
    else:
        (x, y), (u, v) = (((px + 0.5) * across, (py + 0.5) * down) for px, py in (look.fixation, moment.next_point))
        draw.line((x, y, u, v), fill=GAZE, width=2)
        mark, here = draw.ellipse, (x - 9, y - 9, x + 9, y + 9)
        if moment.examined is not None:
            mark, here = draw.rectangle, drawn(moment.examined.box.tolist(), 6)
    mark(here, outline="white", width=5)
    mark(here, outline=GAZE, width=3)
    if moment.decision is not None and moment.decision.box is not None:
        draw.rectangle(drawn(moment.decision.box.tolist()), outline=FOUND, width=3)
    draw.rectangle((0, 0, size[0], 22), fill="black")
    # Pillow's own font has no such sign.
    draw.text((6, 2), text.replace("×", "x"), fill="white", font=ImageFont.load_default(14))
    return np.asarray(picture)


def video_suffix() -> str:
    """Suffix of the videos that OpenCV can write here: `.mp4`, or `.avi` where it was built without FFmpeg."""
    import tempfile

    import cv2

    *others, last = VIDEO_CODECS
    for suffix in others:
        with tempfile.TemporaryDirectory() as folder:
            code = cv2.VideoWriter.fourcc(*VIDEO_CODECS[suffix])
            writer = cv2.VideoWriter(f"{folder}/try{suffix}", code, 10, (64, 64))
            opened = bool(writer.isOpened())
            writer.release()
        if opened:
            return suffix
    return last


@contextmanager
def video(path: Path, rate: float) -> Iterator[Callable[[_Frame], None]]:
    """Write frames to a video, whole or not at all."""
    with needing("OpenCV", path, "opencv-python-headless", DataError):
        import cv2
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
