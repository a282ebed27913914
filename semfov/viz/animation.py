"""Animations of episodes: GIF by Pillow, and MP4 where ffmpeg is installed."""

from __future__ import annotations

import base64
import io
import shutil
import subprocess
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.inputs import ImageLike
from semfov.errors import DataError, check
from semfov.io.files import MADE_HERE, replacing
from semfov.paths import Record
from semfov.viz.drawing import photograph_of
from semfov.viz.look import LookFigure, views_of
from semfov.viz.style import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from PIL.Image import Image as PillowImage

_Frame = NDArray[np.uint8]
_SAMPLED = 6  # largest number of frames from which a palette is made


@dataclass(frozen=True)
class Film:
    """Frames that a notebook shows one after the other; frames `(H, W, 3)`."""

    frames: list[_Frame]
    seconds: float = 1.0
    hold: float = 2.0
    title: str = ""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.frames)

    def __repr__(self) -> str:
        """Return the title and the size."""
        height, width = self.frames[0].shape[:2]
        return f"Film: {self.title}, {len(self)} frames of {width} × {height} px"

    def save(self, path: str | PathLike[str]) -> list[Path]:
        """Write a GIF and, where ffmpeg is installed, an MP4 beside it; returns the paths written."""
        path = Path(path)
        expected = "a file that ends in .gif (where ffmpeg is installed, an MP4 is written beside it)"
        check(path.suffix.lower() == ".gif", "path", expected, repr(str(path)))
        with replacing(path) as temporary, temporary.open("wb") as file:
            _write_gif(self.frames, file, self.seconds, self.hold)
        ffmpeg = shutil.which("ffmpeg")
        if ffmpeg is None:
            return [path]
        return [path, _save_mp4(ffmpeg, self.frames, path.with_suffix(".mp4"), self.seconds, self.hold)]

    def saved(self, path: str | PathLike[str] | None) -> Path | Film:
        """Write the film, and return the path of the GIF; without a path return the film itself."""
        return self if path is None else self.save(path)[0]

    def _repr_html_(self) -> str:
        """Show the film in a notebook."""
        from html import escape

        file = io.BytesIO()
        _write_gif(self.frames, file, self.seconds, self.hold)
        data = base64.b64encode(file.getvalue()).decode()
        return f'<img style="max-width:100%" alt="{escape(self.title)}" src="data:image/gif;base64,{data}">'


def animate(
    scanpath: Record,
    path: str | PathLike[str] | None = None,
    *,
    image: ImageLike | None = None,
    views: Sequence[Tensor] | None = None,
    boxes: Tensor | None = None,
    seconds: float = 1.0,
    hold: float = 2.0,
) -> Path | Film:
    """Make a film of a record of any kind, with a frame for each look, as `plot_fixation` draws it.

    Args:
        scanpath: the record.
        path: GIF file to write, with an MP4 beside it where ffmpeg is installed; None returns the film instead.
        image: `(3, H, W)`, RGB in [0, 1], or another picture of any common kind (`semfov.as_image`); None takes the
            record's own.
        views: for each fixation the foveated photograph `(3, h, w)`; None takes the record's own.
        boxes: `(M, 4)`, true boxes of the target.
        seconds: duration of each frame.
        hold: additional seconds of the last frame.

    Returns:
        The path of the GIF, or a film, which a notebook shows.

    Raises:
        InputError: the picture is neither given nor kept by the record, or a duration is out of range.
        DataError: the file cannot be written.

    Example::

        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
        animate(scanpath, "search.gif", seconds=0.5)
    """
    from matplotlib import rc_context

    check(seconds > 0, "seconds", "a positive time", seconds)
    check(hold >= 0, "hold", "0 seconds or more", hold)
    picture = photograph_of(scanpath, image)
    shown = views_of(scanpath, picture, views)
    with rc_context(STYLE):
        figure = LookFigure(scanpath, picture, shown[0], boxes)  # one for all frames
        frames = render(figure.show(number, view) for number, view in enumerate(shown))
    return Film(frames, seconds, hold, scanpath.describe()).saved(path)


def render(figures: Iterable[Figure], dpi: int = 90) -> list[_Frame]:
    """Draw matplotlib figures and return their pixels `(H, W, 3)`; each is drawn before the next is requested."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    frames = []
    for figure in figures:
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())  # without opacity
    return frames


def _write_gif(frames: Sequence[_Frame], file: BinaryIO, seconds: float, hold: float) -> None:
    """Write frames as a GIF with a common palette of 256 colours."""
    first, *following = _in_one_palette(frames)
    times = [int(1000 * seconds)] * len(frames)  # milliseconds
    times[-1] += int(1000 * hold)
    first.save(file, format="GIF", save_all=True, append_images=following, duration=times, loop=0, comment=MADE_HERE)


def write_webp(
    frames: Sequence[PillowImage],
    file: BinaryIO,
    seconds: Sequence[float],
    quality: int,
    *,
    effort: int = 4,
) -> None:
    """Write frames as an animated WebP that repeats.

    Args:
        frames: the frames, of one size.
        file: what is written to.
        seconds: duration of each frame.
        quality: up to 100; at low ones lines of earlier frames are left faintly where little has changed.
        effort: how long to try for a smaller file, 0 to 6.
    """
    first, *following = frames
    times = [round(1000 * duration) for duration in seconds]
    first.save(
        file, "WEBP", save_all=True, append_images=following, duration=times, loop=0, quality=quality, method=effort
    )


def _in_one_palette(frames: Sequence[_Frame]) -> list[PillowImage]:
    """Convert frames `(H, W, 3)` to images with a common palette, without which static parts would flicker."""
    from PIL import Image

    numbers = np.linspace(0, len(frames) - 1, min(_SAMPLED, len(frames)))
    # Every second pixel of a few frames has all colours.
    samples = [frames[round(number)][::2, ::2] for number in numbers]
    palette = Image.fromarray(np.concatenate(samples)).quantize(256)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    # Most of a figure is white, but the palette's mean of nearly white pixels is not: make it white.
    is_nearly_white = (colours >= 244).all(-1)
    colours[is_nearly_white] = 255
    palette.putpalette(colours.flatten().tolist())
    return [Image.fromarray(frame).quantize(palette=palette) for frame in frames]


def _save_mp4(ffmpeg: str, frames: Sequence[_Frame], path: Path, seconds: float, hold: float) -> Path:
    """Write frames as an MP4.

    Args:
        ffmpeg: the program.
        frames: `(H, W, 3)` each.
        path: the file.
        seconds: duration of a frame.
        hold: additional seconds of the last frame.

    Returns:
        The path.
    """
    height, width = frames[0].shape[:2]
    # The last frame is repeated to hold it.
    repeats = round(hold / seconds)
    pixels = b"".join(frame.tobytes() for frame in [*frames, *[frames[-1]] * repeats])
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{1 / seconds:g}", "-i", "-"]
    # Players need even sizes, 4:2:0 colour and more than one frame per second.
    options = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-r", "10", "-f", "mp4"]
    with replacing(path) as temporary:
        command = [ffmpeg, "-loglevel", "error", "-y", *source, *options, str(temporary)]
        done = subprocess.run(command, input=pixels, capture_output=True, check=False)
        if done.returncode:
            reason = done.stderr.decode(errors="replace").strip()
            raise DataError(f"{path}: ffmpeg failed: {reason}")
    return path
