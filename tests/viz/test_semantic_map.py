"""Regions of a semantic map and the places of their labels."""

import math
import warnings
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import scipy.ndimage
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Grid
from semfov.cli.outcome import _regions_lines
from semfov.paths.regions import _regions, named_regions
from semfov.viz import plot_semantic_map
from semfov.viz.labels import place_labels, place_numbers, place_within
from semfov.viz.semantic import _borders, cell_entropy
from tests import small

CLASSES = ("background", "cat", "cup", "dog")


def scanpath_of(probabilities, columns, classes=CLASSES):
    """The scanpath of an exploration with maps `(n, X·Y, K+1)`."""
    looks, rows = len(probabilities), probabilities.shape[1] // columns
    grid, seconds = Grid(columns, rows, (10 * columns, 10 * rows)), ({"detect": 0.001},) * looks
    return small.scanpath(grid, torch.arange(looks), classes, probabilities=probabilities, seconds=seconds)


def labelled(table):
    """Connected regions of each class, by scipy."""
    found = set()
    for label in set(table.ravel().tolist()) - {0}:
        parts, count = scipy.ndimage.label(table == label)
        found |= {(label, tuple(np.flatnonzero(parts == part).tolist())) for part in range(1, count + 1)}
    return found


def test_regions_equal_those_of_scipy():
    for classes in [1, 2, 4]:
        for shape in [(1, 1), (1, 9), (9, 1), (6, 7), (12, 10)]:
            for seed in range(6):
                table = torch.randint(classes + 1, shape, generator=torch.Generator().manual_seed(seed))
                found = _regions(table)
                assert {(int(table.flatten()[cells[0]]), tuple(cells)) for cells in found} == labelled(table.numpy())
                assert all(cells == sorted(cells) for cells in found)
                assert sorted(cell for cells in found for cell in cells) == table.flatten().nonzero()[:, 0].tolist()
    assert _regions(torch.zeros(3, 4, dtype=torch.long)) == []
    assert _regions(torch.full((3, 4), 2)) == [list(range(12))]
    snake = torch.tensor([[1, 1, 1], [0, 0, 1], [1, 1, 1], [1, 0, 0], [1, 1, 1]])
    assert [len(cells) for cells in _regions(snake)] == [11]


@pytest.mark.parametrize("count", [2, 4, 12])
@pytest.mark.parametrize("marginal", [True, False])
def test_named_regions_equal_a_loop(count, marginal):
    """Objects more probable than background, and than 1/2 or 3 / (number of classes), whichever is smaller."""
    classes = ("background", *(f"class {number}" for number in range(1, count)))
    for seed in range(5):
        generator = torch.Generator().manual_seed(seed)
        probabilities = torch.rand(2, 42, count, generator=generator) ** 3
        if not marginal:
            probabilities = probabilities / probabilities.sum(-1, keepdim=True)
        scanpath = scanpath_of(probabilities, 7, classes)
        for fixation in (0, 1, -1):
            table = np.zeros(42, dtype=int)
            for cell, (nothing, *objects) in enumerate(probabilities[fixation].tolist()):
                if max(objects) > nothing and max(objects) > min(0.5, 3 / count):
                    table[cell] = 1 + objects.index(max(objects))
            expected = {
                (classes[label], cells, max(float(probabilities[fixation, c, label]) for c in cells))
                for label, cells in labelled(table.reshape(6, 7))
            }
            named = named_regions(scanpath.grid, probabilities[fixation], classes)
            assert {(region.name, tuple(region.cells), region.probability) for region in named} == expected
            sizes = [len(region.cells) for region in named]
            assert sizes == sorted(sizes, reverse=True)
            assert scanpath.regions(fixation) == named
            for region in named:
                place = scanpath.grid.centres.tolist().index([*region.place])
                assert place in region.cells
                assert float(probabilities[fixation, place, classes.index(region.name)]) == region.probability
        assert scanpath.regions() == scanpath.regions(1)
        assert replace(scanpath, target=1, posterior=probabilities[..., 1]).regions() == ()


def marginal_map():
    """A cat with a cup in the same cells, a dog, and cells without objects; 6 × 4 cells, 3 looks."""
    probabilities = torch.full((3, 24, 4), 0.02)
    probabilities[..., 0] = 0.9
    probabilities[-1, 7:11, 0] = 0.05
    probabilities[-1, 7:11, 1] = torch.tensor([0.7, 0.8, 0.95, 0.6])
    probabilities[-1, 8:10, 2] = torch.tensor([0.75, 0.9])
    probabilities[-1, 23] = torch.tensor([0.3, 0.1, 0.1, 0.55])
    probabilities[-1, 0] = torch.tensor([0.1, 0.1, 0.1, 0.52])
    return scanpath_of(probabilities, 6)


def test_figure_of_marginal_probabilities():
    scanpath = marginal_map()
    for image in (None, torch.rand(3, 40, 60)):
        figure = plot_semantic_map(scanpath, image=image)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            figure.draw_without_rendering()
        named, unsure = figure.axes[:2]
        np.testing.assert_allclose(
            named.images[-1].get_array(), scanpath.probabilities[-1, :, 1:].amax(-1).reshape(4, 6), rtol=1e-6
        )
        assert named.images[-1].get_clim() == (0, 1)
        np.testing.assert_allclose(unsure.images[-1].get_array(), cell_entropy(scanpath)[-1].reshape(4, 6), rtol=1e-6)
        places = {text.get_text(): text.get_position() for text in named.texts}
        assert sorted(text.get_text() for text in named.texts if text.get_text() in CLASSES) == ["cat", "dog", "dog"]
        assert places["cat"] in [(x, 15) for x in (15, 25, 35, 45)]  # the middle of one of its cells


def test_borders_go_around_regions():
    """The number of lines equals the number of cell sides between the region and other cells or the frame."""
    table = torch.randint(3, (6, 7), generator=torch.Generator().manual_seed(0))
    grid = Grid(7, 6, (70, 60))
    padded = np.pad(table.numpy(), 1, constant_values=-1)
    for region in _regions(table):
        inside = np.zeros(42, dtype=int)
        inside[region] = 1
        framed = np.pad(inside.reshape(6, 7), 1)
        expected = np.abs(np.diff(framed, axis=0)).sum() + np.abs(np.diff(framed, axis=1)).sum()
        lines = _borders(grid, region)
        assert len(lines) == expected
        for (x1, y1), (x2, y2) in lines:
            assert abs(x2 - x1) + abs(y2 - y1) == pytest.approx(10)
            # One side of each line is a cell of the region, the other one is not.
            x, y = (x1 + x2) / 20, (y1 + y2) / 20
            off = (0.5, 0) if x1 == x2 else (0, 0.5)
            pair = [padded[math.floor(y + s * off[1]) + 1, math.floor(x + s * off[0]) + 1] for s in (-1, 1)]
            assert len({int(each) for each in pair}) == 2


def test_entropy_is_that_of_normalised_probabilities():
    scanpath = marginal_map()
    got = cell_entropy(scanpath)
    assert got.shape == (3, 24)
    for look in range(3):
        for cell in range(24):
            p = scanpath.probabilities[look, cell].double().tolist()
            expected = -sum(value / sum(p) * math.log2(value / sum(p)) for value in p)
            assert float(got[look, cell]) == pytest.approx(expected, abs=1e-5)
    assert float(got.max()) <= 2


def test_an_exploration_is_told_as_classes_and_their_cells():
    """One line for each class: its number of cells, its highest probability and the middle of its cell."""
    assert _regions_lines(marginal_map()) == [
        "  map: cat in 4 cells, p up to 0.95 around (34, 14)",
        "  map: dog in 2 cells, p up to 0.55 around (54, 34)",
    ]
    cats = replace(marginal_map(), targets=(marginal_map().classes.index("cat"),))
    assert _regions_lines(cats) == ["  map: cat in 4 cells, p up to 0.95 around (34, 14)"]
    empty = torch.tensor([0.9, 0.3, 0.2, 0.1]).expand(2, 24, -1)
    assert _regions_lines(scanpath_of(empty, 6)) == []
    one = empty.clone()
    one[-1, 5, 2] = 0.97
    assert len(_regions_lines(scanpath_of(one, 6))) == 1


number = st.floats(0, 100, allow_nan=False)
boxes = st.lists(st.tuples(number, number, number, number), max_size=12)


def apart(a, b):
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


@given(boxes, st.tuples(number, number))
def test_labels_do_not_overlap(corners, point):
    framed = [(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d in corners]
    gaze = (point[0], point[1], point[0] + 5, point[1] + 5)
    labels = place_labels(framed, [(20, 6)] * len(framed), (100, 100), [gaze])
    assert len(labels) == len(framed)
    assert all(apart(a, b) for a, b in combinations([gaze, *labels], 2))
    assert all(abs(x2 - x1 - 20) < 1e-9 and abs(y2 - y1 - 6) < 1e-9 for x1, y1, x2, y2 in labels)


def test_a_label_is_in_the_corner_of_its_box_and_in_the_frame():
    assert place_labels([(10, 20, 60, 70)], [(20, 6)], (100, 100)) == [(10, 20, 30, 26)]
    assert place_labels([(95, 98, 100, 100)], [(20, 6)], (100, 100)) == [(80, 94, 100, 100)]


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
        assert placed[0][:2] == pytest.approx((min(x, 80), min(y, 94)))
