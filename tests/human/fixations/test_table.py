"""Tables of other programs: encodings, separators, names, units and origins, and what is refused or warned of."""

import numpy as np
import pandas
import pytest
import torch

from semfov.data.fixations import Fixations, read_cocosearch, read_fixations, read_table, write_table
from semfov.errors import DataError
from tests.refusals import refused, unusable

HEADER = "picture,subject,x,y,width,height"
LINES = ("a.jpg,1,399.5,299.5,800,600", "a.jpg,1,212.25,140,800,600", "b.jpg,1,12,14,800,600")
TABLE = "\n".join([HEADER, *LINES]) + "\n"
POINTS = [[[399.5, 299.5], [212.25, 140]], [[12, 14]]]


def points_of(records):
    return [each.points.tolist() for each in records]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32-be"])
@pytest.mark.parametrize("separator", [",", ";", "\t", "|"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_tables_of_spreadsheets(tmp_path, encoding, separator, end):
    """With a byte order mark, semicolons or tabs, and decimal commas where these do not separate."""
    text = TABLE.replace(",", separator).replace("\n", end)
    (tmp_path / "t.csv").write_bytes(text.encode(encoding))
    assert points_of(read_table(tmp_path / "t.csv")) == POINTS
    other = text.replace("a.jpg", "一.jpg").replace("picture", "一张照片")  # its first byte is 0 in some encodings
    (tmp_path / "t.csv").write_bytes(other.encode(encoding))
    records = read_table(tmp_path / "t.csv", columns={"picture": "一张照片"})
    assert (records[0].picture, points_of(records)) == ("一.jpg", POINTS)
    if separator != ",":
        (tmp_path / "t.csv").write_bytes(text.replace(".5", ",5").replace(".25", ",25").encode(encoding))
        records = read_table(tmp_path / "t.csv")
        assert points_of(records) == POINTS
        assert records[0].picture == "a.jpg"


def test_a_frame_other_names_and_a_size(tmp_path):
    frame = pandas.DataFrame({"image": ["a", "a"], "who": [1, 1], "X": [1.5, 2], "Y": [3, 4.5], "t": [None, None]})
    names = {"picture": "image", "subject": "who", "x": "X", "y": "Y", "duration": "t"}
    for size in ((80, 60), {"a": (80, 60)}):
        (record,) = read_table(frame, columns=names, size=size)
        assert (record.points.tolist(), record.size, record.subject) == ([[1.5, 3], [2, 4.5]], (80, 60), "1")
        assert record.durations is None
    frame.to_csv(tmp_path / "t.csv", index=False)
    assert points_of(read_table(tmp_path / "t.csv", columns=names, size=(80, 60))) == [[[1.5, 3], [2, 4.5]]]
    unusable(r"none named picture, subject among 'image', 'who', 'X', 'Y', 't'; name", read_table, frame, size=(80, 60))
    with pytest.raises(DataError, match="row 1, y: expected a number, got nothing"):
        read_table(frame.assign(Y=[1.0, np.nan]), columns=names, size=(80, 60))
    refused("size: expected a size of 'a'", read_table, frame, columns=names, size={"b": (8, 6)})
    refused("unknown column 'Y'", read_table, frame, columns={"Y": "y"})


SIDES = {"width": [80], "height": [60]}
EDGES = ("x1", "y1", "x2", "y2")


def row(**columns):
    """A table of one fixation with further columns, given by their names in the source."""
    return pandas.DataFrame({"picture": ["a"], "subject": ["1"], **columns})


def test_a_unit_that_is_given_counts_more_than_those_in_names():
    frame = row(**{"x [px]": [0.25], "y [px]": [0.5], **SIDES})
    for columns in (None, {"x": "x [px]", "y": "y [px]"}):
        (record,) = read_fixations(frame, columns=columns, units="fractions")
        assert record.points.tolist() == [[19.5, 29.5]]
    other = row(**{"x [norm]": [12.0], "y [mm]": [13.0], **SIDES})
    assert read_table(other, units="pixels")[0].points.tolist() == [[12, 13]]


def test_words_in_brackets_that_are_no_units_are_part_of_a_name():
    frame = row(**{"x (screen)": [12.0], "y (screen)": [13.0], "d (fixation)": [200], **SIDES})
    names = {"x": "x (screen)", "y": "y (screen)", "duration": "d (fixation)"}
    for units in (None, "pixels"):
        (record,) = read_fixations(frame, columns=names, units=units)
        assert (record.points.tolist(), record.durations.tolist()) == ([[12, 13]], [200])
    unusable(r"none named x, y among 'picture', 'subject', 'x \(screen\)'", read_table, frame)


def test_sides_and_boxes_in_other_units_than_pixels_are_no_pixels():
    frame = row(x=[12.0], y=[13.0], **{"width (cm)": [52], "height (cm)": [60]})
    sides = {"width": "width (cm)", "height": "height (cm)"}
    for columns, said in ((None, "none named width, height among"), (sides, r"got the columns 'width \(cm\)' and")):
        unusable(f"{said}.*give size=", read_table, frame, columns=columns)
        assert read_table(frame, columns=columns, size=(80, 60))[0].size == (80, 60)
    assert read_table(frame.rename(columns=lambda name: name.replace("cm", "px")))[0].size == (52, 60)
    boxed = row(x=[12.0], y=[13.0], **{f"{edge} (cm)": [5.0 + number] for number, edge in enumerate(EDGES)}, **SIDES)
    unusable(r"expected a box in pixels, as 'x', got the column 'x1 \(cm\)'", read_table, boxed)
    assert read_table(boxed.rename(columns=lambda name: name.replace("cm", "px")))[0].box == (5, 6, 7, 8)


def test_viewings_are_told_apart_by_their_trial(tmp_path):
    """Also where lines alternate; without a trial the lines of a scanpath follow each other."""
    path = tmp_path / "t.csv"
    rows = [("a,1,1,1,8,6,", 1), ("a,1,2,2,8,6,", 2), ("a,1,3,3,8,6,", 1), ("b,1,4,4,8,6,", 1)]
    path.write_text("\n".join([HEADER + ",trial", *(f"{row}{trial}" for row, trial in rows)]))
    assert points_of(read_table(path)) == [[[1, 1], [3, 3]], [[2, 2]], [[4, 4]]]
    again = Fixations("a", "1", np.ones((2, 2)), (8, 6)), Fixations("a", "1", np.zeros((1, 2)), (8, 6))
    write_table(path, again)
    assert points_of(read_table(path)) == [[[1, 1], [1, 1]], [[0, 0]]]
    path.write_text("\n".join([HEADER, "a,1,1,1,8,6", "a,2,1,1,8,6", "a,1,3,3,8,6"]))
    unusable(r"line 4: expected the lines of a scanpath to follow each other.* `trial`", read_table, path)


CORNERS = [[0.0, 0.0], [79.0, 0.0], [0.0, 59.0], [20.0, 10.0]]


@pytest.mark.parametrize(
    ("units", "origin", "given"),
    [
        ("pixels", "top left", CORNERS),
        ("pixels", "bottom left", [[0, 59], [79, 59], [0, 0], [20, 49]]),
        ("pixels", "centre", [[-39.5, -29.5], [39.5, -29.5], [-39.5, 29.5], [-19.5, -19.5]]),
        ("pixels", "centre, y up", [[-39.5, 29.5], [39.5, 29.5], [-39.5, -29.5], [-19.5, 19.5]]),
        ("fractions", "top left", np.array([[0.5, 0.5], [79.5, 0.5], [0.5, 59.5], [20.5, 10.5]]) / (80, 60)),
        ("fractions", "bottom left", np.array([[0.5, 59.5], [79.5, 59.5], [0.5, 0.5], [20.5, 49.5]]) / (80, 60)),
    ],
)  # fmt: skip
def test_units_and_origins(units, origin, given):
    """The corner pixels of a frame of 80 × 60, and the box of its first ten columns and five rows."""
    box = {
        "top left": (0, 0, 10, 5), "bottom left": (0, 55, 10, 60), "centre": (-40, -30, -30, -25),
        "centre, y up": (-40, 25, -30, 30),
    }[origin]  # fmt: skip
    scale = (80, 60, 80, 60) if units == "fractions" else (1, 1, 1, 1)
    frame = pandas.DataFrame(given, columns=["x", "y"]).assign(picture="a", subject="1")
    frame = frame.assign(**{name: n / s for name, n, s in zip(("x1", "y1", "x2", "y2"), box, scale, strict=True)})
    (record,) = read_table(frame, size=(80, 60), units=units, origin=origin)
    np.testing.assert_allclose(record.points, CORNERS, atol=1e-9)
    np.testing.assert_allclose(record.box, (0, 0, 10, 5), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"width": "nan"}, "line 2, width: expected a number, got 'nan'"),
        ({"width": "inf"}, "line 2, width: expected a number, got 'inf'"),
        ({"width": "800.5"}, "line 2, size: expected a width and a height in whole pixels"),
        ({"width": "-800"}, "line 2, size: expected a width"),
        ({"x": "inf"}, "line 2, x: expected a number, got 'inf'"),
        ({"duration": "-5"}, "line 2, durations: expected milliseconds, 0 or more"),
        (
            {"duration": "nan"},
            "line 2, duration: expected a number, as in other lines of the scanpath, got nothing; leave",
        ),
        ({"duration": ""}, "line 2, duration: expected a number, as in other lines"),
        ({"x1": "50"}, r"line 2, box: expected \(x1, y1, x2, y2\) with x1 <= x2"),
        ({"x1": ""}, "line 2: expected all of x1, y1, x2 and y2, or none"),
        ({"x1": "1", "second": "2"}, "line 3, x1: expected '1', as in line 2, got '2'"),
        ({"found": "maybe"}, "line 2, found: expected true, false or nothing"),
    ],
)
def test_what_is_not_a_fixation_is_named(tmp_path, change, said):
    fields = {"picture": "a", "subject": "1", "x": "4", "y": "5", "width": "800", "height": "600"}
    fields |= {"duration": "100", "x1": "10", "y1": "10", "x2": "20", "y2": "20", "found": "true"}
    second = change.pop("second", None)
    first = {**fields, **change}
    other = {**first, "duration": "100", "x": "6"} | ({} if second is None else {"x1": second})
    path = tmp_path / "t.csv"
    path.write_text("\n".join(",".join(each) for each in (fields, first.values(), other.values())))
    unusable(said, read_table, path)


def test_a_line_of_more_fields_is_named(tmp_path):
    (tmp_path / "t.csv").write_text(f"{HEADER}\na,1,399,5,299,5,800,600\n")
    unusable("line 2: expected 6 fields, got more", read_table, tmp_path / "t.csv")


def look(points, size=(1680, 1050)):
    frame = pandas.DataFrame(points, columns=["x", "y"]).assign(picture="a", subject="1")
    return read_table(frame, size=size)


DRAW = np.random.default_rng(0).random((40, 2))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (DRAW, r"look like fractions of the sides \(units='fractions'\)"),
        ((DRAW - 0.5) * (1600, 1000), r"look like pixels from the centre \(origin='centre'"),
        ((DRAW * (1680, 1050))[:, ::-1], r"look like y before x"),
        (DRAW * (512, 320), r"look like fixations of a frame of 5\d\d × 3\d\d or little more"),
    ],
    ids=["fractions", "centred", "swapped", "smaller frame"],
)
def test_coordinates_of_another_frame_are_warned_of(points, said):
    with pytest.warns(UserWarning, match=said):
        look(points)


@pytest.mark.parametrize("noise", [0, 30])
def test_fixations_of_their_frame_are_read_without_a_word(noise):
    look(DRAW * (1680, 1050) + noise * (DRAW[::-1] - 0.5))
    look(0.2 + 0.3 * DRAW[:3] * (1680, 1050))


def test_other_readers_warn_too(tmp_path):
    x, y = (DRAW * (512, 320)).T.tolist()
    (tmp_path / "s.json").write_text(f'[{{"name": "a.jpg", "X": {x}, "Y": {y}}}]')
    with pytest.warns(UserWarning, match="look like fixations of a frame"):
        read_cocosearch(tmp_path / "s.json")
    assert len(read_cocosearch(tmp_path / "s.json", screen=(512, 320))) == 1


HEAD, ROWS = "picture,subject,x,y,width,height", "a.jpg,1,40,30,80,60\na.jpg,1,50.5,20,80,60\n"


@pytest.mark.parametrize(
    "text",
    [
        f"\n\n{HEAD}\n{ROWS}",
        f"# by hand\n{HEAD}\n{ROWS}",
        f"sep=;\n{HEAD}\n{ROWS}".replace(",", ";"),
        f"{HEAD.title()}\n{ROWS}",
    ],
)
def test_what_spreadsheets_write_before_a_table_and_capitals_are_understood(tmp_path, text):
    (tmp_path / "a.csv").write_text(text)
    assert read_table(tmp_path / "a.csv")[0].points.tolist() == [[40, 30], [50.5, 20]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{HEAD},x\n{ROWS}", "several named x"),
        (f"{HEAD}\n{ROWS}".replace("40", "1e9"), "line 2, x: expected a number up to 1e"),
        (f"{HEAD}\n{ROWS}".replace("a.jpg", ""), "line 2, picture: expected the name of a picture"),
        (f"{HEAD}\n{ROWS}".replace("a.jpg", "\x81.jpg"), "expected a file of text, got other bytes; save it as UTF-8"),
        (f"{HEAD}\n{ROWS}".replace("a.jpg", "ä\0.jpg"), "expected a file of text, got other bytes; save it as UTF-8"),
    ],
)
def test_tables_that_say_too_much_or_too_little_are_refused(tmp_path, text, said):
    (tmp_path / "a.csv").write_text(text, encoding="latin-1")
    unusable(said, read_table, tmp_path / "a.csv")


def test_a_table_of_one_picture_or_person_need_not_name_them(tmp_path):
    """So that the remedies of the messages can be followed, one after the other."""
    path = tmp_path / "a.csv"
    path.write_text("x,y,duration\n40,30,200\n50.5,20,100\n")
    said = r"none named picture, subject, width, height among .* or give picture=, subject=, size=$"
    unusable(said, read_fixations, path)
    given = {"size": (80, 60), "picture": "a.jpg"}
    unusable(
        r"expected the columns subject, x, y, got none named subject .* or give subject=$",
        read_fixations,
        path,
        **given,
    )
    (record,) = read_fixations(path, subject="ann", **given)
    assert (record.picture, record.subject, record.points.tolist()) == ("a.jpg", "ann", [[40, 30], [50.5, 20]])
    path.write_text("Look X,Look Y\n40,30\n50.5,20\n")
    (record,) = read_fixations(path, subject="ann", columns={"x": "Look X", "y": "Look Y"}, **given)
    assert record.points.tolist() == [[40, 30], [50.5, 20]]


def test_a_picture_that_is_given_is_not_laid_over_several(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text(TABLE)
    said = "at most one name of a picture beside picture=, got 2 of them, such as a.jpg, b.jpg; leave picture= out"
    unusable(said, read_fixations, path, picture="c.jpg")
    path.write_text(TABLE.replace("b.jpg", "a.jpg"))
    assert {(record.picture, record.subject) for record in read_fixations(path, picture="c.jpg", subject="7")} == {
        ("c.jpg", "7")
    }


def test_names_in_the_encoding_of_windows_are_read_and_said(tmp_path):
    path = tmp_path / "a.csv"
    table = f"{HEAD.replace('duration', 'duration [µs]')}\n{ROWS}"
    path.write_bytes(table.replace("a.jpg", "café 1.jpg").encode("cp1252"))
    said = r"a\.csv: is not UTF-8, so names are read as .* \(cp1252\), such as 'café 1\.jpg'; .* save the file as UTF-8"
    with pytest.warns(UserWarning, match=said):
        records = read_fixations(path)
    assert {record.picture for record in records} == {"café 1.jpg"}
    for encoding in ("utf-8", "utf-8-sig", "utf-16"):
        path.write_bytes(table.replace("a.jpg", "café 1.jpg").encode(encoding))
        assert [record.picture for record in read_fixations(path)] == [record.picture for record in records]
    # A sign of a unit is no name: the letters of this table are certain.
    path.write_bytes(table.encode("cp1252"))
    assert {record.picture for record in read_fixations(path)} == {"a.jpg"}


@pytest.mark.parametrize("kind", ["xlsx", "xls", "parquet", "mat", "csv.gz", "edf"])
def test_files_that_are_no_text_are_refused_with_their_reader(tmp_path, kind):
    (tmp_path / f"a.{kind}").write_bytes(b"PK\3\4")
    with pytest.raises(DataError, match=rf"a table of text, such as .csv, got .{kind.rpartition('.')[2]}; \w+ "):
        read_fixations(tmp_path / f"a.{kind}")


@pytest.mark.parametrize(
    ("name", "kind"), [("kitchen.JPG", "picture"), ("scene.mp4", "video"), ("renamed.csv", "picture")]
)
def test_pictures_and_videos_are_refused_as_such(tmp_path, name, kind):
    (tmp_path / name).write_bytes(b"\xff\xd8\xff")
    unusable(rf"expected a table of fixations \(.*\), got a {kind}$", read_fixations, tmp_path / name)


def test_tables_of_other_types_and_numbers_of_python_are_refused(tmp_path):
    for source in ({"picture": ["a.jpg"]}, [{"x": 1}]):
        refused(r"source: expected a file, or a pandas.DataFrame .*, got a (dict|list)", read_fixations, source)
    (tmp_path / "t.csv").write_text(TABLE.replace("399.5", "39_9"))
    unusable("line 2, x: expected a number, got '39_9'", read_fixations, tmp_path / "t.csv")


def test_people_of_a_column_of_floats_have_whole_numbers():
    fixed = {"x": 1, "y": 2, "width": 80, "height": 60}
    people = pandas.DataFrame({"picture": ["a", "b"], "subject": [7.0, None], **fixed})
    assert [each.subject for each in read_table(people)] == ["7", ""]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"columns": ["picture"]}, "^columns: expected names of the source by ours"),
        ({"columns": {"x": 2}}, "^columns: expected names of the source by ours"),
        ({"size": "80x60"}, r"^size: expected \(width, height\)"),
        ({"size": 80}, r"^size: expected \(width, height\)"),
        ({"units": "feet"}, "^unknown unit 'feet'; known: pixels, fractions"),
        ({"sizes": {}}, "^sizes: expected an option of read_table, .* did you mean size="),
        (
            {"eye": "left"},
            "^eye: expected an option of read_table, .* known: columns, size, picture, subject, units, orig",
        ),
    ],
)
def test_arguments_of_other_kinds_are_refused_by_name(tmp_path, given, said):
    (tmp_path / "t.csv").write_text(TABLE)
    refused(said, read_fixations, tmp_path / "t.csv", **given)


def test_columns_of_one_name_are_refused_in_files_and_frames(tmp_path):
    frame = pandas.DataFrame([["a", 1, 1, 9, 2]], columns=["picture", "subject", "x", "x", "y"])
    frame.to_csv(tmp_path / "t.csv", index=False)
    for source in (frame, tmp_path / "t.csv"):
        unusable("expected one column of a name, got several named x", read_table, source, size=(80, 60))


def test_a_record_takes_lists_and_tensors_and_refuses_what_is_no_size():
    halves = torch.tensor([[1, 2.5]], dtype=torch.bfloat16)
    for points in ([[1, 2.5]], torch.tensor([[1, 2.5]]), ((1, 2.5),), halves):
        assert Fixations("a.jpg", "1", points, (80, 60), [200]).resized((160, 120)).points.tolist() == [[2.5, 5.5]]
    for given, said in (
        (([["a", "b"]], (80, 60)), "points: expected real numbers in rows of one length, got list"),
        (([[1, 10**400]], (80, 60)), "points: expected finite numbers, got one that is larger than any float"),
        (([1, 2], (80, 60)), r"points: expected \(n, 2\)"),
        (([[1, 2]], "80x60"), "size: expected a width and a height above 0, got 80x60"),
        (([[1, 2]], (80, float("nan"))), "size: expected a width and a height above 0"),
    ):
        refused(said, Fixations, "a.jpg", "1", *given)


def test_frames_of_other_libraries_are_refused_with_the_call_that_converts_them():
    class Frame:
        columns = ("picture", "x")

    refused(r"expected a file, or a pandas.DataFrame \(.*source\.to_pandas\(\) of Polars", read_fixations, Frame())
