"""Curves: over gaze shifts, and of how often predictions are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.errors import check
from semfov.metrics.calibration import reliability
from semfov.viz.style import COLOURS, line_style, make_figure, only, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Curves = Mapping[str, NDArray[np.float64]]

_LEAST_IN_BIN = 20  # predictions of a bin, fewer of which tell little
_REST = "0.6"  # colour of the curves that the legend does not name


@styled
def plot_curves(
    curves: _Curves,
    errors: _Curves | None = None,
    *,
    label: str,
    title: str = "",
    most: float | None = None,
    ax: Axes | None = None,
) -> Figure:
    """Plot a share after each gaze shift, one curve for each policy, with bands of one standard error.

    Of more than seven curves the legend names the highest ones and those of random gaze; the others are grey.

    Args:
        curves: for each policy its share after 0, 1, 2, … gaze shifts, in [0, 1], such as that of the targets found.
        errors: standard errors of the same shape.
        label: what the share is of, in per cent.
        title: title of the figure.
        most: end of the scale, which then begins at 0; None takes that of the curves.
        ax: axes to draw in; None makes a figure.

    Returns:
        The figure.

    Raises:
        InputError: there is no curve.

    >>> figure = plot_curves({"random": np.linspace(0, 0.8, 31)}, label="targets found (%)", most=102)
    """
    from matplotlib.ticker import MaxNLocator

    check(len(curves) > 0, "curves", "at least one curve", 0)
    figure, (axes,) = make_figure(1, 1, width=6.2, height=4.0, axes=only(ax))
    named = highlighted(curves)
    rest = [name for name in curves if name not in named]
    label_of_rest: str | None = f"{len(rest)} other{'s' if len(rest) != 1 else ''}"
    for name in rest:
        shifts = np.arange(len(curves[name]))
        axes.plot(shifts, 100 * curves[name], color=_REST, linewidth=0.8, label=label_of_rest, zorder=1)
        label_of_rest = None  # one entry of the legend stands for all
    for order, name in enumerate(named):
        style = line_style(order, len(named))
        shifts = np.arange(len(curves[name]))
        axes.plot(shifts, 100 * curves[name], label=name, linewidth=1.6, **style)
        error = None if errors is None else errors.get(name)
        if error is not None and np.isfinite(error).all():
            low = 100 * (curves[name] - error)
            high = 100 * (curves[name] + error)
            axes.fill_between(shifts, low, high, color=style["color"], alpha=0.15, lw=0)
    axes.set_xlim(0, max(len(curve) for curve in curves.values()) - 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3, linewidth=0.5)
    axes.set(xlabel="gaze shifts", ylabel=label, title=title)
    lines, names = axes.get_legend_handles_labels()
    if len(curves) > len(COLOURS):
        # The grey curves were drawn first, below the others, but come last in the legend.
        lines = [*lines[1:], lines[0]]
        names = [*names[1:], names[0]]
    axes.legend(lines, names, loc="lower right", framealpha=0.9)
    if most is not None:
        axes.set_ylim(0, most)
    return figure


def highlighted(curves: _Curves) -> list[str]:
    """Choose the curves that a legend names: the highest on average, and random gaze as the reference."""
    order = sorted(curves, key=lambda name: (not name.startswith("random"), -float(np.nanmean(curves[name]))))
    chosen = order[: len(COLOURS)]
    return [name for name in curves if name in chosen]


@styled
def plot_reliability(
    predictions: Mapping[str, tuple[Tensor, Tensor]], *, bins: int = 15, axes: Sequence[Axes] | None = None
) -> Figure:
    """Plot the accuracy of the most probable class against its probability; a calibrated model lies on the diagonal.

    Bins with fewer than 20 predictions are left out, because their fractions are mostly chance.

    Args:
        predictions: for each model its probabilities `(M, K+1)` and the true classes `(M,)`.
        bins: number of equally wide bins of probability.
        axes: two axes to draw in, the second for the distribution of predictions; None makes a figure.

    Returns:
        The figure.

    >>> import torch
    >>> probabilities = torch.rand(200, 3).softmax(-1)
    >>> figure = plot_reliability({"random": (probabilities, torch.randint(3, (200,)))}, bins=5)
    """
    figure, (above, below) = make_figure(2, 1, width=4.4, height=5.4, ratios=[3, 1], axes=axes)
    above.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="perfectly calibrated")
    for order, (name, (probabilities, labels)) in enumerate(predictions.items()):
        confidence, predicted = probabilities.detach().cpu().max(-1)
        count, confident, right = reliability(confidence, predicted == labels.cpu(), bins).numpy()
        filled = count >= _LEAST_IN_BIN
        style = line_style(order, len(predictions))
        mean_confidence = confident[filled] / count[filled]
        accuracy = right[filled] / count[filled]
        above.plot(mean_confidence, accuracy, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), np.linspace(0, 1, bins + 1), linewidth=1.4, **style)
    above.set(xlim=(0, 1), ylim=(0, 1), ylabel="fraction correct")
    above.legend(loc="upper left")
    above.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="fraction")
    return figure
