"""The display of scanpaths in a notebook: the page to step through, in a frame, with a limited size.

Functions that draw records are registered here.
"""

from __future__ import annotations

from html import escape

from semfov.metrics.scanpath.beside import compare_scanpath
from semfov.paths import FoveaMoment, GazeRecord, HeadPath, Record, Scanpath, ZoomPath
from semfov.paths.drawing import draws
from semfov.report.drawing import record_html
from semfov.report.episode import episode_data
from semfov.report.page import page_html
from semfov.report.record import write_record, write_scanpath
from semfov.viz.animation import animate
from semfov.viz.head import animate_head, plot_head_path
from semfov.viz.scanpath import plot_scanpath
from semfov.viz.zoom import animate_looks, plot_moment, plot_zoom_path

MOST_CHARACTERS = 3_000_000
"""Largest number of bytes that a scanpath adds to a notebook's file."""

HEIGHT = 760
"""Height of the frame in pixels; the page scrolls in it."""

FINENESS = ((416, 75), (320, 65), (240, 55), (160, 45))
"""Widths in pixels and JPEG qualities of the pictures; the first pair that fits is taken."""

_MAPS = MOST_CHARACTERS // 4
"""Largest number of bytes of the probability maps."""


def notebook_html(scanpath: Scanpath) -> str:
    """The page to step through in a frame; a short text where the page would be too large.

    The frame shares neither styles nor scripts with the notebook around it, and its content cannot access anything
    outside.

    Args:
        scanpath: the episode.

    Returns:
        HTML.
    """
    classes = _classes_that_fit(scanpath)
    if classes >= 1:
        views = None if scanpath.stimulus is None else scanpath.views()
        across, down = scanpath.grid.extent.tolist()
        name = f"{across:.0f} × {down:.0f} px"
        for width, quality in FINENESS:
            data = episode_data(
                scanpath, scanpath.image, views, name=name, classes=classes, width=width, quality=quality
            )
            frame = framed(page_html(f"semfov: {scanpath.describe()}", [data]), scanpath.describe())
            if len(frame.encode()) <= MOST_CHARACTERS:
                return frame
    words = escape(repr(scanpath))
    return f"<pre>{words}\n  too long to step through here; use scanpath.plot() or scanpath.to_frame()</pre>"


def framed(page: str, title: str) -> str:
    """A page in a sandboxed frame that may run scripts and nothing else."""
    return (
        f'<iframe title="{escape(title)}" sandbox="allow-scripts" loading="lazy" srcdoc="{escape(page)}" '
        f'style="width:100%;height:{HEIGHT}px;border:1px solid #888;border-radius:6px"></iframe>'
    )


def _classes_that_fit(scanpath: Scanpath) -> int:
    """Number of classes whose maps fit, beside the maps of background and entropy and the acquisition values."""
    look = len(scanpath) * len(scanpath.grid)
    bytes_of_map, bytes_of_values = 4 * look / 3, 8 * look
    room = _MAPS - bytes_of_values - 2 * bytes_of_map
    return min(len(scanpath.classes) - 1, int(room // bytes_of_map))


draws("notebook", Record, record_html)
draws("notebook", Scanpath, notebook_html)
draws("report", Record, write_record)
draws("report", Scanpath, write_scanpath)
draws("plot", Scanpath, plot_scanpath)
draws("plot", ZoomPath, plot_zoom_path)
draws("plot", HeadPath, plot_head_path)
draws("plot", FoveaMoment, plot_moment)
draws("animate", Record, animate_looks)
draws("animate", Scanpath, animate)
draws("animate", HeadPath, animate_head)
draws("compare", GazeRecord, compare_scanpath)
