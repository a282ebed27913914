"""A scanpath as a notebook shows it: the stepping page in a frame of its own, and never larger than it should be."""

from __future__ import annotations

from html import escape

from semfov.report.episode import Pool, episode_data
from semfov.report.page import page_html
from semfov.scanpath import Scanpath, describe
from semfov.scanpath.drawing import draws
from semfov.viz.animation import animate
from semfov.viz.scanpath import plot_scanpath

MOST = 3_000_000
"""No more bytes than this go into a notebook's file for one scanpath."""

HEIGHT = 760
"""Of the frame, in pixels; the page scrolls in it."""

FINENESS = ((416, 75), (320, 65), (240, 55), (160, 45))
"""Widths in pixels and JPEG qualities of the pictures: the first that fits is taken."""

_MAPS = MOST // 4
"""What the probability maps may take."""


def notebook_html(scanpath: Scanpath) -> str:
    """A frame with the page to step through; where even the coarsest is too large, what the scanpath says in words.

    A frame shares neither style nor program with the notebook around it, and what is in it can reach nothing outside.
    """
    classes = _classes_that_fit(scanpath)
    if classes >= 1:
        views = None if scanpath.stimulus is None else scanpath.views()
        across, down = scanpath.grid.extent.tolist()
        name = f"{across:.0f} × {down:.0f} px"
        for width, quality in FINENESS:
            pool = Pool()
            data = episode_data(
                scanpath, scanpath.image, views, pool, name=name, classes=classes, width=width, quality=quality
            )
            frame = framed(page_html(f"semfov: {describe(scanpath)}", [data], pool), describe(scanpath))
            if len(frame.encode()) <= MOST:
                return frame
    words = escape(repr(scanpath))
    return f"<pre>{words}\n  too long to step through here: see scanpath.plot() and scanpath.to_frame()</pre>"


def framed(page: str, title: str) -> str:
    """A page in a frame that runs its program and may do nothing else."""
    return (
        f'<iframe title="{escape(title)}" sandbox="allow-scripts" loading="lazy" srcdoc="{escape(page)}" '
        f'style="width:100%;height:{HEIGHT}px;border:1px solid #888;border-radius:6px"></iframe>'
    )


def _classes_that_fit(scanpath: Scanpath) -> int:
    """How many classes' maps there is room for, beside those of background and entropy, and the values."""
    look = len(scanpath) * len(scanpath.grid)
    bytes_of_map, bytes_of_values = 4 * look / 3, 8 * look
    room = _MAPS - bytes_of_values - 2 * bytes_of_map
    return min(len(scanpath.classes) - 1, int(room // bytes_of_map))


draws("notebook", notebook_html)
draws("plot", plot_scanpath)
draws("animate", animate)
