"""Curves and scanpaths of people and models side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import check
from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Curves = Mapping[str, NDArray[np.float64]]


@styled
def plot_by_shift(curves: _Curves, errors: _Curves | None = None, *, label: str, title: str = "") -> Figure:
    """Plot a measure after 1, 2, … gaze shifts, one curve for each model, with bands of one standard error.

    Args:
        curves: for each model `(N,)`.
        errors: standard errors of the same shape.
        label: of the vertical axis.
        title: title of the figure.

    Returns:
        The figure.

    Raises:
        InputError: there is no curve.

    >>> figure = plot_by_shift({"people": np.linspace(2, 1, 8)}, label="NSS")
    """
    check(len(curves) > 0, "curves", "at least one curve", 0)
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


@styled
def plot_scanpaths_beside(image: Tensor, scanpaths: Mapping[str, Sequence[NDArray[np.float64]]]) -> Figure:
    """Plot scanpaths of several searchers on the same picture, in one panel for each searcher.

    Args:
        image: `(3, H, W)`, RGB in [0, 1].
        scanpaths: for each searcher its scanpaths `(n, 2)`, `(x, y)` in pixels; a larger mark shows the first fixation.

    Returns:
        The figure.

    Raises:
        InputError: there is no searcher.

    >>> import torch
    >>> figure = plot_scanpaths_beside(torch.rand(3, 60, 80), {"people": [np.array([[40.0, 30.0], [10.0, 10.0]])]})
    """
    check(len(scanpaths) > 0, "scanpaths", "at least one searcher", 0)
    height, width = image.shape[-2:]
    figure, panels = make_figure(1, len(scanpaths), width=4.4 * len(scanpaths), height=4.4 * height / width + 0.4)
    for axes, (name, paths) in zip(panels, scanpaths.items(), strict=True):
        axes.imshow(image.permute(1, 2, 0).cpu().numpy())
        for order, path in enumerate(paths):
            colour = line_style(order, len(paths))["color"]
            axes.plot(*path.T, "-o", color=colour, markersize=3.5, linewidth=1.3, markeredgecolor="white")
            axes.plot(*path[0], "o", color=colour, markersize=7, markeredgecolor="white")
        axes.set(title=name, xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.axis("off")
    return figure
