"""The reliability diagram of cells: calibrated predictions lie on its diagonal."""

import numpy as np
import torch

from eval.calibration.cell_figure import plot_cell_reliability
from semfov.metrics.calibration import BinarySums


def test_reliability_of_cells_lies_on_the_diagonal_in_log_odds():
    torch.manual_seed(0)
    p = torch.rand(200_000, dtype=torch.float64) ** 3
    sums = BinarySums.of(p, torch.rand(len(p)) < p)
    few = BinarySums.of(p[:5], p[:5] > 2)
    panels = {"after 1 look": {"right": sums.bins, "rare": few.bins}, "after 5 looks": {"right": sums.bins}}
    errors = {"right": {"fixated": 0.01, "others": 0.02}, "rare": {"fixated": 0.2, "others": 0.1}}
    first, second, last = plot_cell_reliability(panels, errors, groups="cells").axes
    for axes in (first, second):
        assert (axes.get_xscale(), axes.get_yscale()) == ("logit", "logit")
        x, y = axes.lines[1].get_data()
        assert len(x) > 18
        np.testing.assert_allclose(x, y, atol=0.02)
    assert len(first.lines[2].get_xdata()) == 0
    assert [axes.get_title() for axes in (first, second)] == list(panels)
    assert [list(line.get_ydata()) for line in last.lines] == [list(each.values()) for each in errors.values()]
    assert [line.get_color() for line in last.lines] == [line.get_color() for line in first.lines[1:]]
