"""Reliability diagrams."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

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
        right = (predicted == labels.cpu()).numpy()
        index = np.clip(np.ceil(confidence.numpy() * bins).astype(int) - 1, 0, bins - 1)
        count = np.bincount(index, minlength=bins)
        filled = count >= 20
        mean_confidence = np.bincount(index, confidence.numpy(), bins)[filled] / count[filled]
        accuracy = np.bincount(index, right, bins)[filled] / count[filled]
        style = line_style(order, len(predictions))
        axes.plot(mean_confidence, accuracy, marker="o", markersize=4, label=name, **style)
        below.stairs(count / count.sum(), np.linspace(0, 1, bins + 1), linewidth=1.4, **style)
    axes.set(xlim=(0, 1), ylim=(0, 1), ylabel="share that is right")
    axes.legend(loc="upper left")
    axes.grid(alpha=0.3, linewidth=0.5)
    below.set(xlim=(0, 1), xlabel="probability of the most probable class", ylabel="share")
    return figure
