"""Curves over gaze shifts as an SVG, in the colours of the page of a run."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

import numpy as np
from numpy.typing import NDArray

from semfov.viz.curves import highlighted

_Array = NDArray[np.float64]

_WIDTH, _HEIGHT = 640, 380
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 20, 16, 66
_COLOURS = 7
_DASHES = ("", "9 5", "3 4", "12 4 3 4")


def curves_html(curves: Mapping[str, _Array], errors: Mapping[str, _Array], label: str) -> str:
    """Curves over gaze shifts as an SVG, in percent, with bands of one standard error and a legend.

    Of more than seven curves the legend names some, as in `semfov.viz`; the others are grey.
    """
    last = max(len(curve) for curve in curves.values()) - 1
    highest = max(float(np.nanmax(curve)) for curve in curves.values())
    top = min(1.0, max(0.1, float(np.ceil(highest * 10) / 10)))

    def point(shift: float, share: float) -> str:
        x = _LEFT + shift / max(last, 1) * (_WIDTH - _LEFT - _RIGHT)
        y = _HEIGHT - _BOTTOM - np.clip(share, 0, top) / top * (_HEIGHT - _TOP - _BOTTOM)
        return f"{x:.1f},{y:.1f}"

    named = highlighted(curves)
    shapes = [_axes(last, top)]
    rest = [curve for name, curve in curves.items() if name not in named]
    for curve in rest:
        points = " ".join(point(*p) for p in enumerate(curve))
        shapes.append(f'<polyline class="rest" points="{points}"/>')
    for order, name in enumerate(named):
        curve, band = curves[name], errors.get(name)
        if band is not None and np.isfinite(band).all():
            around = [*enumerate(curve + band), *reversed(list(enumerate(curve - band)))]
            shapes.append(f'<polygon class="c{order % _COLOURS}" points="{" ".join(point(*p) for p in around)}"/>')
    for order, name in enumerate(named):
        points = " ".join(point(*p) for p in enumerate(curves[name]))
        shapes.append(f'<polyline {_line(order, len(named))} points="{points}"/>')
    samples = [f'<polyline {_line(order, len(named))} points="0,6 38,6"/>' for order in range(len(named))]
    if rest:
        named = [*named, f"{len(rest)} other{'s' if len(rest) != 1 else ''}"]
        samples.append('<polyline class="rest" points="0,6 38,6"/>')
    legend = "".join(
        f'<li><svg viewBox="0 0 38 12" aria-hidden="true">{sample}</svg> {escape(name)}</li>'
        for name, sample in zip(named, samples, strict=True)
    )
    title = escape(f"{label} after 0 to {last} gaze shifts; the table below has the numbers")
    return (
        f'<div class="curves"><p>{escape(label)}</p>'
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">{"".join(shapes)}</svg>'
        f'<ul class="legend">{legend}</ul></div>'
    )


def _line(order: int, count: int) -> str:
    """Class and dashes of a line; all lines differ, as in `semfov.viz`."""
    group = _COLOURS if count > _COLOURS else 2
    dashes = _DASHES[order // group % len(_DASHES)]
    return f'class="c{order % _COLOURS}"' + (f' stroke-dasharray="{dashes}"' if dashes else "")


def _axes(last: int, top: float) -> str:
    left, right, bottom = _LEFT, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    shapes = []
    for step in range(6):
        y = bottom - step / 5 * (bottom - _TOP)
        shapes.append(f'<line class="tick" x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        shapes.append(f'<text x="{left - 10}" y="{y + 5:.1f}" text-anchor="end">{100 * top * step / 5:.0f}</text>')
    every = next(step for step in (1, 2, 5, 10, 20, 50, 100, 10**6) if last / step <= 10)
    for shift in range(0, last + 1, every):
        x = left + shift / max(last, 1) * (right - left)
        # On a phone, where letters are larger, only every second number is shown.
        minor = ' class="minor"' if (shift // every) % 2 else ""
        shapes.append(f'<text{minor} x="{x:.1f}" y="{bottom + 27}" text-anchor="middle">{shift}</text>')
    shapes.append(f'<line class="axis" x1="{left}" x2="{right}" y1="{bottom}" y2="{bottom}"/>')
    shapes.append(f'<text x="{(left + right) / 2}" y="{_HEIGHT - 8}" text-anchor="middle">gaze shifts</text>')
    return "".join(shapes)
