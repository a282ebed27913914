"""A record as a notebook shows it: the photograph with windows and objects, under a line of text."""

from collections.abc import Sequence
from html import escape

from semfov.paths import Record
from semfov.report.episode import jpeg_uri
from semfov.viz.style import FOUND, GAZE, TARGET

WIDTH = 640
"""Width of the drawing in pixels of the screen."""

_MOST = 500  # largest number of objects that are drawn; the most confident ones are
_QUALITY = 75  # of the photograph, a JPEG


def record_html(record: Record) -> str:
    """Draw the windows of the looks, numbered in their order, and the objects on the photograph, as HTML.

    Objects that were confirmed are green, others orange. A grey rectangle stands for a photograph that was not kept.

    Args:
        record: the record.

    Returns:
        An HTML element.
    """
    width, height = record.size
    unit = max(width, height) / WIDTH
    shapes = [f'<rect width="{width}" height="{height}" fill="#eee"/>']
    if record.image is not None:
        size = f'width="{width}" height="{height}" preserveAspectRatio="none"'
        shapes = [f'<image href="{jpeg_uri(record.image, WIDTH, _QUALITY)}" {size}/>']
    for look in record:
        if record.is_whole(look.region):
            continue
        x1, y1 = look.region[:2]
        shapes.append(_rect(look.region, GAZE, unit))
        at = f'x="{x1 + 3 * unit:.0f}" y="{y1 + 11 * unit:.0f}"'
        style = f'font-size="{11 * unit:.0f}" fill="{GAZE}" stroke="#fff" stroke-width="{3 * unit:.1f}"'
        shapes.append(f'<text {at} {style} paint-order="stroke">{look.number}</text>')
    for row in record.object_rows()[:_MOST]:
        colour, sure = (FOUND, ", confirmed") if row["confirmed"] else (TARGET, "")
        title = f"<title>{escape(row['class'])} {row['score']:.2f}{sure}</title>"
        for turn in (0, width) if row["x2"] > width else (0,):
            box = row["x1"] - turn, row["y1"], row["x2"] - turn, row["y2"]
            shapes.append(_rect(box, colour, (2 if sure else 1.2) * unit, title))
    drawing = f'<svg viewBox="0 0 {width} {height}" style="width:{WIDTH}px;max-width:100%">{"".join(shapes)}</svg>'
    green = ", and confirmed ones green" if record.confirmable else ""
    key = f"Objects from {record.measure} {record.least:g} are orange{green}."
    return f"<div>{escape(record.summary())}<br>{drawing}<br>{key if len(record.objects) else ''}</div>"


def _rect(box: Sequence[float], colour: str, line: float, inside: str = "") -> str:
    x1, y1, x2, y2 = box
    side = f'x="{x1:.1f}" y="{y1:.1f}" width="{x2 - x1:.1f}" height="{y2 - y1:.1f}"'
    return f'<rect {side} fill="none" stroke="{colour}" stroke-width="{line:.1f}" pointer-events="all">{inside}</rect>'
