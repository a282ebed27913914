"""Files of fixations are written and read back, with errors by name; coordinates on screens and in pictures."""

import json
from collections import defaultdict

import numpy as np
import pandas
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Grid
from semfov.data.fixations import (
    Fixations,
    Letterbox,
    by_picture,
    coco_name,
    read_cocosearch,
    read_osie,
    read_ruarte,
    read_table,
    write_cocosearch,
    write_osie,
    write_ruarte,
    write_table,
)
from tests import small
from tests.refusals import refused, unusable

numbers = st.floats(-50, 900, allow_nan=False)


def record(picture="a.jpg", subject="1", points=((1.5, 2.25), (3.0, 4.0)), **more):
    return Fixations(picture, subject, np.array(points, dtype=np.float64), (800, 600), **more)


def assert_equal_records(a, b):
    assert (a.picture, a.subject, a.size, a.target, a.found) == (b.picture, b.subject, b.size, b.target, b.found)
    np.testing.assert_allclose(a.points, b.points)
    assert (a.durations is None) == (b.durations is None)
    if a.durations is not None:
        np.testing.assert_allclose(a.durations, b.durations)
    assert (a.box is None) == (b.box is None)
    if a.box is not None:
        np.testing.assert_allclose(a.box, b.box)


FULL = {
    "durations": np.array([200.0, 310.5]),
    "target": "dining table",
    "box": (10.0, 20.0, 110.5, 70.0),
    "found": True,
}


@pytest.mark.parametrize("more", [{}, FULL], ids=["bare", "full"])
@pytest.mark.parametrize(
    ("write", "read"),
    [
        (write_ruarte, read_ruarte),
        (write_cocosearch, lambda path: read_cocosearch(path, screen=(800, 600))),
        (write_table, read_table),
    ],
    ids=["ruarte", "cocosearch", "table"],
)
def test_written_searches_are_read_back(tmp_path, write, read, more):
    records = [record(**more), record('b, with "comma".jpg', **more)]
    write(tmp_path / "file", records)
    for before, after in zip(records, read(tmp_path / "file"), strict=True):
        assert_equal_records(before, after)


def test_written_free_viewing_records_are_read_back(tmp_path):
    records = [record("a.jpg", "1", durations=np.array([1.0, 2.0])), record("a.jpg", "2"), record("b.jpg", "1")]
    write_osie(tmp_path / "file", records)
    for before, after in zip(records, read_osie(tmp_path / "file"), strict=True):
        assert_equal_records(before, after)
    refused("one size", write_osie, tmp_path / "file", [records[0], records[0].resized((8, 6))])


@pytest.mark.filterwarnings("ignore:.*look like")
@given(st.lists(st.tuples(numbers, numbers), min_size=1, max_size=8))
def test_any_points_are_read_back_from_a_table(tmp_path_factory, points):
    path = tmp_path_factory.mktemp("table") / "t.csv"
    write_table(path, [record(points=points)])
    np.testing.assert_array_equal(read_table(path)[0].points, points)


def test_a_table_written_by_pandas_is_read(tmp_path):
    frame = pandas.DataFrame(
        {"picture": ["a"] * 2 + ["b"], "subject": [1, 1, 1], "x": [0.0, 1, 2], "y": [0, 1, 2.5]}
    ).assign(width=8, height=6)
    frame.to_csv(tmp_path / "t.csv", index=False)
    first, second = read_table(tmp_path / "t.csv")
    assert (first.picture, len(first), second.picture, first.size) == ("a", 2, "b", (8, 6))
    assert second.points.tolist() == [[2, 2.5]]


def trial(**changes):
    fields = {"X": [1, 2], "Y": [3, 4], "T": [100, 200, 50], "image_width": 1680, "image_height": 1050}
    return {**fields, **changes}


def test_durations_after_the_last_fixation_are_left_out(tmp_path):
    """In scanpaths that were cut at their target, X is cut and T is not."""
    (tmp_path / "s.json").write_text(json.dumps({"a.jpg": trial()}))
    assert read_ruarte(tmp_path / "s.json")[0].durations.tolist() == [100, 200]


def test_boxes_in_cells_include_their_last_row_and_column(tmp_path):
    cells = trial(X=[15], Y=[11], image_width=32, image_height=24, receptive_width=1, receptive_height=1)
    cells |= {"target_bbox": [12, 25, 21, 28], "target_object": "bottle", "target_found": False}
    (tmp_path / "s.json").write_text(json.dumps({"a.jpg": cells}))
    (inside,) = read_ruarte(tmp_path / "s.json")
    assert inside.box == (25, 12, 29, 22)
    (mapped,) = read_ruarte(tmp_path / "s.json", screen=(1600, 1200))
    assert mapped.points.tolist() == [[15 * 50 + 24.5, 11 * 50 + 24.5]]
    assert mapped.box == (1250, 600, 1450, 1100)
    assert mapped.found is False


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"Y": [3]}, r"s\.json: a\.jpg: expected as many Y as X, got 2 X and 1 Y"),
        ({"X": [1, None]}, r"s\.json: a\.jpg\.X\[1\]: expected a finite number"),
        ({"T": [100]}, r"s\.json: a\.jpg\.T: expected durations of 2 fixations, got 1"),
        ({"image_width": 0}, r"s\.json: a\.jpg\.image_width"),
        ({"target_bbox": [1, 2, 3]}, r"s\.json: a\.jpg\.target_bbox"),
        ({"target_found": "yes"}, r"s\.json: a\.jpg\.target_found"),
        ({"X": [], "Y": []}, r"s\.json: a\.jpg\.X: expected at least 1"),
    ],
)
def test_errors_name_file_record_and_field(tmp_path, changes, said):
    (tmp_path / "s.json").write_text(json.dumps({"a.jpg": trial(**changes)}))
    unusable(said, read_ruarte, tmp_path / "s.json")


@pytest.mark.parametrize(
    ("content", "read", "said"),
    [
        ("{", read_osie, "cannot be read as JSON"),
        ("[]", read_osie, "expected an object"),
        ('{"a.jpg": [{"x": [1]}]}', read_osie, r"a\.jpg\[0\]\.y: expected a value"),
        ('[{"X": [1], "Y": [1]}]', read_cocosearch, r"\[0\]\.name: expected a value"),
        ('[{"name": "a", "X": [1], "Y": [1, 2]}]', read_cocosearch, r"\[0\] \(a\): expected as many Y as X"),
        ("picture,subject,x,y\na,1,2,3\n", read_table, "got none named width, height"),
        ("picture,subject,x,y,width,height\na,1,2,?,8,6\n", read_table, r"line 2, y: expected a number, got '\?'"),
    ],
)
def test_files_of_another_format_are_refused(tmp_path, content, read, said):
    (tmp_path / "f").write_text(content)
    unusable(rf"{tmp_path.name}/f: .*{said}", read, tmp_path / "f")


def test_pictures_are_sorted_by_name_and_what_is_no_record_is_refused(tmp_path):
    unusable(r"nothing\.csv", read_table, tmp_path / "nothing.csv")
    refused(r"several for a\.jpg", write_ruarte, tmp_path / "s.json", [record(), record()])
    for broken in [{"points": ()}, {"points": ((np.nan, 1.0),)}, {"durations": np.ones(3)}]:
        refused(".", record, **broken)
    assert list(by_picture([record("b"), record("a"), record("b", "2")])) == ["a", "b"]
    refused("name", coco_name, "dog.jpg")


def test_points_count_as_inside_up_to_the_edges_of_pixels():
    assert record(points=[(-0.5, 0), (799.49, 599.49), (799.5, 0), (0, -0.51)]).inside.tolist() == [
        True, True, False, False,
    ]  # fmt: skip


@pytest.mark.filterwarnings("ignore")
def test_fixation_trains_of_pysaliency_are_converted_both_ways(monkeypatch):
    import importlib.util
    import sys
    from types import SimpleNamespace

    from semfov.data.fixations import from_pysaliency, to_pysaliency

    if importlib.util.find_spec("pysaliency") is None:
        pytest.skip("pip install pysaliency")
    if importlib.util.find_spec("pkg_resources") is None:
        monkeypatch.setitem(sys.modules, "pkg_resources", SimpleNamespace(resource_string=None, resource_listdir=None))
    records = [record("a.jpg", "0"), record("b.jpg", "1", points=[(7.0, 8.0)], durations=np.array([200.0]))]
    trains = to_pysaliency(records, ["b.jpg", "a.jpg"])
    # In pysaliency, the pixel of a fixation is the one with the nearest centre.
    assert list(zip(trains.x_int.tolist(), trains.y_int.tolist(), trains.n.tolist(), strict=True)) == [
        (2, 2, 1), (3, 4, 1), (7, 8, 0),
    ]  # fmt: skip
    back = from_pysaliency(trains, ["b.jpg", "a.jpg"], {"a.jpg": (800, 600), "b.jpg": (800, 600)})
    for before, after in zip(records, back, strict=True):
        np.testing.assert_allclose(before.points, after.points)
        assert (before.picture, before.subject) == (after.picture, after.subject)
    refused("pictures", to_pysaliency, records, ["b.jpg"])


@pytest.mark.parametrize("target", [None, 1])
def test_the_scanpath_of_a_model_is_converted_to_a_record(tmp_path, target):
    cells = torch.tensor([0, 5, 11])
    path = small.scanpath(Grid(4, 3, (80, 60)), cells, ("background", "cup"), target=target, found=True)
    fixations = path.as_fixations("a.jpg")
    np.testing.assert_allclose(fixations.points, [[9.5, 9.5], [29.5, 29.5], [69.5, 49.5]])
    assert (fixations.size, fixations.subject) == ((80, 60), "semfov")
    assert (fixations.target, fixations.found) == ((None, None) if target is None else ("cup", True))
    write_table(tmp_path / "t.csv", [fixations])
    assert_equal_records(fixations, read_table(tmp_path / "t.csv")[0])


def test_fixations_far_outside_their_frame_are_reported_with_their_share(tmp_path):
    """A tracker's noise is not: only points that lie farther than half the longer side outside."""
    near = record(points=((-350.0, 5.0), (790.0, 990.0)))
    far = record(subject="2", points=((900.0, 5.0), (1300.0, 300.0)))
    write_table(tmp_path / "a.csv", [near])
    assert len(read_table(tmp_path / "a.csv")) == 1
    write_table(tmp_path / "b.csv", [near, far])
    with pytest.warns(UserWarning, match=r"b\.csv: 1 of 4 fixations \(25 %\) lie far outside their frame.* of 2 in"):
        assert len(read_table(tmp_path / "b.csv")) == 2


sides = st.integers(1, 3000)


@given(sides, sides, sides, sides)
def test_a_letterboxed_picture_fits_and_is_centred(width, height, across, down):
    placed = Letterbox((width, height), (across, down))
    corners = placed.to_screen(np.array([[-0.5, -0.5], [across - 0.5, down - 0.5]])) + 0.5
    left, top, right, bottom = corners.ravel()
    assert left == pytest.approx(width - right, abs=1e-6)
    assert top == pytest.approx(height - bottom, abs=1e-6)
    assert min(left, top) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(placed.to_picture(placed.to_screen(corners)), corners, atol=1e-6)
    np.testing.assert_allclose(placed.box_to_picture(placed.box_to_screen((1, 2, 3, 4))), (1, 2, 3, 4), atol=1e-6)


def test_letterbox_and_resizing_equal_values_computed_by_hand():
    # 640 × 480 on a screen of 1680 × 1050 becomes 1400 × 1050, with an offset of 140 from the left.
    placed = Letterbox((1680, 1050), (640, 480))
    assert placed.box_to_screen((0, 0, 640, 480)) == (140, 0, 1540, 1050)
    # 480 × 640 becomes 787.5 × 1050.
    assert Letterbox((1680, 1050), (480, 640)).offset == (446.25, 0)
    larger = Fixations("a.jpg", "1", [[0.0, 23.0]], (32, 24), box=(0, 0, 32, 24)).resized((1680, 1050))
    assert larger.box == (0, 0, 1680, 1050)
    np.testing.assert_allclose(larger.points, [[25.75, 1027.625]])
    refused(r"^picture:", Letterbox, (1680, 1050), (0, 5))


@pytest.mark.shared
def test_boxes_of_cocosearch_mapped_to_pictures_match_those_of_coco(shared):
    """Nine pictures are in both data sets. Boxes of COCO do not depend on the screen, so they check the mapping."""
    sizes, boxes = {}, defaultdict(list)
    for name in ("eval300", "fit"):
        data = json.loads((shared / f"coco/annotations/instances_{name}.json").read_text())
        names = {image["id"]: image["file_name"] for image in data["images"]}
        classes = {each["id"]: each["name"] for each in data["categories"]}
        sizes |= {image["file_name"]: (image["width"], image["height"]) for image in data["images"]}
        for each in data["annotations"]:
            x, y, w, h = each["bbox"]
            boxes[names[each["image_id"]], classes[each["category_id"]]].append((x, y, x + w, y + h))
    seen: dict[str, Fixations] = {}
    for file in sorted((shared / "human/cocosearch18/human_scanpaths").glob("*.json")):
        found = read_ruarte(file, sizes=sizes)
        seen |= {each.picture: each for each in found}
        assert all(each.inside.mean() > 0.5 for each in found)
    assert len(seen) == 9
    for each in seen.values():
        candidates = np.array(boxes[each.picture, each.target])
        off = np.abs(candidates - each.box).max(1).min()
        # Boxes of one data set are rounded to pixels of a reduced picture, those of the other to screen pixels.
        assert off < 2.5, (each.picture, off)


@pytest.mark.shared
def test_target_boxes_in_cells_of_models_match_those_in_pixels_of_people(shared):
    folder = shared / "human/cocosearch18"
    people = {each.picture: each for each in read_ruarte(folder / "human_scanpaths/subj01_scanpaths.json")}
    models = read_ruarte(folder / "predicted/nnIBS.json", screen=(1680, 1050))
    cell = np.array([1680 / 32, 1050 / 24] * 2)
    shifted = [
        np.abs((np.array(each.box) - people[each.picture].box) / cell).max()
        for each in models
        if each.picture in people
    ]
    assert len(shifted) > 500
    assert max(shifted) <= 1 + 1e-6
    assert coco_name("100000298773.jpg") == "000000298773.jpg"


@given(sides, sides, st.floats(0.1, 5))
def test_a_picture_at_a_place_or_scale_keeps_its_corners_and_its_middle(across, down, scale):
    """The place of a picture in the middle is written by hand."""
    place = ((1600 - scale * across) / 2, (1200 - scale * down) / 2, scale * across, scale * down)
    x, y, width, height = place
    points = [[x - 0.5, y - 0.5], [799.5, 599.5], [x + width - 0.5, y + height - 0.5]]
    shown = Fixations("a.jpg", "1", points, (1600, 1200), box=(x, y, x + width, y + height))
    corners = [[-0.5, -0.5], [across / 2 - 0.5, down / 2 - 0.5], [across - 0.5, down - 0.5]]
    for back in (shown.in_picture((across, down), scale=scale), shown.in_picture((across, down), place=place)):
        np.testing.assert_allclose(back.points, corners, atol=1e-6 * max(across, down))
        assert back.box == pytest.approx((0, 0, across, down), abs=1e-6 * max(across, down))


def test_a_place_is_refused_by_name():
    shown = record()
    refused(r"^place: expected None beside scale", shown.in_picture, (80, 60), scale=1, place=(0, 0, 8, 6))
    refused(r"^place: expected \(x, y, width, height\)", shown.in_picture, (80, 60), place=(0, 0, 0, 6))
    refused(r"^scale: ", shown.in_picture, (80, 60), scale=0)


def test_trials_of_cocosearch_have_their_own_frame_and_flags(tmp_path):
    path = tmp_path / "trials.json"
    trial = {"name": "a.jpg", "X": [8, 9], "Y": [5, 6], "width": 512, "height": 320, "fixOnTarget": 1}
    path.write_text(json.dumps([trial, {**trial, "width": 640, "fixOnTarget": 0}]))
    assert [(each.size, each.found) for each in read_cocosearch(path)] == [((512, 320), True), ((640, 320), False)]
    unusable(
        r"\[1\] \(a.jpg\): expected \(512, 320\), which is given, got \(640", read_cocosearch, path, screen=(512, 320)
    )
    for change, said in (
        ({"height": None}, r"height: "),
        ({"fixOnTarget": "yes"}, r"fixOnTarget: expected true or false, got 'yes'"),
        ({"width": 512.5}, r"a width and a height in whole pixels"),
    ):
        path.write_text(json.dumps([{**trial, **change}]))
        unusable(said, read_cocosearch, path)
    del trial["height"]
    path.write_text(json.dumps([trial]))
    unusable(r"both a width and a height, or neither", read_cocosearch, path)


@pytest.mark.parametrize("header", ["duration_µs", "duration_μs", "duration us", "Duration [us]"])
def test_units_of_durations_are_read_in_any_spelling(tmp_path, header):
    """With both signs of micro, after a line, a space and in brackets."""
    path = tmp_path / "fixations.csv"
    path.write_text(f"picture,subject,x,y,width,height,{header}\na.jpg,1,40,30,80,60,250000\n", "utf-8")
    assert read_table(path)[0].durations.tolist() == [250.0]


def test_a_column_of_durations_that_is_not_read_is_named(tmp_path):
    path = tmp_path / "fixations.csv"
    path.write_text("picture,subject,x,y,width,height,fixation duration [ms]\na.jpg,1,40,30,80,60,250\n")
    with pytest.warns(UserWarning, match=r"the column 'fixation duration \[ms\]' is not read: name it"):
        assert read_table(path)[0].durations is None
