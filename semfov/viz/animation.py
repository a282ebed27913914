"""Animations of figures: GIF by Pillow, MP4 where ffmpeg is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.errors import DataError
from semfov.io.files import replacing

Frame = NDArray[np.uint8]


def render(figures: Iterable[Any], dpi: int = 90) -> list[Frame]:
    """Pixels `(H, W, 3)` of matplotlib figures."""
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
    first, *others = map(in_palette, frames)
    times = [int(1000 * seconds)] * len(frames)
    times[-1] += int(1000 * hold)
    with replacing(path) as temporary:
        first.save(temporary, format="GIF", save_all=True, append_images=others, duration=times, loop=0)
    ffmpeg = shutil.which("ffmpeg")
    return [path] if ffmpeg is None else [path, _save_mp4(ffmpeg, frames, path.with_suffix(".mp4"), seconds, hold)]


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
