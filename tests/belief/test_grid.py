"""The grid against loops over cells and pixels."""

import math
from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Grid
from semfov.belief.grid import check_cells
from tests.refusals import refused


def overlap_by_loop(grid: Grid, size: tuple[int, int], box: list[float]) -> list[bool]:
    width, height = size
    covered = []
    for row in range(grid.rows):
        for column in range(grid.columns):
            left, right = column * width / grid.columns, (column + 1) * width / grid.columns
            top, bottom = row * height / grid.rows, (row + 1) * height / grid.rows
            across = min(right, box[2]) - max(left, box[0])
            down = min(bottom, box[3]) - max(top, box[1])
            covered.append(across > 0 and down > 0)
    return covered


@given(
    st.integers(1, 7),
    st.integers(1, 7),
    st.tuples(st.sampled_from([64, 100, 640]), st.sampled_from([48, 77, 427])),
    st.lists(st.floats(-20, 700, width=32), min_size=4, max_size=4),
)
def test_overlap_equals_the_loop(columns, rows, size, corners):
    (x1, x2), (y1, y2) = sorted(corners[::2]), sorted(corners[1::2])
    box = [x1, y1, x2, y2]
    grid = Grid(columns, rows, size)
    got = grid.footprint(torch.tensor([box], dtype=torch.float64))[0].tolist()
    expected = overlap_by_loop(grid, size, box) if x2 > x1 and y2 > y1 else [False] * len(grid)
    assert got == expected


@pytest.mark.parametrize("rule", ["overlap", "centre", "box_centre"])
def test_footprint_rules(rule):
    grid = Grid(10, 10, (100, 100))
    box = torch.tensor([[12.0, 12, 38, 28], [41, 41, 43, 43], [5, 5, 5, 9], [8, 18, 27, 32]])
    expected = {
        "overlap": [{11, 12, 13, 21, 22, 23}, {44}, set(), {10, 11, 12, 20, 21, 22, 30, 31, 32}],
        "centre": [{11, 12, 13, 21, 22, 23}, {44}, set(), {21, 22}],
        "box_centre": [{22}, {44}, set(), {21}],
    }[rule]
    got = [set(row.nonzero()[:, 0].tolist()) for row in grid.footprint(box, rule)]
    assert got == expected


@pytest.mark.parametrize("size", [(96, 56), torch.tensor([100.0, 60.0]).double()], ids=["exact", "rounded"])
def test_a_cell_as_a_box_covers_only_itself(size):
    """Also where the size of the image has more digits than the box, so that borders are rounded."""
    grid = Grid(6, 7, size)
    assert torch.equal(grid.footprint(grid.edges.float()), torch.eye(42, dtype=torch.bool))


def test_a_centre_on_the_left_or_upper_border_of_a_box_is_inside_and_on_the_others_outside(dtype):
    """The image is a pixel wide, so that errors of half a pixel would show."""
    grid = Grid(6, 7, torch.tensor([1.0, 0.6], dtype=dtype))
    centres, row, column = (grid.centres + 0.5).float(), torch.arange(42) // 6, torch.arange(42) % 6
    far = torch.tensor([1.0, 0.6]).expand(42, 2)
    inside = (column >= column[:, None]) & (row >= row[:, None])
    assert torch.equal(grid.footprint(torch.cat([centres, far], -1), "centre"), inside)
    before = (column < column[:, None]) & (row < row[:, None])
    some = before.any(-1)
    assert torch.equal(grid.footprint(torch.cat([0 * far, centres], -1), "centre")[some], before[some])


def test_soft_weights_are_a_normal_window_inside_the_box():
    grid = Grid(10, 5, (100, 100))
    box = torch.tensor([[12.0, 12.0, 38.0, 58.0], [5.0, 5.0, 5.0, 9.0]], dtype=torch.float64)
    weights = grid.footprint(box, "soft")
    assert torch.equal(weights > 0, grid.footprint(box))
    for cell in grid.footprint(box)[0].nonzero()[:, 0].tolist():
        x, y = 10 * (cell % 10) + 5 - 25, 20 * (cell // 10) + 10 - 35
        expected = math.exp(-(x**2) / (2 * (13**2 + 5**2) / 3) - y**2 / (2 * (23**2 + 10**2) / 3))
        assert float(weights[0, cell]) == pytest.approx(expected)


def test_batch_of_sizes_equals_single_grids():
    sizes = [(640, 480), (300, 500), (90, 90)]
    torch.manual_seed(0)
    corner = torch.rand(3, 5, 2) * 300
    boxes = torch.cat([corner, corner + torch.rand(3, 5, 2) * 200], -1)
    fixation = torch.rand(3, 2) * 300
    batch = Grid(5, 4, torch.tensor(sizes))
    for rule in ("overlap", "centre", "box_centre", "soft"):
        singles = [Grid(5, 4, size).footprint(b, rule) for size, b in zip(sizes, boxes, strict=True)]
        torch.testing.assert_close(batch.footprint(boxes, rule), torch.stack(singles))
    for name in ("centres", "edges", "cell_distance"):
        torch.testing.assert_close(getattr(batch, name)[1], getattr(Grid(5, 4, sizes[1]), name))
    single = Grid(5, 4, sizes[1]).box_distance(boxes[1], fixation[1])
    torch.testing.assert_close(batch.box_distance(boxes, fixation)[1], single)
    torch.testing.assert_close(batch.distance(fixation)[1], Grid(5, 4, sizes[1]).distance(fixation[1]))


def test_bad_input():
    refused(".", lambda: Grid(0, 3, (10, 10)))
    refused(".", lambda: Grid(3, 3, (10, 0)))
    refused(".", lambda: Grid(3, 3, (10, 10, 10)))
    refused(".", lambda: Grid(3, 3, (10, 10)).footprint(torch.zeros(1, 4), "all"))


def test_centres_edges_and_distances():
    grid = Grid(2, 2, (8, 4))
    assert grid.centres.tolist() == [[1.5, 0.5], [5.5, 0.5], [1.5, 2.5], [5.5, 2.5]]
    assert grid.edges[3].tolist() == [4, 2, 8, 4]
    assert torch.equal(grid.cell_of(grid.centres), torch.arange(4))
    assert Grid(2, 1, (1, 0.5)).centres.tolist() == [[-0.25, -0.25], [0.25, -0.25]]
    grid = Grid(2, 1, (200, 100))
    assert grid.cell_distance.tolist() == [[0, 0.5], [0.5, 0]]
    box = torch.tensor([[90.5, 40.5, 110.5, 60.5]])
    assert grid.box_distance(box, torch.tensor([100.0, 80.0])).tolist() == [pytest.approx(0.15)]


@pytest.mark.parametrize("shape", [(4,), (2, 3), (2, 5)])
def test_boxes_of_the_wrong_shape_are_refused_by_name(shape):
    grid, fixation = Grid(3, 2, (30, 20)), torch.zeros(2)
    for call in (lambda: grid.footprint(torch.zeros(shape)), lambda: grid.box_distance(torch.zeros(shape), fixation)):
        refused(r"^boxes: expected a tensor of shape", call)


@pytest.mark.parametrize("shape", [(), (3,), (2, 1)])
def test_points_of_the_wrong_shape_are_refused_by_name(shape):
    grid, point = Grid(3, 2, (30, 20)), torch.zeros(shape)
    for name, call in (
        ("points", lambda: grid.cell_of(point)),
        ("fixation", lambda: grid.distance(point)),
        ("fixation", lambda: grid.box_distance(torch.zeros(2, 4), point)),
    ):
        refused(rf"^{name}: expected a tensor of shape", call)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_nan_and_infinity_are_refused_by_name(number):
    grid, box, point = Grid(3, 2, (30, 20)), torch.tensor([[1.0, 2.0, 3.0, 4.0]]), torch.tensor([1.0, number])
    bad = torch.where(box == 3, number, box)
    for name, call in (
        *(("boxes", partial(grid.footprint, bad, rule)) for rule in ("overlap", "centre", "box_centre", "soft")),
        ("boxes", lambda: grid.box_distance(bad, torch.zeros(2))),
        ("fixation", lambda: grid.box_distance(box, point)),
        ("points", lambda: grid.cell_of(point)),
    ):
        refused(rf"^{name}: expected finite numbers", call)


@pytest.mark.parametrize("size", [torch.float32, torch.float64])
def test_results_have_the_dtype_of_the_boxes_and_points(dtype, size):
    grid, boxes = Grid(3, 2, torch.tensor([31.0, 17.0], dtype=size)), torch.tensor([[1.0, 2, 20, 15]], dtype=dtype)
    assert grid.footprint(boxes, "soft").dtype == dtype
    assert grid.distance(boxes[0, :2]).dtype == dtype
    assert grid.box_distance(boxes, boxes[0, :2]).dtype == dtype
    assert grid.footprint(boxes).dtype == grid.footprint(boxes, "centre").dtype == torch.bool
    assert Grid(3, 2, (31, 17)).extent.dtype == torch.get_default_dtype()


@pytest.mark.parametrize("grid", [(1, 1), [200, 1], (3, 200)])
def test_grids_have_two_sides_of_1_to_200_cells(grid):
    check_cells(grid)
    for bad in (grid[:1], (*grid, 1), (0, grid[1]), (grid[0], 201), (1.5, 2), 7):
        refused(r"^grid:", check_cells, bad)


def test_points_and_boxes_near_borders_and_outside():
    grid = Grid(4, 3, (40, 30))
    inside = [[9.4, 5], [9.6, 5], [29.4, 19.4], [29.6, 19.6]]
    assert grid.cell_of(torch.tensor(inside)).tolist() == [0, 1, 6, 11]
    outside = [[-99, -99], [99, -99], [-99, 99], [99, 99], [15, -99], [15, 99], [-99, 15], [99, 15]]
    assert grid.cell_of(torch.tensor(outside).float()).tolist() == [0, 3, 8, 11, 1, 9, 4, 7]
    # Edges of boxes are counted from the image's edge: a centre at 9.9 is in the first cell, at 10.1 in the second.
    boxes = torch.tensor([[8.9, 4, 10.9, 6], [9.1, 4, 11.1, 6], [14, 8.9, 16, 10.9], [14, 9.1, 16, 11.1]])
    assert grid.footprint(boxes, "box_centre").int().argmax(-1).tolist() == [0, 1, 1, 5]
    assert (grid.footprint(boxes, "box_centre").sum(-1) == 1).all()
