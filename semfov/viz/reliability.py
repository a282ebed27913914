"""The reliability diagram."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from semfov.metrics.calibration import reliability
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
