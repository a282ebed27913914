"""Reliability diagrams."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from semfov.metrics.calibration import reliability
from semfov.viz.curves import legend_of
from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
        filled = count >= 20
        style = line_style(order, len(predictions))
        at, share = confident[filled] / count[filled], right[filled] / count[filled]
        above.plot(at, share, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), np.linspace(0, 1, bins + 1), linewidth=1.4, **style)
    above.set(xlim=(0, 1), ylim=(0, 1), ylabel="fraction correct")
    above.legend(loc="upper left")
    above.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="fraction")
    return figure


@styled
def plot_cell_reliability(
    panels: Mapping[str, Mapping[str, Tensor]],
    errors: Mapping[str, Mapping[str, float]],
    *,
    groups: str,
    axes: Sequence[Axes] | None = None,
) -> Figure:
    """Plot how often cells hold the target against the predicted probability; a calibrated belief lies on the diagonal.

    Axes are in log odds, because most cells hold nothing. Bins with fewer than 20 predictions are left out. So are bins
    in which all or none of the predictions came true, because they have no position on such axes. The last panel shows
    the expected calibration error by group of cells.

    Args:
        panels: for each title and each belief `(3, bins)`: number of predictions, sum of probabilities, and number that
            came true (`semfov.metrics.calibration.reliability`).
        errors: for each belief, expected calibration errors by group of cells.
        groups: label of the groups.
        axes: axes to draw in, one for each panel and one for the errors; None makes a figure.

    Returns:
        The figure.

    >>> import torch
    >>> bins = torch.tensor([[100.0, 100.0], [20.0, 60.0], [18.0, 63.0]])
    >>> panels, errors = {"all cells": {"learned": bins}}, {"learned": {"seen": 0.02, "unseen": 0.03}}
    >>> figure = plot_cell_reliability(panels, errors, groups="cells")
    """
    shape = (2, -(-(len(panels) + 1) // 2)) if axes is None else (1, len(panels) + 1)
    figure, every = make_figure(*shape, width=8.4, height=7.2, axes=axes)
    styles = {name: line_style(order, len(errors)) for order, name in enumerate(errors)}
    for panel, (title, beliefs) in zip(every, panels.items(), strict=False):
        panel.plot([1e-4, 1 - 1e-4], [1e-4, 1 - 1e-4], color="0.6", linewidth=1)
        for name, bins in beliefs.items():
            count, probability, right = bins.cpu().numpy()
            filled = (count >= 20) & (right > 0) & (right < count)
            at, share = probability[filled] / count[filled], right[filled] / count[filled]
            panel.plot(at, share, marker="o", markersize=3, label=name, **styles[name])
        for set_scale, set_ticks in ((panel.set_xscale, panel.set_xticks), (panel.set_yscale, panel.set_yticks)):
            set_scale("logit")
            set_ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
            set_ticks([], minor=True)
        panel.set(xlim=(3e-4, 0.997), ylim=(3e-4, 0.997), title=title)
        panel.set(xlabel="probability of the target in a cell", ylabel="fraction of cells that hold it")
        panel.grid(alpha=0.3, linewidth=0.5)
    last = every[len(panels)]
    for name, error in errors.items():
        last.plot(list(error), list(error.values()), marker="o", markersize=3, **styles[name])
    last.set(yscale="log", xlabel=groups, ylabel="expected calibration error")
    last.grid(alpha=0.3, linewidth=0.5)
    for panel in every[len(panels) + 1 :]:
        panel.remove()
    legend_of(figure, every[0], columns=len(errors), inside=axes is not None)
    return figure


_TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99)
