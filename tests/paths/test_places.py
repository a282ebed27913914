"""Places of a density, by loops over pairs of cells."""

import itertools
import math

import pytest

from semfov.paths.places import REACH, places_of
from tests.small import rand


def places_by_loops(cells, size, around):
    rows, columns = cells.shape
    width, height = size
    reach = REACH * max(size)
    numbers = itertools.product(range(rows), range(columns))
    centres = [((column + 0.5) * width / columns, (row + 0.5) * height / rows) for row, column in numbers]
    density = cells.flatten().tolist()

    def distance(one, other):
        across = abs(one[0] - other[0])
        return math.hypot(min(across, width - across) if around else across, one[1] - other[1]) / reach

    shares: list[float] = []
    weighted: list[float] = []
    for centre in centres:
        pairs = [(distance(centre, other), p) for other, p in zip(centres, density, strict=True)]
        shares.append(sum(p for d, p in pairs if d <= 1))
        weighted.append(sum(p * (1 - d) for d, p in pairs if d < 1))
    open_cells = set(range(len(centres)))
    places = []
    while open_cells:
        best = max(open_cells, key=lambda cell: weighted[cell])
        places.append((centres[best], shares[best]))
        open_cells = {cell for cell in open_cells if distance(centres[best], centres[cell]) > 2}
    return sorted(places, key=lambda place: -place[1])


def test_places_equal_loops_also_after_a_picture_of_another_size():
    """Distances of cells stay for the next density; they depend on the size of the picture and on its edges."""
    # Sizes at which no distance of two cells is the reach of a place.
    for size, around, shape in (
        ((400, 100), False, (9, 29)),
        ((400, 100), True, (9, 29)),
        ((400, 91), True, (9, 29)),
        ((400, 91), True, (8, 29)),
        ((400, 91), True, (8, 29)),
    ):
        cells = rand(*shape) ** 8
        cells = cells / cells.sum()
        expected = places_by_loops(cells, size, around)
        places = places_of(cells, size, around=around)
        assert len(places) == len(expected)
        for place, (centre, share) in zip(places, expected, strict=True):
            assert place["share"] == pytest.approx(share, rel=1e-3)
            assert (place["x"] + 0.5, place["y"] + 0.5) == pytest.approx(centre, abs=0.011)
