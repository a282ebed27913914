"""Reliability diagrams."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from semfov.metrics.calibration import reliability
from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def plot_reliability(predictions: Mapping[str, tuple[Tensor, Tensor]], *, bins: int = 15) -> Figure:
    """How often the most probable class is right, against its probability; a calibrated model lies on the diagonal.

    Bins with fewer than 20 predictions are left out: their shares are mostly chance.

    Args:
        predictions: for each model its probabilities `(M, K+1)` and the true classes `(M,)`.
        bins: equally wide bins of probability.
    """
    figure, (axes, below) = make_figure(2, 1, width=4.4, height=5.4, ratios=[3, 1])
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="perfectly calibrated")
    for order, (name, (probabilities, labels)) in enumerate(predictions.items()):
        confidence, predicted = probabilities.detach().cpu().max(-1)
        count, confident, right = reliability(confidence, predicted == labels.cpu(), bins).numpy()
        filled = count >= 20
        style = line_style(order, len(predictions))
        at, share = confident[filled] / count[filled], right[filled] / count[filled]
        axes.plot(at, share, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), np.linspace(0, 1, bins + 1), linewidth=1.4, **style)
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="share that is right")
    axes.legend(loc="upper left")
    axes.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="share")
    return figure


@styled
def plot_cell_reliability(
    panels: Mapping[str, Mapping[str, Tensor]], errors: Mapping[str, Mapping[str, float]], *, groups: str
) -> Figure:
    """How often what is told of cells is so, against its probability; a calibrated belief lies on the diagonal.

    Axes are in log odds, for most cells hold nothing. Bins with fewer than 20 predictions are left out, and so are
    those of which all or none came true: they have no place on such axes. The last panel has the expected calibration
    error by groups of cells.

    Args:
        panels: by title, for each belief `(3, bins)`: count, sum of probabilities, and number that came true
            (`semfov.metrics.calibration.reliability`).
        errors: for each belief, expected calibration errors by group of cells.
        groups: what the groups are.
    """
    figure, every = make_figure(2, -(-(len(panels) + 1) // 2), width=8.4, height=7.2)
    styles = {name: line_style(order, len(errors)) for order, name in enumerate(errors)}
    for axes, (title, beliefs) in zip(every, panels.items(), strict=False):
        axes.plot([1e-4, 1 - 1e-4], [1e-4, 1 - 1e-4], color="0.6", linewidth=1)
        for name, bins in beliefs.items():
            count, probability, right = bins.cpu().numpy()
            shown = (count >= 20) & (right > 0) & (right < count)
            at, share = probability[shown] / count[shown], right[shown] / count[shown]
            axes.plot(at, share, marker="o", markersize=3, label=name, **styles[name])
        for set_scale, set_ticks in ((axes.set_xscale, axes.set_xticks), (axes.set_yscale, axes.set_yticks)):
            set_scale("logit")
            set_ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
            set_ticks([], minor=True)
        axes.set(xlim=(3e-4, 0.997), ylim=(3e-4, 0.997), title=title)
        axes.set(xlabel="probability of the target in a cell", ylabel="share of the cells that hold it")
        axes.grid(alpha=0.3, linewidth=0.5)
    last = every[len(panels)]
    for name, error in errors.items():
        last.plot(list(error), list(error.values()), marker="o", markersize=3, **styles[name])
    last.set(yscale="log", xlabel=groups, ylabel="expected calibration error")
    last.grid(alpha=0.3, linewidth=0.5)
    for axes in every[len(panels) + 1 :]:
        axes.remove()
    lines, names = every[0].get_legend_handles_labels()
    figure.legend(lines, names, loc="outside lower center", ncols=len(names))
    return figure


_TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99)
