"""What a notebook shows of a record: the photograph with windows and objects, or the page of a scanpath in a frame."""

from collections.abc import Sequence
from html import escape

from torch import Tensor

from semfov.paths import Record, Scanpath
from semfov.report.episode import episode_data, jpeg_uri
from semfov.report.page import page_html
from semfov.viz.labels import at_both_ends
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
    """Draw the windows of the looks, numbered in their order, and the objects on the photograph.

    Args:
        record: the record.

    Returns:
        HTML, with the summary above the drawing and a key below it.
    """
    width, height = record.size
    unit = max(width, height) / _WIDTH  # pixels of the picture in about a pixel of the screen
    shapes = [_photograph(record), *_window_shapes(record, unit), *_object_shapes(record, unit)]
    drawing = f'<svg viewBox="0 0 {width} {height}" style="width:{_WIDTH}px;max-width:100%">{"".join(shapes)}</svg>'
    return f"<div>{escape(record.summary())}<br>{drawing}<br>{_key(record)}</div>"


def _photograph(record: Record) -> str:
    """Place the photograph, or a grey rectangle where it was not kept."""
    width, height = record.size
    if record.image is None:
        return f'<rect width="{width}" height="{height}" fill="#eee"/>'
    uri = jpeg_uri(record.image, _WIDTH, _QUALITY)
    return f'<image href="{uri}" width="{width}" height="{height}" preserveAspectRatio="none"/>'


def _window_shapes(record: Record, unit: float) -> list[str]:
    """Draw what each look shows that is not the whole picture, with its number."""
    shapes = []
    for look in record:
        if record.is_whole(look.region):
            continue
        x1, y1 = look.region[:2]
        shapes.append(_rect(look.region, GAZE, unit))
        place = f'x="{x1 + 3 * unit:.0f}" y="{y1 + 11 * unit:.0f}"'
        style = f'font-size="{11 * unit:.0f}" fill="{GAZE}" stroke="#fff" stroke-width="{3 * unit:.1f}"'
        shapes.append(f'<text {place} {style} paint-order="stroke">{look.number}</text>')
    return shapes


def _object_shapes(record: Record, unit: float) -> list[str]:
    """Draw the objects, confirmed ones in another colour, and the best place, dashed; both at both ends of a seam."""
    width = record.size[0]
    shapes = []
    for row in record.object_rows()[:_MOST]:
        name = escape(f"{row['class']} {row['score']:.2f}")
        title = f"<title>{name}</title>"
        colour = TARGET
        line = 1.2 * unit
        if row["confirmed"]:
            title = f"<title>{name}, confirmed</title>"
            colour = FOUND
            line = 2 * unit
        box = (row["x1"], row["y1"], row["x2"], row["y2"])
        shapes += [_rect(part, colour, line, title) for part in at_both_ends(box, width)]
    if record.best_place is not None:
        place, chance = record.best_place
        title = f"<title>best place {chance:.2f}</title>"
        shapes += [_rect(box, FOUND, 2 * unit, title, dashed=True) for box in at_both_ends(place.tolist(), width)]
    return shapes


def _key(record: Record) -> str:
    """Explain the colours of the boxes."""
    key = ""
    if len(record.objects):
        confirmed = ", and confirmed ones green" if record.confirmable else ""
        key = f"Objects from {record.words.threshold} are orange{confirmed}. "
    if record.best_place is not None:
        key += "The best place, not sure enough, is dashed."
    return key


def _rect(box: Sequence[float], colour: str, line: float, inside: str = "", *, dashed: bool = False) -> str:
    """Draw a box with a line of some width, and HTML inside."""
    x1, y1, x2, y2 = box
    side = f'x="{x1:.1f}" y="{y1:.1f}" width="{x2 - x1:.1f}" height="{y2 - y1:.1f}"'
    stroke = f'stroke="{colour}" stroke-width="{line:.1f}"'
    stroke += f' stroke-dasharray="{4 * line:.1f} {2.5 * line:.1f}"' * dashed
    return f'<rect {side} fill="none" {stroke} pointer-events="all">{inside}</rect>'


def scanpath_html(scanpath: Scanpath) -> str:
    """Make the page of a scanpath in a frame, with pictures as fine as fit; a short text where none fit.

    Args:
        scanpath: the scanpath.

    Returns:
        HTML of at most `_MOST_CHARACTERS`.
    """
    # Maps of classes fit beside those of background and entropy, and the acquisition values.
    cells = len(scanpath) * len(scanpath.grid)
    bytes_of_map = 4 * cells / 3  # in base 64, four letters for three bytes
    classes = min(len(scanpath.classes) - 1, int((_MAPS - 8 * cells) / bytes_of_map - 2))
    if classes >= 1:
        views = None if scanpath.stimulus is None else scanpath.views()
        # The notebook's file keeps the page of each record.
        for width, quality in _FINENESS:
            frame = _frame(scanpath, views, classes, width, quality)
            if len(frame.encode()) <= _MOST_CHARACTERS:
                return frame
    text = escape(repr(scanpath))
    return f"<pre>{text}\n  too long to step through here; use scanpath.plot() or scanpath.to_frame()</pre>"


def _frame(scanpath: Scanpath, views: Sequence[Tensor] | None, classes: int, width: int, quality: int) -> str:
    """Make the page of a scanpath in a frame that shares nothing with the notebook."""
    name = "{} × {} px".format(*scanpath.size)
    data = episode_data(scanpath, scanpath.image, views, name=name, classes=classes, width=width, quality=quality)
    words = scanpath.describe()
    return (
        f'<iframe title="{escape(words)}" sandbox="allow-scripts" loading="lazy" '
        f'srcdoc="{escape(page_html(f"semfov: {scanpath.words.task}", [data]))}" '
        f'style="width:100%;height:{_HEIGHT}px;border:1px solid #888;border-radius:6px"></iframe>'
    )
