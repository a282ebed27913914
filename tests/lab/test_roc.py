"""The figure of hit rates against false-alarm rates."""

import numpy as np
import torch

from eval.decide.roc import plot_roc
from semfov.metrics.presence import area_under_roc, roc


def test_curves_and_areas_equal_those_of_the_scores():
    generator = torch.Generator().manual_seed(0)
    present = torch.rand(40, generator=generator) < 0.5
    scores = {"one": torch.rand(40, generator=generator) + present, "other": torch.rand(40, generator=generator)}
    figure = plot_roc(scores, present)
    whole, near = figure.axes
    assert (whole.get_xlim(), near.get_xlim()) == ((0, 1), (0, 0.1))
    for axes in (whole, near):
        for line, score in zip(axes.lines, scores.values(), strict=True):
            np.testing.assert_allclose(line.get_xydata().T, roc(score, present))
    labels = [text.get_text() for text in whole.get_legend().get_texts()]
    assert labels == [f"{name} ({area_under_roc(score, present):.3f})" for name, score in scores.items()]
