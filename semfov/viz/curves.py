"""Curves: over gaze shifts, and of how often predictions are right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.classes import amount
from semfov.errors import check
from semfov.metrics.calibration import reliability
from semfov.viz.style import COLOURS, LineStyle, line_style, make_figure, only, styled

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
    _draw_grey_curves(axes, [curve for name, curve in curves.items() if name not in named])
    for order, name in enumerate(named):
        error = None if errors is None else errors.get(name)
        _draw_curve(axes, name, curves[name], error, line_style(order, len(named)))
    longest = max(len(curve) for curve in curves.values())
    axes.set_xlim(0, longest - 1)
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


def _draw_grey_curves(axes: Axes, curves: Sequence[NDArray[np.float64]]) -> None:
    """Draw the curves that the legend does not name, with one entry that counts them."""
    text: str | None = amount(len(curves), "other")
    for curve in curves:
        shifts = np.arange(len(curve))
        axes.plot(shifts, 100 * curve, color=_REST, linewidth=0.8, label=text, zorder=1)
        text = None  # the entry of the first stands for all


def _draw_curve(
    axes: Axes,
    name: str,
    curve: NDArray[np.float64],
    error: NDArray[np.float64] | None,
    style: LineStyle,
) -> None:
    """Draw a curve of shares with its band of one standard error, where all errors are known."""
    shifts = np.arange(len(curve))
    axes.plot(shifts, 100 * curve, label=name, linewidth=1.6, **style)
    if error is not None and np.isfinite(error).all():
        low = 100 * (curve - error)
        high = 100 * (curve + error)
        axes.fill_between(shifts, low, high, color=style["color"], alpha=0.15, lw=0)


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
    borders = np.linspace(0, 1, bins + 1)
    for order, (name, (probabilities, labels)) in enumerate(predictions.items()):
        confidence, predicted = probabilities.detach().cpu().max(-1)  # (M,) each
        is_right = predicted == labels.cpu()
        count, confidence_sum, right = reliability(confidence, is_right, bins).numpy()
        enough = count >= _LEAST_IN_BIN
        mean_confidence = confidence_sum[enough] / count[enough]
        accuracy = right[enough] / count[enough]
        style = line_style(order, len(predictions))
        above.plot(mean_confidence, accuracy, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), borders, linewidth=1.4, **style)
    above.set(xlim=(0, 1), ylim=(0, 1), ylabel="fraction correct")
    above.legend(loc="upper left")
    above.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="fraction")
    return figure
