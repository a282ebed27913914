"""Figures of scanpaths: numbers are readable, and colours show the time."""

from itertools import combinations

import numpy as np
import pytest
import torch

from semfov import Grid, InputError
from semfov.data.fixations import Fixations
from semfov.viz import plot_scanpath
from semfov.viz.style import TIME
from tests import small


def path_of(cells, columns, rows):
    return small.scanpath(Grid(columns, rows, (640, 480)), cells, ("background", "cup"), target=1)


def drawn(scanpath):
    figure = plot_scanpath(scanpath, torch.rand(3, 48, 64))
    figure.draw_without_rendering()
    return figure.axes[0]


def crowded(columns, rows, near):
    """Cells of 31 fixations, anywhere in the image or close together."""
    generator = torch.Generator().manual_seed(columns)
    if near:
        return (torch.arange(31) % 6 + 3) + columns * (torch.arange(31) // 6 + 3)
    return torch.randperm(columns * rows, generator=generator)[:31]


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize(("columns", "rows"), [(10, 10), (20, 20), (40, 30)])
def test_numbers_of_thirty_gaze_shifts_do_not_overlap(columns, rows, near):
    scanpath = path_of(crowded(columns, rows, near), columns, rows)
    axes = drawn(scanpath)
    numbers = [int(text.get_text()) for text in axes.texts]
    assert sorted(numbers) == list(range(31))
    boxes = [text.get_bbox_patch().get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    # No number covers another fixation.
    where = axes.transData.transform((scanpath.fixations + 0.5).numpy())
    for number, box in zip(numbers, boxes, strict=True):
        inside = [n for n, (x, y) in enumerate(where) if box.x0 < x < box.x1 and box.y0 < y < box.y1]
        assert inside in ([], [number])
        assert np.hypot(*(np.array([box.x0 + box.width / 2, box.y0 + box.height / 2]) - where[number])) < 140
    if (columns, rows) == (10, 10) and not near:
        np.testing.assert_allclose([text.xyann for text in axes.texts], scanpath.fixations + 0.5, atol=1e-3)


def test_colours_show_the_time_of_fixations():
    from matplotlib import colormaps

    axes = drawn(path_of(torch.arange(0, 90, 9), 10, 10))
    expected = colormaps[TIME](np.linspace(0, 1, 10))
    np.testing.assert_allclose(axes.collections[-1].get_facecolor(), expected)
    np.testing.assert_allclose([text.get_bbox_patch().get_facecolor() for text in axes.texts], expected)
    thin = axes.collections[-2]
    assert thin.get_linewidths() == [0.8]
    np.testing.assert_allclose(thin.get_colors(), expected[1:])
    np.testing.assert_allclose(thin.get_segments(), np.stack([axes.collections[-1].get_offsets()[:-1],
                                                              axes.collections[-1].get_offsets()[1:]], 1))  # fmt: skip


def test_fixations_of_people_are_drawn_as_those_of_an_agent():
    points = np.array([[10.0, 20.0], [300.0, 40.0], [200.5, 400.25]])
    person = Fixations("a.jpg", "7", points, (640, 480), target="cup", box=(180.0, 380.0, 230.0, 430.0), found=True)
    axes = plot_scanpath(person, torch.rand(3, 48, 64)).axes[0]
    np.testing.assert_allclose(axes.collections[-1].get_offsets(), points + 0.5)
    assert axes.get_title() == "a.jpg, 7: “cup”, found"
    assert [patch.get_bbox().bounds for patch in axes.patches] == [(180.0, 380.0, 50.0, 50.0)]
    with pytest.raises(InputError, match=r"^image: expected the photograph"):
        plot_scanpath(person)
