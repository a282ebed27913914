"""What a notebook shows of a record: the photograph with windows and objects, or the page of a scanpath in a frame."""

from collections.abc import Sequence
from html import escape

from semfov.paths import Record, Scanpath
from semfov.report.episode import episode_data, jpeg_uri
from semfov.report.page import page_html
from semfov.viz.style import FOUND, GAZE, TARGET

_MOST_CHARACTERS = 3_000_000  # largest number of bytes that a scanpath adds to a notebook's file
_HEIGHT = 760  # height of the frame in pixels; the page scrolls in it

_FINENESS = ((416, 75), (320, 65), (240, 55), (160, 45))
"""Widths in pixels and JPEG qualities of the pictures; the first pair that fits is taken."""

_MAPS = _MOST_CHARACTERS // 4  # largest number of bytes of the probability maps
_WIDTH = 640  # width of the drawing in pixels of the screen
_MOST = 500  # largest number of objects that are drawn; the most confident ones are
_QUALITY = 75  # of the photograph, a JPEG


def record_html(record: Record) -> str:
    """Draw the windows of the looks, numbered in their order, and the objects on the photograph, as HTML."""
    width, height = record.size
    unit = max(width, height) / _WIDTH
    shapes = [f'<rect width="{width}" height="{height}" fill="#eee"/>']
    if record.image is not None:
        size = f'width="{width}" height="{height}" preserveAspectRatio="none"'
        shapes = [f'<image href="{jpeg_uri(record.image, _WIDTH, _QUALITY)}" {size}/>']
    for look in record:
        if record.is_whole(look.region):
            continue
        x1, y1 = look.region[:2]
        shapes.append(_rect(look.region, GAZE, unit))
        at = f'x="{x1 + 3 * unit:.0f}" y="{y1 + 11 * unit:.0f}"'
        style = f'font-size="{11 * unit:.0f}" fill="{GAZE}" stroke="#fff" stroke-width="{3 * unit:.1f}"'
        shapes.append(f'<text {at} {style} paint-order="stroke">{look.number}</text>')
    rows, best, sides = record.object_rows()[:_MOST], record.best_place, ("x1", "y1", "x2", "y2")
    marks = [
        ([row[side] for side in sides], f"{row['class']} {row['score']:.2f}", row["confirmed"], False) for row in rows
    ]
    marks += [] if best is None else [(best[0].tolist(), f"best place {best[1]:.2f}", True, True)]
    for (x1, y1, x2, y2), name, green, dashed in marks:
        title = f"<title>{escape(name)}{', confirmed' * (green and not dashed)}</title>"
        colour, line = (FOUND, 2 * unit) if green else (TARGET, 1.2 * unit)
        for turn in (0, width) if x2 > width else (0,):
            shapes.append(_rect((x1 - turn, y1, x2 - turn, y2), colour, line, title, dashed=dashed))
    drawing = f'<svg viewBox="0 0 {width} {height}" style="width:{_WIDTH}px;max-width:100%">{"".join(shapes)}</svg>'
    sure = ", and confirmed ones green" if record.confirmable else ""
    key = f"Objects from {record.words.threshold} are orange{sure}. " if len(record.objects) else ""
    key += "The best place, not sure enough, is dashed." if best is not None else ""
    return f"<div>{escape(record.summary())}<br>{drawing}<br>{key}</div>"


def _rect(box: Sequence[float], colour: str, line: float, inside: str = "", *, dashed: bool = False) -> str:
    x1, y1, x2, y2 = box
    side = f'x="{x1:.1f}" y="{y1:.1f}" width="{x2 - x1:.1f}" height="{y2 - y1:.1f}"'
    stroke = f'stroke="{colour}" stroke-width="{line:.1f}"'
    stroke += f' stroke-dasharray="{4 * line:.1f} {2.5 * line:.1f}"' * dashed
    return f'<rect {side} fill="none" {stroke} pointer-events="all">{inside}</rect>'


def scanpath_html(scanpath: Scanpath) -> str:
    """The page to step through in a frame; a short text where the page would be too large."""
    # Maps of classes fit beside those of background and entropy, and the acquisition values.
    cells = len(scanpath) * len(scanpath.grid)
    room, bytes_of_map = _MAPS - 8 * cells, 4 * cells / 3
    classes, words = min(len(scanpath.classes) - 1, int(room / bytes_of_map - 2)), scanpath.describe()
    views = None if scanpath.stimulus is None or classes < 1 else scanpath.views()
    name = "{} × {} px".format(*scanpath.size)
    for width, quality in _FINENESS if classes >= 1 else ():
        data = episode_data(scanpath, scanpath.image, views, name=name, classes=classes, width=width, quality=quality)
        frame = (
            f'<iframe title="{escape(words)}" sandbox="allow-scripts" loading="lazy" '
            f'srcdoc="{escape(page_html(f"semfov: {words}", [data]))}" '
            f'style="width:100%;height:{_HEIGHT}px;border:1px solid #888;border-radius:6px"></iframe>'
        )
        if len(frame.encode()) <= _MOST_CHARACTERS:
            return frame
    text = escape(repr(scanpath))
    return f"<pre>{text}\n  too long to step through here; use scanpath.plot() or scanpath.to_frame()</pre>"
