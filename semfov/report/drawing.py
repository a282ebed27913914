"""A path through a large picture as a notebook shows it: a drawing of windows and objects, without the picture."""

from collections.abc import Sequence
from html import escape

from semfov.paths import ZoomPath

WIDTH = 480
"""Width of the drawing in pixels of the screen."""

_MOST = 500
"""Largest number of objects that are drawn; the most confident ones are."""


def path_html(path: ZoomPath) -> str:
    """Draw windows, numbered in their order, and objects as HTML, under a line of text.

    Args:
        path: the search or exploration.

    Returns:
        An HTML element.
    """
    windows = [path.region(number) for number in range(path.passes)]
    width, height = path.lattice.size
    unit = max(width, height) / WIDTH
    shapes = [f'<rect width="{width}" height="{height}" fill="#eee"/>']
    for number, window in enumerate(windows[1:], 1):
        shapes.append(_rect(window, "#0072b2", unit))
        at = f'x="{window[0] + 3 * unit:.0f}" y="{window[1] + 11 * unit:.0f}"'
        shapes.append(f'<text {at} font-size="{10 * unit:.0f}" fill="#0072b2">{number}</text>')
    sure = path.objects
    for box, label, score in zip(sure.boxes.tolist()[:_MOST], sure.labels.tolist(), sure.scores.tolist(), strict=False):
        shapes.append(_rect(box, "#d55e00", unit, f"<title>{escape(path.classes[label])} {score:.2f}</title>"))
    drawing = f'<svg viewBox="0 0 {width} {height}" style="width:{WIDTH}px;max-width:100%">{"".join(shapes)}</svg>'
    return f"<div>{escape(path.summary())}<br>{drawing}</div>"


def _rect(box: Sequence[float], colour: str, unit: float, inside: str = "") -> str:
    x1, y1, x2, y2 = box
    side = f'x="{x1:.1f}" y="{y1:.1f}" width="{x2 - x1:.1f}" height="{y2 - y1:.1f}"'
    return f'<rect {side} fill="none" stroke="{colour}" stroke-width="{unit:.1f}" pointer-events="all">{inside}</rect>'
