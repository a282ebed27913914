"""A path through a large picture as a notebook shows it: a drawing of windows and objects, without the picture."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from semfov.zoom.gist import FOUND

if TYPE_CHECKING:
    from semfov.zoom.search import ZoomPath

WIDTH = 480
"""Of the drawing, in pixels of the screen."""

MOST = 500
"""Objects that are drawn: the most certain ones."""


def path_html(path: ZoomPath) -> str:
    """What came of it in a line, above a drawing."""
    width, height = path.lattice.size
    unit = max(width, height) / WIDTH
    shapes = [f'<rect width="{width}" height="{height}" fill="#eee"/>']
    for number in range(1, path.passes):
        x1, y1, x2, y2 = path.shown(number)
        shapes.append(_rect(x1, y1, x2, y2, "#0072b2", unit))
        at = f'x="{x1 + 3 * unit:.0f}" y="{y1 + 11 * unit:.0f}"'
        shapes.append(f'<text {at} font-size="{10 * unit:.0f}" fill="#0072b2">{number}</text>')
    sure = path.objects.above(FOUND)
    for box, label, score in zip(sure.boxes.tolist()[:MOST], sure.labels.tolist(), sure.scores.tolist(), strict=False):
        title = f"<title>{escape(path.classes[label])} {score:.2f}</title>"
        shapes.append(_rect(box[0], box[1], box[2], box[3], "#d55e00", unit, title))
    drawing = f'<svg viewBox="0 0 {width} {height}" style="width:{WIDTH}px;max-width:100%">{"".join(shapes)}</svg>'
    return f"<div>{escape(path.describe())}<br>{drawing}</div>"


def _rect(x1: float, y1: float, x2: float, y2: float, colour: str, unit: float, inside: str = "") -> str:
    side = f'x="{x1:.1f}" y="{y1:.1f}" width="{x2 - x1:.1f}" height="{y2 - y1:.1f}"'
    return f'<rect {side} fill="none" stroke="{colour}" stroke-width="{unit:.1f}" pointer-events="all">{inside}</rect>'
