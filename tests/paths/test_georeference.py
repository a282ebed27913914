"""Places on earth as GeoJSON has them (RFC 7946): longitudes from -180 to 180, rings that are counterclockwise."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semfov.paths.georeference import box_on_earth, polygon_on_earth


def area(ring):
    """Signed area of a closed ring, above 0 where it is counterclockwise."""
    x, y = np.array(ring).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum() / 2)


def box(west, south, width, height):
    return np.array([[west, south], [west + width, south], [west + width, south + height], [west, south + height]])


def rings(geometry):
    """The rings of a geometry, one of each polygon."""
    parts = [geometry["coordinates"]] if geometry["type"] == "Polygon" else geometry["coordinates"]
    assert all(len(part) == 1 for part in parts)
    return [part[0] for part in parts]


@given(
    st.floats(-400, 800),
    st.floats(-80, 70),
    st.floats(0.01, 100),
    st.floats(0.01, 10),
    st.booleans(),
    st.integers(0, 3),
    st.lists(st.sampled_from([-360, 0, 360]), min_size=4, max_size=4),
)
def test_a_box_keeps_its_area_on_both_sides_of_the_antimeridian(west, south, width, height, clockwise, first, turns):
    """Wherever it begins, whichever way its corners go round, and whatever turns they are given in."""
    ring = np.roll(box(west, south, width, height), first, 0)[:: -1 if clockwise else 1].copy()
    ring[:, 0] += turns
    found = rings(polygon_on_earth(ring))
    assert all(part[0] == part[-1] for part in found)
    assert all(-180 <= x <= 180 for part in found for x, _ in part)
    areas = [area(part) for part in found]
    assert min(areas) >= 0
    assert sum(areas) == pytest.approx(width * height, rel=1e-5, abs=1e-6)
    over = (west + 180) % 360 + width > 360 + 1e-9
    if abs((west + 180) % 360 + width - 360) > 1e-6 and (west + 180) % 360 > 1e-6:
        assert len(found) == 1 + over


def test_longitudes_from_0_to_360():
    assert rings(polygon_on_earth(box(200.0, 1.0, 2.0, 1.0))) == [
        [[-160, 1], [-158, 1], [-158, 2], [-160, 2], [-160, 1]]
    ]
    west, east = rings(polygon_on_earth(box(179.0, 1.0, 3.0, 1.0)))
    assert {x for x, _ in west} == {179, 180}
    assert {x for x, _ in east} == {-180, -178}


@given(st.floats(-400, 800), st.floats(181, 360))
def test_a_box_may_be_wider_than_half_the_globe(west, width):
    shown = rings(box_on_earth(box(west, -60.0, width, 120.0), lambda points: points - [360.0, 0.0]))
    assert sum(map(area, shown)) == pytest.approx(width * 120)
    assert all(-180 <= x <= 180 for part in shown for x, _ in part)


@pytest.mark.parametrize("pole", [90.0, -90.0])
@pytest.mark.parametrize("first", [-180.0, -100.0, 33.0, 300.0])
@pytest.mark.parametrize("way", [1, -1])
def test_a_ring_round_a_pole_holds_it(pole, first, way):
    """The cap from a parallel to the pole is 360 × 20 square degrees of longitude and latitude."""
    longitudes = first + way * np.arange(0, 360, 30.0)
    ring = np.stack([longitudes, np.full(12, pole * 7 / 9)], -1)
    found = rings(polygon_on_earth(ring))
    assert sum(map(area, found)) == pytest.approx(360 * 20)
    assert {abs(x) for part in found for x, y in part if y == pole} >= {180.0}
    assert all(-180 <= x <= 180 for part in found for x, _ in part)
