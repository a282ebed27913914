"""The reliability diagram of cells, in log odds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99)


@styled
def plot_cell_reliability(
    panels: Mapping[str, Mapping[str, Tensor]],
    errors: Mapping[str, Mapping[str, float]],
    *,
    groups: str,
) -> Figure:
    """How often cells hold the target against the predicted probability; a calibrated belief lies on the diagonal.

    Axes are in log odds, because most cells hold nothing. Bins with fewer than 20 predictions are left out. So are bins
    in which all or none of the predictions came true, because they have no position on such axes. The last panel shows
    the expected calibration error by group of cells.

    Shapes: panels of each title and belief `(3, bins)`, the sums of `semfov.metrics.calibration.reliability`.
    """
    figure, every = make_figure(2, -(-(len(panels) + 1) // 2), width=8.4, height=7.2)
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
    figure.legend(*every[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(errors))
    return figure
