"""The reliability diagram of cells, in log odds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from torch import Tensor

from semfov.viz.style import line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TICKS = (0.001, 0.01, 0.1, 0.5, 0.9, 0.99)


_FEWEST = 20  # predictions of a bin that is drawn


@styled
def plot_cell_reliability(
    panels: Mapping[str, Mapping[str, Tensor]],
    errors: Mapping[str, Mapping[str, float]],
    *,
    groups: str,
) -> Figure:
    """Plot how often cells hold the target against the predicted probability; calibrated ones lie on the diagonal.

    Axes are in log odds, because most cells hold nothing. Bins with fewer than 20 predictions are left out. So are bins
    in which all or none of the predictions came true, because they have no position on such axes. The last panel shows
    the expected calibration error by group of cells.

    Args:
        panels: for each title and belief the sums `(3, bins)` of `semfov.metrics.calibration.reliability`.
        errors: for each belief the expected calibration error by group of cells.
        groups: what the groups are, for the axis.

    Returns:
        The figure.
    """
    rows = 2
    columns = -(-(len(panels) + 1) // rows)  # with the panel of errors
    figure, all_axes = make_figure(rows, columns, width=8.4, height=7.2)
    styles = {name: line_style(order, len(errors)) for order, name in enumerate(errors)}
    *of_panels, of_errors = all_axes[: len(panels) + 1]
    for axes, (title, beliefs) in zip(of_panels, panels.items(), strict=True):
        _draw_panel(axes, title, beliefs, styles)
    for name, error in errors.items():
        of_errors.plot(list(error), list(error.values()), marker="o", markersize=3, **styles[name])
    of_errors.set(yscale="log", xlabel=groups, ylabel="expected calibration error")
    of_errors.grid(alpha=0.3, linewidth=0.5)
    for axes in all_axes[len(panels) + 1 :]:
        axes.remove()
    figure.legend(*all_axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(errors))
    return figure


def _draw_panel(axes: Axes, title: str, beliefs: Mapping[str, Tensor], styles: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw the curves of beliefs, by their sums `(3, bins)`, and the diagonal."""
    axes.plot([1e-4, 1 - 1e-4], [1e-4, 1 - 1e-4], color="0.6", linewidth=1)
    for name, bins in beliefs.items():
        count, probability, right = bins.cpu().numpy()
        drawn = (count >= _FEWEST) & (right > 0) & (right < count)
        mean = probability[drawn] / count[drawn]
        share = right[drawn] / count[drawn]
        axes.plot(mean, share, marker="o", markersize=3, label=name, **styles[name])
    axes.set_xscale("logit")
    axes.set_yscale("logit")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
        axis.set_ticks([], minor=True)
    axes.set(xlim=(3e-4, 0.997), ylim=(3e-4, 0.997), title=title)
    axes.set(xlabel="probability of the target in a cell", ylabel="fraction of cells that hold it")
    axes.grid(alpha=0.3, linewidth=0.5)
