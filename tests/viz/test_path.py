"""Figures of scanpaths: numbers are readable, and colours show the time."""

from itertools import combinations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Detections, Grid, Scanpath
from semfov.viz import plot_scanpath
from semfov.viz.labels import place_numbers, place_within
from semfov.viz.style import TIME


def scanpath_of(cells, columns, rows, size=(640, 480)):
    grid, count = Grid(columns, rows, size), len(cells)
    return Scanpath(
        grid=grid,
        classes=("background", "cup"),
        target=1,
        cells=cells,
        fixations=grid.centres[cells],
        detections=(Detections.empty(1, 1),) * count,
        probabilities=torch.rand(count, len(grid), 2),
        values=torch.rand(count, len(grid)),
        found=False,
    )


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
    scanpath = scanpath_of(crowded(columns, rows, near), columns, rows)
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

    axes = drawn(scanpath_of(torch.arange(0, 90, 9), 10, 10))
    expected = colormaps[TIME](np.linspace(0, 1, 10))
    np.testing.assert_allclose(axes.collections[-1].get_facecolor(), expected)
    np.testing.assert_allclose([text.get_bbox_patch().get_facecolor() for text in axes.texts], expected)
    thin = axes.collections[-2]
    assert thin.get_linewidths() == [0.8]
    np.testing.assert_allclose(thin.get_colors(), expected[1:])
    np.testing.assert_allclose(thin.get_segments(), np.stack([axes.collections[-1].get_offsets()[:-1],
                                                              axes.collections[-1].get_offsets()[1:]], 1))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 400])
def test_numbers_of_few_and_of_very_many_fixations_do_not_overlap(count):
    """Numbers without enough space are left out, but never the first and the last."""
    axes = drawn(scanpath_of(torch.randperm(1600, generator=torch.Generator().manual_seed(0))[:count], 40, 40))
    numbers = {int(text.get_text()) for text in axes.texts}
    assert {0, count - 1} <= numbers
    boxes = [text.get_bbox_patch().get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))


number = st.floats(0, 100, allow_nan=False)


def apart(a, b):
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


@given(st.lists(st.tuples(number, number), min_size=1, max_size=14))
def test_placed_numbers_do_not_overlap_and_stay_in_the_frame(points):
    placed = place_numbers(points, [(9, 6)] * len(points), (100, 100), 30)
    assert len(placed) == len(points)
    assert placed[0] is not None
    kept = [box for box in placed if box is not None]
    assert all(apart(a, b) for a, b in combinations(kept, 2))
    for point, box in zip(points, placed, strict=True):
        if box is not None:
            assert box[0] >= 0
            assert box[1] >= 0
            assert box[2] <= 100 + 1e-9
            assert box[3] <= 100 + 1e-9
            others = [other for other in points if other != point]
            assert not any(box[0] < x < box[2] and box[1] < y < box[3] for x, y in others)


@given(st.lists(st.lists(st.tuples(number, number), min_size=1, max_size=4), max_size=9))
def test_labels_with_several_candidate_positions_do_not_overlap(candidates):
    placed = place_within(candidates, [(20, 6)] * len(candidates), (100, 100))
    assert all(apart(a, b) for a, b in combinations(placed, 2))
    if candidates:
        x, y = candidates[0][0]
        middle = (placed[0][0] + placed[0][2]) / 2, (placed[0][1] + placed[0][3]) / 2
        assert middle == pytest.approx((min(max(x, 10), 90), min(max(y, 3), 97)))
