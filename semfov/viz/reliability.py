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
    """How often the most probable class is right, against its probability; a calibrated model lies on the diagonal.

    Bins with fewer than 20 predictions are left out: their shares are mostly chance.

    Args:
        predictions: for each model its probabilities `(M, K+1)` and the true classes `(M,)`.
        bins: equally wide bins of probability.
        axes: two of them to draw in, the second for how many predictions there are; None makes a figure.
    """
    figure, (above, below) = make_figure(2, 1, width=4.4, height=5.4, ratios=[3, 1], given=axes)
    above.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="perfectly calibrated")
    for order, (name, (probabilities, labels)) in enumerate(predictions.items()):
        confidence, predicted = probabilities.detach().cpu().max(-1)
        count, confident, right = reliability(confidence, predicted == labels.cpu(), bins).numpy()
        filled = count >= 20
        style = line_style(order, len(predictions))
        at, share = confident[filled] / count[filled], right[filled] / count[filled]
        above.plot(at, share, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), np.linspace(0, 1, bins + 1), linewidth=1.4, **style)
    above.set(xlim=(0, 1), ylim=(0, 1), ylabel="share that is right")
    above.legend(loc="upper left")
    above.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="share")
    return figure


@styled
def plot_cell_reliability(
    panels: Mapping[str, Mapping[str, Tensor]],
    errors: Mapping[str, Mapping[str, float]],
    *,
    groups: str,
    axes: Sequence[Axes] | None = None,
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
        axes: to draw in, one for each panel and one for the errors; None makes a figure.
    """
    shape = (2, -(-(len(panels) + 1) // 2)) if axes is None else (1, len(panels) + 1)
    figure, every = make_figure(*shape, width=8.4, height=7.2, given=axes)
    styles = {name: line_style(order, len(errors)) for order, name in enumerate(errors)}
    for panel, (title, beliefs) in zip(every, panels.items(), strict=False):
        panel.plot([1e-4, 1 - 1e-4], [1e-4, 1 - 1e-4], color="0.6", linewidth=1)
        for name, bins in beliefs.items():
            count, probability, right = bins.cpu().numpy()
            shown = (count >= 20) & (right > 0) & (right < count)
            at, share = probability[shown] / count[shown], right[shown] / count[shown]
            panel.plot(at, share, marker="o", markersize=3, label=name, **styles[name])
        for set_scale, set_ticks in ((panel.set_xscale, panel.set_xticks), (panel.set_yscale, panel.set_yticks)):
            set_scale("logit")
            set_ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
            set_ticks([], minor=True)
        panel.set(xlim=(3e-4, 0.997), ylim=(3e-4, 0.997), title=title)
        panel.set(xlabel="probability of the target in a cell", ylabel="share of the cells that hold it")
        panel.grid(alpha=0.3, linewidth=0.5)
    last = every[len(panels)]
    for name, error in errors.items():
        last.plot(list(error), list(error.values()), marker="o", markersize=3, **styles[name])
    last.set(yscale="log", xlabel=groups, ylabel="expected calibration error")
    last.grid(alpha=0.3, linewidth=0.5)
    for panel in every[len(panels) + 1 :]:
        panel.remove()
    legend_of(figure, every[0], columns=len(errors), given=axes is not None)
    return figure


_TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99)
