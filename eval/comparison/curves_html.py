"""Curves over gaze shifts as an SVG, in the colours of the page of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from semfov.viz.curves import highlighted

_Array = NDArray[np.float64]

_WIDTH = 640
_HEIGHT = 380
_LEFT = 62
_RIGHT = _WIDTH - 20
_TOP = 16
_BOTTOM = _HEIGHT - 66
"""The size of the drawing, and the edges of the plot in it."""
_COLOURS = 7
_DASHES = ("", "9 5", "3 4", "12 4 3 4")


class _Axes:
    """The axes of curves, from 0 to `last` gaze shifts and from 0 to a share of `top`."""

    def __init__(self, curves: Mapping[str, _Array]) -> None:
        self.last = max(len(curve) for curve in curves.values()) - 1
        highest = max(float(np.nanmax(curve)) for curve in curves.values())
        # The scale ends at a full tenth.
        self.top = min(1.0, max(0.1, float(np.ceil(highest * 10) / 10)))

    def x(self, shift: float) -> float:
        return _LEFT + shift / max(self.last, 1) * (_RIGHT - _LEFT)

    def points(self, curve: _Array) -> list[str]:
        """Write the points of a curve, as SVG has them."""
        shares = np.clip(curve, 0, self.top) / self.top
        heights = _BOTTOM - shares * (_BOTTOM - _TOP)
        return [f"{self.x(shift):.1f},{height:.1f}" for shift, height in enumerate(heights)]

    def shapes(self) -> list[str]:
        """Draw the axes with their numbers."""
        shapes = []
        for step in range(6):
            y = _BOTTOM - step / 5 * (_BOTTOM - _TOP)
            share = 100 * self.top * step / 5
            shapes.append(f'<line class="tick" x1="{_LEFT}" x2="{_RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
            shapes.append(f'<text x="{_LEFT - 10}" y="{y + 5:.1f}" text-anchor="end">{share:.0f}</text>')
        # At most eleven numbers stand below the axis.
        interval = next(step for step in (1, 2, 5, 10, 20, 50, 100, 10**6) if self.last / step <= 10)
        for shift in range(0, self.last + 1, interval):
            # On a phone, where letters are larger, only every second number is shown.
            minor = ' class="minor"' if (shift // interval) % 2 else ""
            place = f'x="{self.x(shift):.1f}" y="{_BOTTOM + 27}"'
            shapes.append(f'<text{minor} {place} text-anchor="middle">{shift}</text>')
        middle = (_LEFT + _RIGHT) / 2
        shapes.append(f'<line class="axis" x1="{_LEFT}" x2="{_RIGHT}" y1="{_BOTTOM}" y2="{_BOTTOM}"/>')
        shapes.append(f'<text x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">gaze shifts</text>')
        return shapes


def curves_html(curves: Mapping[str, _Array], errors: Mapping[str, _Array], label: str) -> str:
    """Draw curves over gaze shifts as an SVG, in percent, with bands of one standard error and a legend.

    Of more than seven curves the legend names some, as in `semfov.viz`; the others are grey.

    Args:
        curves: the share after each number of gaze shifts, by name.
        errors: their standard errors, for some of them.
        label: what the curves show.

    Returns:
        HTML.
    """
    axes = _Axes(curves)
    named = highlighted(curves)
    lines = {name: _line(order, len(named)) for order, name in enumerate(named)}
    shapes = axes.shapes()
    # Grey lines lie below bands, and bands below the lines that the legend names.
    unnamed = [curve for name, curve in curves.items() if name not in named]
    for curve in unnamed:
        shapes.append(_polyline('class="rest"', axes.points(curve)))
    for order, name in enumerate(named):
        error = errors.get(name)
        if error is not None and np.isfinite(error).all():
            upper = axes.points(curves[name] + error)
            lower = axes.points(curves[name] - error)
            outline = " ".join([*upper, *reversed(lower)])
            shapes.append(f'<polygon class="c{order % _COLOURS}" points="{outline}"/>')
    for name, line in lines.items():
        shapes.append(_polyline(line, axes.points(curves[name])))
    if unnamed:
        lines[f"{len(unnamed)} other{'s' if len(unnamed) != 1 else ''}"] = 'class="rest"'
    title = escape(f"{label} after 0 to {axes.last} gaze shifts; the table below has the numbers")
    return (
        f'<div class="curves"><p>{escape(label)}</p>'
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" aria-label="{title}">{"".join(shapes)}</svg>'
        f'<ul class="legend">{_legend(lines)}</ul></div>'
    )


def _polyline(line: str, points: Sequence[str]) -> str:
    """Draw a line with these attributes."""
    return f'<polyline {line} points="{" ".join(points)}"/>'


def _legend(lines: Mapping[str, str]) -> str:
    """List the names of lines, each with a sample, by the attributes of their lines."""
    entries = []
    for name, line in lines.items():
        sample = _polyline(line, ["0,6", "38,6"])
        entries.append(f'<li><svg viewBox="0 0 38 12" aria-hidden="true">{sample}</svg> {escape(name)}</li>')
    return "".join(entries)


def _line(order: int, count: int) -> str:
    """Write class and dashes of a line; all lines differ, as in `semfov.viz`."""
    # Up to seven lines differ in colour, and two of them in each kind of dashes; of more, seven.
    alike = _COLOURS if count > _COLOURS else 2
    dashes = _DASHES[order // alike % len(_DASHES)]
    colour = f'class="c{order % _COLOURS}"'
    return f'{colour} stroke-dasharray="{dashes}"' if dashes else colour
