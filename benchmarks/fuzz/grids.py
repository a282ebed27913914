"""Fuzz grids with boxes at any place, of any size, and with invalid boxes."""

import math

import numpy as np
import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import Grid

RULES = ("overlap", "centre", "box_centre", "soft")


def boxes_on_grids(data: st.DataObject) -> str:
    """`Grid.footprint` and `cell_of`: the same result as a loop over cells, or `InputError`."""
    rng = draw_rng(data)
    columns, rows = (7 - data.draw(st.integers(0, 7), label=side) for side in ("columns", "rows"))
    # With these sizes the borders of cells are binary fractions, which are exact in floating point.
    unit = choose(data, (1, 8, 32, 64, 8, 32, 0), "unit")
    size = (columns * unit, rows * unit)
    grid = attempt(lambda: Grid(columns, rows, size))
    if failed(grid):
        assert columns * rows * unit == 0, grid
        return outcome(grid)
    assert columns * rows * unit > 0
    assert isinstance(grid, Grid)
    boxes = rng.integers(-8, 8 * max(columns, rows), (5, 4)) * unit / 8
    boxes[0] = np.sort(boxes[0].reshape(2, 2), axis=0).ravel()
    odd = choose(data, ("none", "none", "huge", "huge", "nan", "inf"), "odd")
    if odd != "none":
        boxes[1, rng.integers(4)] = {"nan": np.nan, "inf": rng.choice([-np.inf, np.inf]), "huge": 1e30}[odd]
    rule = choose(data, RULES, "rule")
    tensor = torch.from_numpy(boxes).to(choose(data, (torch.float32, torch.float64), "dtype"))
    result = attempt(lambda: grid.footprint(tensor, rule))
    if failed(result):
        assert odd in ("nan", "inf"), result
        return outcome(result)
    assert odd not in ("nan", "inf")
    assert isinstance(result, torch.Tensor)
    assert result.shape == (5, columns * rows)
    if result.is_floating_point():
        assert bool(((result >= 0) & (result <= 1)).all())
    for box, mask in zip(boxes, (result > 0).numpy(), strict=True):
        overlapped = np.array([overlaps(box, cell, columns, unit) for cell in range(columns * rows)])
        if rule == "overlap":
            assert (mask == overlapped).all(), (box, mask, overlapped)
        elif rule == "soft":
            assert (mask <= overlapped).all()
        elif not (box[2] > box[0] and box[3] > box[1]):
            assert not mask.any()
        elif rule == "box_centre":
            assert mask.sum() == 1
    points = tensor[:, :2].double()
    for point, cell in zip(points.tolist(), grid.cell_of(points).tolist(), strict=True):
        column, row = (math.floor((value + 0.5) / unit) for value in point)
        assert cell == min(max(row, 0), rows - 1) * columns + min(max(column, 0), columns - 1)
    return "result"


def overlaps(box: np.ndarray, cell: int, columns: int, unit: float) -> bool:
    """Whether the overlap of box and cell has a positive area."""
    left, top = cell % columns * unit, cell // columns * unit
    width = min(box[2], left + unit) - max(box[0], left)
    height = min(box[3], top + unit) - max(box[1], top)
    return bool(width > 0 and height > 0 and box[2] > box[0] and box[3] > box[1])
