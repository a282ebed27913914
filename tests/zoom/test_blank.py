"""Ground where there is nothing to see: no look of those that follow the first goes there."""

import numpy as np
import pytest
import tifffile
import torch

from semfov.data.large import open_large
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.blank import blank_cells
from semfov.zoom.slices import usual_slices
from tests.data.test_large import pixels

CANVAS = (200, 200)


def scan(height=600, width=900, colour=(255, 255, 255), seed=0):
    """A picture whose right part is blank, along a line that is not upright."""
    array = pixels(height, width, seed=seed)
    y, x = np.mgrid[:height, :width]
    blank = x > 400 + y // 5
    array[blank] = colour
    return array, blank


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (12, 200, 90)])
@pytest.mark.parametrize("large", [1 << 24, 1 << 15])  # pictures with more pixels are read from reduced copies
def test_blank_cells_are_those_whose_pixels_are_all_blank(monkeypatch, colour, large):
    monkeypatch.setattr("semfov.data.windowed._LARGE", large)
    array, blank = scan(colour=colour)
    lattice = Lattice.over((900, 600), CANVAS)
    cells = blank_cells(open_large(array), lattice)
    for row in range(lattice.rows):
        for column in range(lattice.columns):
            x1, y1 = (int(n * pitch) for n, pitch in zip((column, row), lattice.pitch, strict=True))
            x2, y2 = (int(np.ceil((n + 1) * p)) for n, p in zip((column, row), lattice.pitch, strict=True))
            whole, near = (blank[max(y1 - m, 0) : y2 + m, max(x1 - m, 0) : x2 + m].all() for m in (0, 8))
            assert near <= bool(cells[row, column]) <= whole


def test_one_colour_inside_a_picture_is_something_unless_it_is_no_data(tmp_path):
    """A white roof is no border; a hole of a file that tells which pixels are none is blank."""
    array = pixels(600, 900)
    lattice = Lattice.over((900, 600), CANVAS)
    assert blank_cells(open_large(array), lattice) is None
    array[:100] = 255
    array[300:400, 300:500] = 255
    only_border = blank_cells(open_large(array), lattice)
    assert only_border[:3].all()
    assert not only_border[4:].any()
    alpha = np.where((array == 255).all(-1), 0, 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", np.dstack([pixels(600, 900), alpha]), photometric="rgb", extrasamples=[2])
    tifffile.imwrite(
        tmp_path / "b.tif", array, photometric="rgb", extratags=[(42113, "s", 0, "255", True)], tile=(64, 64)
    )
    for name in ("a.tif", "b.tif"):
        cells = blank_cells(open_large(tmp_path / name), lattice)
        wide, high = lattice.pitch
        assert torch.equal(cells[: int(250 / high)], only_border[: int(250 / high)])
        assert cells[int(300 / high + 1) : int(400 / high), int(300 / wide + 1) : int(500 / wide)].all()
        assert not cells[int(400 / high) + 1 :].any()


def test_slices_of_blank_ground_are_left_out():
    array, blank = scan()
    lattice = Lattice.over((900, 600), CANVAS)
    seen = usual_slices(lattice, blank_cells(open_large(array), lattice))
    assert 0 < len(seen) < len(usual_slices(lattice))
    for window in usual_slices(lattice):
        x1, y1, x2, y2 = map(int, window.within)
        assert (window in seen) or blank[y1 + 16 : y2 - 16, x1 + 16 : x2 - 16].all()
    nothing = torch.ones(lattice.rows, lattice.columns, dtype=torch.bool)
    assert usual_slices(lattice, nothing) == usual_slices(lattice)


def test_what_is_left_to_see_of_a_window_is_of_what_is_not_blank():
    """Nor to where little is not blank: the share that counts is of a quarter of the window at least."""
    array, _ = scan()
    lattice = Lattice.over((900, 600), CANVAS)
    cells = blank_cells(open_large(array), lattice)
    belief = ZoomBelief(lattice, GlimpseEvidence(3, 8), 1, lambda: cells)
    assert torch.equal(belief.left, belief.there)
    for level in range(1, lattice.levels):
        span = lattice.span(level)
        unseen = belief.unseen(level)
        for row in range(unseen.shape[0]):
            for column in range(unseen.shape[1]):
                part = ~cells[row : row + span, column : column + span].numpy()
                whole = min(span, lattice.rows) * min(span, lattice.columns)
                assert np.isclose(unseen[row, column], min(1, part.sum() / (whole / 4)))
