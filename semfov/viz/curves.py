"""Curves of merit over gaze shifts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check
from semfov.viz.style import COLOURS, line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Curves = Mapping[str, NDArray[np.float64]]


@styled
def plot_cumulative_performance(curves: Curves, errors: Curves | None = None, *, title: str = "") -> Figure:
    """Share of targets found after each gaze shift, one curve per policy, with bands of one standard error.

    Args:
        curves: for each policy its cumulative performance after 0, 1, 2, … gaze shifts, in [0, 1].
        errors: standard errors of the same shape.
        title: title of the figure.

    >>> figure = plot_cumulative_performance({"random": np.linspace(0, 0.8, 31)})
    """
    figure = _plot_curves(curves, errors, title, "targets found (%)")
    figure.axes[0].set_ylim(0, 102)
    return figure


@styled
def plot_success_rate(curves: Curves, errors: Curves | None = None, *, title: str = "") -> Figure:
    """Share of the cells with objects whose class is right after each gaze shift.

    Arguments as for `plot_cumulative_performance`.
    """
    return _plot_curves(curves, errors, title, "cells with the right class (%)")


@styled
def plot_curve_panels(panels: Mapping[str, tuple[Curves, Curves]], *, label: str, columns: int = 2) -> Figure:
    """Curves of several experiments with the same policies side by side, with one legend.

    Args:
        panels: by title, curves in [0, 1] and their standard errors, as for `plot_cumulative_performance`.
        label: of the vertical axis.
        columns: panels in a row.

    >>> curves = {"random": np.linspace(0, 0.8, 31)}
    >>> figure = plot_curve_panels({"wide": (curves, {}), "narrow": (curves, {})}, label="targets found (%)")
    """
    check(len(panels) > 0, "panels", "at least one", 0)
    rows = -(-len(panels) // columns)
    figure, every = make_figure(rows, columns, width=4.4 * columns, height=2.9 * rows + 0.5)
    for axes, (title, (curves, errors)) in zip(every, panels.items(), strict=False):
        _draw(axes, curves, errors, band=0.15)
        axes.set(xlabel="gaze shifts", ylabel=label, title=title)
    for axes in every[len(panels) :]:
        axes.remove()
    lines, names = every[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncols=3)
    return figure


def _draw(axes: Axes, curves: Curves, errors: Curves | None, band: float) -> None:
    """Curves with bands of one standard error."""
    from matplotlib.ticker import MaxNLocator

    for order, (name, curve) in enumerate(curves.items()):
        style = line_style(order, len(curves))
        shifts = np.arange(len(curve))
        axes.plot(shifts, 100 * curve, label=name, linewidth=1.6, **style)
        error = None if errors is None else errors.get(name)
        if error is not None and np.isfinite(error).all():
            low, high = 100 * (curve - error), 100 * (curve + error)
            axes.fill_between(shifts, low, high, color=style["color"], alpha=band, lw=0)
    axes.set_xlim(0, max(len(curve) for curve in curves.values()) - 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3, linewidth=0.5)


def _plot_curves(curves: Curves, errors: Curves | None, title: str, label: str) -> Figure:
    check(len(curves) > 0, "curves", "at least one", 0)
    many = len(curves) > len(COLOURS)
    figure, (axes,) = make_figure(1, 1, width=8.0 if many else 6.2, height=4.0)
    _draw(axes, curves, errors, band=0.05 if many else 0.15)
    axes.set(xlabel="gaze shifts", ylabel=label, title=title)
    if many:
        figure.legend(loc="outside right upper")
    else:
        axes.legend(loc="lower right", framealpha=0.9)
    return figure
