"""Curves of merit over gaze shifts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check
from semfov.viz.style import COLOURS, line_style, make_figure, styled

if TYPE_CHECKING:
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


def _plot_curves(curves: Curves, errors: Curves | None, title: str, label: str) -> Figure:
    from matplotlib.ticker import MaxNLocator

    check(len(curves) > 0, "curves", "at least one", 0)
    many = len(curves) > len(COLOURS)
    figure, (axes,) = make_figure(1, 1, width=8.0 if many else 6.2, height=4.0)
    for order, (name, curve) in enumerate(curves.items()):
        style = line_style(order, len(curves))
        shifts = np.arange(len(curve))
        axes.plot(shifts, 100 * curve, label=name, linewidth=1.6, **style)
        band = None if errors is None else errors.get(name)
        if band is not None and np.isfinite(band).all():
            low, high = 100 * (curve - band), 100 * (curve + band)
            axes.fill_between(shifts, low, high, color=style["color"], alpha=0.05 if many else 0.15, lw=0)
    axes.set_xlim(0, max(len(curve) for curve in curves.values()) - 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set(xlabel="gaze shifts", ylabel=label, title=title)
    if many:
        figure.legend(loc="outside right upper")
    else:
        axes.legend(loc="lower right", framealpha=0.9)
    return figure
