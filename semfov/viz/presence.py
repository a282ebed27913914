"""The receiver operating characteristic of deciding whether a target is present."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from semfov.metrics.presence import area_under_roc, roc
from semfov.viz.style import COLOURS, LINES, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def plot_roc(scores: Mapping[str, Tensor], present: Tensor, *, axes: Sequence[Axes] | None = None) -> Figure:
    """Plot hit rates against false alarm rates: the whole range, and beside it false alarm rates up to 0.1.

    Args:
        scores: for each name `(M,)`, higher where the target is more likely present.
        present: `(M,)` boolean, whether it is; some must be true and some false.
        axes: two axes to draw in; None makes a figure.

    Returns:
        The figure; its legend has the areas under the curves.

    Raises:
        InputError: the target is present in all cases or in none.

    >>> figure = plot_roc({"one look": torch.tensor([0.9, 0.4, 0.1])}, torch.tensor([True, True, False]))
    """
    figure, panels = make_figure(1, 2, width=10, height=4.6, layout="compressed", axes=axes)
    for panel, widest in zip(panels, (1.0, 0.1), strict=True):
        for (name, score), colour, line in zip(
            scores.items(), COLOURS * len(scores), LINES * len(scores), strict=False
        ):
            alarms, hits = roc(score, present)
            label = f"{name} ({area_under_roc(score, present):.3f})"
            panel.plot(
                torch.tensor(alarms), torch.tensor(hits), line, color=colour, label=label, drawstyle="steps-post"
            )
        panel.set(xlim=(0, widest), ylim=(0, 1), xlabel="false alarms", ylabel="hits")
        panel.grid(alpha=0.3)
    panels[0].legend(title="area under the curve", loc="lower right", fontsize=7)
    return figure
