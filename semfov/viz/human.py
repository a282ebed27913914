"""Curves of people and models side by side."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semfov.errors import check
from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Curves = Mapping[str, NDArray[np.float64]]


@styled
def plot_by_shift(curves: Curves, errors: Curves | None = None, *, label: str, title: str = "") -> Figure:
    """A figure of merit after 1, 2, … gaze shifts, one curve per model, with bands of one standard error.

    Args:
        curves: for each model `(N,)`.
        errors: standard errors of the same shape.
        label: of the vertical axis.
        title: title of the figure.

    >>> figure = plot_by_shift({"people": np.linspace(2, 1, 8)}, label="NSS")
    """
    check(len(curves) > 0, "curves", "at least one", 0)
    figure, (axes,) = make_figure(1, 1, width=8.0, height=4.0)
    for order, (name, curve) in enumerate(curves.items()):
        style = line_style(order, len(curves))
        shifts = np.arange(1, len(curve) + 1)
        axes.plot(shifts, curve, label=name, linewidth=1.6, **style)
        if errors is not None and name in errors:
            axes.fill_between(
                shifts, curve - errors[name], curve + errors[name], color=style["color"], alpha=0.12, lw=0
            )
    axes.set(xlabel="gaze shifts", ylabel=label, title=title)
    axes.grid(alpha=0.3, linewidth=0.5)
    figure.legend(loc="outside right upper")
    return figure
