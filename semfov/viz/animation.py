"""Animations of figures: GIF by Pillow, MP4 where ffmpeg is installed."""

from __future__ import annotations

import base64
import io
import shutil
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import DataError, check
from semfov.io.files import replacing
from semfov.scanpath import Scanpath, describe
from semfov.viz.drawing import photograph_of
from semfov.viz.fixation import FixationFigure
from semfov.viz.scanpath import views_of
from semfov.viz.style import STYLE

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Film:
    """Frames that a notebook shows one after the other.

    Attributes:
        frames: pixels `(H, W, 3)`, all of one size.
        seconds: that each frame stays.
        hold: that the last frame stays longer.
        title: what is to be seen.
    """

    frames: list[Frame]
    seconds: float = 1.0
    hold: float = 2.0
    title: str = ""

    def __len__(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def __repr__(self) -> str:
        """What it is, in a line."""
        height, width = self.frames[0].shape[:2]
        return f"Film: {self.title}, {len(self)} frames of {width} × {height} px"

    def save(self, path: str | PathLike[str]) -> list[Path]:
        """Write a GIF and, where ffmpeg is installed, an MP4 beside it; returns what was written."""
        return save_animation(self.frames, Path(path), seconds=self.seconds, hold=self.hold)

    def _repr_html_(self) -> str:
        """The GIF itself, in the notebook's file."""
        from html import escape

        file = io.BytesIO()
        write_gif(self.frames, file, self.seconds, self.hold)
        data = base64.b64encode(file.getvalue()).decode()
        return f'<img style="max-width:100%" alt="{escape(self.title)}" src="data:image/gif;base64,{data}">'


def animate(
    scanpath: Scanpath,
    path: str | PathLike[str] | None = None,
    *,
    image: Tensor | None = None,
    views: Sequence[Tensor] | None = None,
    boxes: Tensor | None = None,
    seconds: float = 1.0,
    hold: float = 2.0,
) -> Path | Film:
    """Draw an episode as a film: for each fixation the scanpath so far, what was seen, and what was believed.

    Args:
        scanpath: the episode.
        path: of a GIF to write, with an MP4 beside it where ffmpeg is installed; None gives the film itself.
        image: `(3, H, W)`, RGB in [0, 1]; None is the scanpath's own.
        views: for each fixation the foveated photograph `(3, h, w)`; None are the scanpath's own.
        boxes: `(M, 4)`, where the target really is.
        seconds: that each frame stays.
        hold: that the last frame stays longer.

    Raises:
        InputError: there are no photograph and views, neither given nor kept.
        DataError: the file cannot be written.
    """
    film = film_of(scanpath, image=image, views=views, boxes=boxes, seconds=seconds, hold=hold)
    return film if path is None else film.save(path)[0]


def film_of(
    scanpath: Scanpath,
    *,
    image: Tensor | None = None,
    views: Sequence[Tensor] | None = None,
    boxes: Tensor | None = None,
    seconds: float = 1.0,
    hold: float = 2.0,
) -> Film:
    """The film of an episode; arguments as for `animate`."""
    check(seconds > 0, "seconds", "a positive time", seconds)
    check(hold >= 0, "hold", "0 seconds or more", hold)
    frames = episode_frames(scanpath, photograph_of(scanpath, image), views_of(scanpath, views), boxes)
    return Film(frames, seconds, hold, describe(scanpath))


def episode_frames(
    scanpath: Scanpath, image: Tensor, views: Sequence[Tensor], boxes: Tensor | None = None, dpi: int = 90
) -> list[Frame]:
    """Frames of an episode, all drawn in one figure; each is what `plot_fixation` draws."""
    from matplotlib import rc_context

    def figures() -> Iterator[Any]:
        drawn = FixationFigure(scanpath, image, views[0], boxes)
        for fixation, view in enumerate(views):
            yield drawn.show(fixation, view)

    with rc_context(STYLE):
        return render(figures(), dpi)


def render(figures: Iterable[Any], dpi: int = 90) -> list[Frame]:
    """Pixels `(H, W, 3)` of matplotlib figures, each drawn before the next one is asked for."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    frames = []
    for figure in figures:
        figure.set_dpi(dpi)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return frames


def in_palette(frame: Frame, refine: int = 0) -> Any:
    """A frame as a Pillow image of 256 colours of its own, dithered; refining the colours takes seconds a round."""
    from PIL import Image

    image = Image.fromarray(frame)
    return image.quantize(palette=image.quantize(256, kmeans=refine))


def save_animation(frames: Sequence[Frame], path: Path, *, seconds: float = 1.0, hold: float = 2.0) -> list[Path]:
    """Write `path` (a GIF) and, where ffmpeg is installed, an MP4 beside it; returns what was written.

    Args:
        frames: pixels `(H, W, 3)`, all of one size.
        path: of the GIF.
        seconds: that each frame stays.
        hold: that the last frame stays longer.
    """
    with replacing(path) as temporary, temporary.open("wb") as file:
        write_gif(frames, file, seconds, hold)
    ffmpeg = shutil.which("ffmpeg")
    return [path] if ffmpeg is None else [path, _save_mp4(ffmpeg, frames, path.with_suffix(".mp4"), seconds, hold)]


def write_gif(frames: Sequence[Frame], file: Any, seconds: float, hold: float) -> None:
    """Write frames as a GIF, in 256 colours that they share."""
    first, *others = in_one_palette(frames)
    times = [int(1000 * seconds)] * len(frames)
    times[-1] += int(1000 * hold)
    first.save(file, format="GIF", save_all=True, append_images=others, duration=times, loop=0)


def in_one_palette(frames: Sequence[Frame], most: int = 6) -> list[Any]:
    """Frames as Pillow images of 256 colours: those of `most` of them, dithered.

    A palette of each frame's own would make what stands still flicker.
    """
    from PIL import Image

    chosen = [frames[round(n)] for n in np.linspace(0, len(frames) - 1, min(most, len(frames)))]
    palette = Image.fromarray(np.concatenate([frame[::2, ::2] for frame in chosen])).quantize(256)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    # A mean of almost white is not white, and that is what most of a figure is.
    colours[(colours >= 244).all(-1)] = 255
    palette.putpalette(colours.flatten().tolist())
    return [Image.fromarray(frame).quantize(palette=palette) for frame in frames]


def _save_mp4(ffmpeg: str, frames: Sequence[Frame], path: Path, seconds: float, hold: float) -> Path:
    height, width = frames[0].shape[:2]
    stay = 1 + round(hold / seconds)
    pixels = b"".join(frame.tobytes() for frame in [*frames[:-1], *[frames[-1]] * stay])
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{1 / seconds:g}", "-i", "-"]
    # Players want even sizes, 4:2:0 colour and more than one frame a second.
    options = ["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p", "-r", "10", "-f", "mp4"]
    with replacing(path) as temporary:
        command = [ffmpeg, "-loglevel", "error", "-y", *source, *options, str(temporary)]
        done = subprocess.run(command, input=pixels, capture_output=True, check=False)
        if done.returncode:
            raise DataError(f"{path}: ffmpeg failed: {done.stderr.decode(errors='replace').strip()}")
    return path
