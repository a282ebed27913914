"""Areas of interest and the smallest areas with a share of the fixations, against counts of fine pixels."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import DataError
from semfov.paths.areas import border_of, percent, read_areas, share_in, shares_around
from tests.refusals import refused
from tests.small import rand

SIZE = (64, 48)


def density(rows, columns):
    values = rand(rows, columns).double() ** 3
    return values / values.sum()


@given(st.integers(0, 27), st.integers(1, 28), st.integers(0, 19), st.integers(1, 20))
def test_a_share_counts_pixels_in_part(left, width, top, height):
    """Edges are at quarters of a pixel; a pixel is sixteen finer ones."""
    values = density(5, 7)
    right, bottom = min(left + width, 28), min(top + height, 20)
    fine = np.kron(values.numpy(), np.ones((4, 4)) / 16)[top:bottom, left:right].sum()
    assert share_in(values, (left / 4, top / 4, right / 4, bottom / 4)) == pytest.approx(float(fine), abs=1e-12)


def test_the_whole_picture_holds_all_fixations():
    assert share_in(density(9, 4), (0, 0, 4, 9)) == pytest.approx(1)


def test_the_smallest_area_has_the_highest_cells():
    values = density(6, 8)
    shares = shares_around(values)
    for cell in range(48):
        own = values.flatten()[cell]
        assert float(shares.flatten()[cell]) == pytest.approx(float(values[values >= own].sum()), abs=1e-9)
    for share in (0.1, 0.5, 0.9):
        border = border_of(values, share)
        inside = values >= border - 1e-12
        assert float(values[inside].sum()) >= share - 1e-12
        assert float(values[inside].sum()) - border < share  # one cell less would hold less
    assert border_of(torch.tensor([[0.25, 0.75]]), 1.0) == 0.25


def test_areas_are_read_from_texts_mappings_and_files(tmp_path):
    boxes = {"logo": (10, 20, 30, 40.5), "price tag": (0, 0, 64, 48)}
    expected = {"logo": (10.0, 20.0, 30.0, 40.5), "price tag": (0.0, 0.0, 64.0, 48.0)}
    assert read_areas(boxes, SIZE) == expected
    (tmp_path / "areas.JSON").write_text(json.dumps(boxes))
    assert read_areas(tmp_path / "areas.JSON", SIZE) == expected
    assert read_areas(str(tmp_path / "areas.JSON"), SIZE) == expected
    by_picture = {"a.png": boxes, "b.png": {"logo": (0, 0, 1, 1)}}
    assert read_areas(by_picture, SIZE, ["a.png"]) == expected
    assert read_areas(by_picture, SIZE, ["folder/c.png", "b.png"]) == {"logo": (0, 0, 1, 1)}
    refused("areas: expected boxes for c.png, got those of 'a.png', 'b.png'", read_areas, by_picture, SIZE, ["c.png"])
    assert read_areas("logo:10,20,30,40.5  a:b:0,0,1,1", SIZE) == {"logo": (10, 20, 30, 40.5), "a:b": (0, 0, 1, 1)}


@pytest.mark.parametrize(
    ("areas", "said"),
    [
        ("logo", "areas: expected areas by name as NAME:LEFT,TOP,RIGHT,BOTTOM"),
        ("logo:1,2,3", "areas: expected areas by name"),
        (":1,2,3,4", "areas: expected areas by name"),
        ("a:1,2,3,4 a:1,2,3,5", "areas: expected a name for each area, got 'a' twice"),
        ("", "areas: expected 1 to 100 areas"),
        (
            {"logo": {"x": 6, "y": 4, "width": 16, "height": 12}},
            r"^areas\['logo'\]: expected four numbers.*left \+ width",
        ),
        ({"logo": (30, 20, 10, 40)}, r"areas\['logo'\]: expected left < right .*right = left \+ width"),
        ({"logo": (10, 20, 65, 40)}, r"in a picture of 64 × 48 px .*got 10,20,65,40"),
        ({"logo": (float("nan"), 20, 30, 40)}, r"areas\['logo'\]"),
        ({"logo": "1,2,3,4"}, "four numbers: left, top, right and bottom"),
        ({"logo": (1, 2, None, 4)}, "four numbers"),
        ({"logo": 3}, "four numbers"),
        ({"": (1, 2, 3, 4)}, "names of 1 to 60 letters"),
        ({3: (1, 2, 3, 4)}, "names of 1 to 60 letters"),
        ({"\x1b[2J": (1, 2, 3, 4)}, "names of 1 to 60 letters"),
        ([("logo", (1, 2, 3, 4))], "a mapping of names to boxes"),
    ],
)
def test_other_areas_are_refused(areas, said):
    refused(said, read_areas, areas, SIZE)


def test_files_without_areas_are_told(tmp_path):
    (tmp_path / "list.json").write_text("[1, 2]")
    refused("boxes by name", read_areas, tmp_path / "list.json", SIZE)
    (tmp_path / "twice.json").write_text('{"logo": [1, 2, 3, 4], "logo": [5, 6, 7, 8]}')
    with pytest.raises(DataError, match=r"twice\.json: .*'logo' stands in it twice"):
        read_areas(str(tmp_path / "twice.json"), SIZE)
    with pytest.raises(DataError, match=r"none\.json"):
        read_areas(str(tmp_path / "none.json"), SIZE)


def test_small_shares_keep_a_decimal():
    assert [percent(share) for share in (0.0, 0.0012, 0.0099, 0.01, 0.255, 1.0)] == [
        "0 %", "0.1 %", "1.0 %", "1 %", "26 %", "100 %"
    ]  # fmt: skip
