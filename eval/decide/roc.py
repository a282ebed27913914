"""The receiver operating characteristic of deciding whether a target is present."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from eval.presence import roc
from semfov.metrics.episodes import area_under_roc
from semfov.viz.style import COLOURS, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def plot_roc(scores: Mapping[str, Tensor], present: Tensor) -> Figure:
    """Hit rates against false alarm rates, the whole range and up to 0.1; scores `(M,)`, present `(M,)` boolean."""
    figure, panels = make_figure(1, 2, width=10, height=4.6, layout="compressed")
    for panel, widest in zip(panels, (1.0, 0.1), strict=True):
        for (name, score), colour, line in zip(
            scores.items(), COLOURS * len(scores), ("-", "--", "-.", ":") * len(scores), strict=False
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
