"""Figures hold what they should: curves, fixations, one scale for an episode."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from semfov import Detections, Grid, InputError, Scanpath
from semfov.viz import (
    plot_belief,
    plot_cumulative_performance,
    plot_episode,
    plot_reliability,
    plot_scanpath,
    plot_success_rate,
)


@pytest.fixture
def scanpath():
    grid = Grid(4, 3, (80, 60))
    cells = torch.tensor([0, 6, 11])
    torch.manual_seed(0)
    seen = Detections(
        torch.tensor([[[10.0, 10, 30, 30], [50, 40, 70, 55]]]),
        torch.tensor([[[0.1, 0.8, 0.1], [0.3, 0.1, 0.6]]]),
        torch.ones(1, 2, dtype=torch.bool),
    )
    return Scanpath(
        grid=grid,
        classes=("background", "cat", "cup"),
        target=2,
        cells=cells,
        fixations=grid.centres[cells],
        detections=(seen,) * 3,
        beliefs=torch.rand(3, 12, 3) + 0.1,
        values=torch.rand(3, 12),
        found=True,
    )


@pytest.fixture
def image():
    return torch.rand(3, 60, 80)


def draw(figure):
    """Render it; a figure that cannot be laid out warns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.canvas.draw()
    return figure


def test_curves_and_bands():
    curves = {"random": np.linspace(0, 0.8, 31), "predictive": np.linspace(0, 0.9, 31)}
    figure = draw(plot_cumulative_performance(curves, {"random": np.full(31, 0.02)}))
    axes = figure.axes[0]
    assert [line.get_label() for line in axes.lines] == list(curves)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 100 * curves["predictive"])
    assert len(axes.collections) == 1


def test_many_curves_can_be_told_apart():
    curves = {f"policy {number}": np.linspace(0, number / 20, 21) for number in range(16)}
    figure = draw(plot_success_rate(curves, title="exploration"))
    lines = figure.axes[0].lines
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 16
    assert [text.get_text() for text in figure.legends[0].get_texts()] == list(curves)


def test_scanpath_shows_numbered_fixations(scanpath, image):
    figure = draw(plot_scanpath(scanpath, image, boxes=torch.tensor([[60.0, 45, 79, 59]])))
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["0", "1", "2"]
    np.testing.assert_allclose(axes.lines[-4].get_xydata(), scanpath.fixations + 0.5)
    assert axes.get_title() == "“cup” found after 2 gaze shifts"
    explored = draw(plot_scanpath(replace(scanpath, target=None, found=False), image))
    assert explored.axes[0].get_title() == "explored with 2 gaze shifts"


def test_belief_is_the_posterior(scanpath):
    figure = draw(plot_belief(scanpath, 1))
    shown = np.asarray(figure.axes[0].images[0].get_array())
    belief = scanpath.beliefs[1]
    np.testing.assert_allclose(shown, (belief[:, 2] / belief.sum(1)).reshape(3, 4), rtol=1e-6)


def test_episode_has_one_scale_and_at_most_so_many_panels(scanpath, image):
    figure = draw(plot_episode(scanpath, image, [image] * 3, most=2))
    assert len(figure.axes) == 1 + 2 * 2
    maps = [axes.images[-1] for axes in figure.axes if axes.get_title().startswith("p(cup)")]
    assert len({image.get_clim() for image in maps}) == 1
    with pytest.raises(InputError, match="views"):
        plot_episode(scanpath, image, [image])


def test_reliability_of_a_calibrated_model_lies_on_the_diagonal():
    torch.manual_seed(0)
    p = torch.rand(50_000, 1)
    probabilities = torch.cat([p, 1 - p], 1)
    labels = (torch.rand(50_000) > p[:, 0]).long()
    axes = draw(plot_reliability({"perfect": (probabilities, labels)})).axes[0]
    x, y = axes.lines[1].get_data()
    np.testing.assert_allclose(x, y, atol=0.03)


def test_scanpath_without_target_needs_one(scanpath):
    fields = {name: getattr(scanpath, name) for name in scanpath.__dataclass_fields__}
    with pytest.raises(InputError, match="target"):
        plot_belief(Scanpath(**{**fields, "target": None}))
