"""Context from tables: values and class names against loops, and unreadable files."""

import csv
import hashlib
import math

import pytest
import torch

from semfov.belief import ContextPrior, context_table
from semfov.belief.context_table import read_named_table
from semfov.errors import DataError, InputError

CLASSES = ("cup", "dining table", "cow", "zebra")
TABLE = ",mug,desk,cow\nglass,,2,0\ncup,,1,0.5\ntable,3,,-1\ncattle,0,0,\n"


def write_table(path, rows, columns, values):
    """Write a table as CSV; NaN becomes an empty cell."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["", *columns])
        for name, line in zip(rows, values.tolist(), strict=True):
            writer.writerow([name, *("" if math.isnan(value) else f"{value:.6g}" for value in line)])


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "table.csv"
    file.write_text(TABLE, encoding="utf-8")
    return file


def test_values_are_relative_to_the_means_of_their_row_and_column(path):
    prior = ContextPrior.from_table(path, CLASSES, source="a test", edges=(0.0, 0.2))
    # The row `cup` is the class itself, so its synonym `glass` is not used; `desk` and `mug` are synonyms of classes.
    values = {(1, 2): 1.0, (1, 3): 0.5, (2, 1): 3.0, (2, 3): -1.0, (3, 1): 0.0, (3, 2): 0.0}
    rows = {t: [v for (a, _), v in values.items() if a == t] for t in (1, 2, 3)}
    columns = {j: [v for (_, b), v in values.items() if b == j] for j in (1, 2, 3)}
    every = sum(values.values()) / 6
    for t in range(5):
        for j in range(5):
            expected = 0.0
            if (t, j) in values:
                expected = values[t, j] - sum(rows[t]) / 2 - sum(columns[j]) / 2 + every
            got = prior.cooccurrence[t, j]
            torch.testing.assert_close(got, expected * torch.tensor([1.0, 0.0, -1.0]))
    assert not prior.place.any()
    assert prior.weights == {"evidence": (0.1, 0.2), "map": (0.1, 0.2)}
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert prior.metadata == {"table": {"source": "a test", "sha256": digest, "missing": ["zebra"]}}


def test_columns_of_the_table_of_places_become_rows_of_the_picture(path, tmp_path):
    heights = tmp_path / "heights.csv"
    heights.write_text("class,top,middle,bottom\ncow,0,1,5\nCUP,2,,\n", encoding="utf-8")
    prior = ContextPrior.from_table(path, CLASSES, source="a test", places=heights)
    assert prior.place.shape == (5, 3, 3)
    torch.testing.assert_close(prior.place[3], torch.tensor([-2.0, -1, 3])[:, None].expand(3, 3))
    assert not prior.place[[0, 1, 2, 4]].any()
    assert prior.metadata["table"]["places_sha256"] == hashlib.sha256(heights.read_bytes()).hexdigest()


def test_a_written_table_is_read_back_unchanged(tmp_path):
    names, values = ["cup", 'a "b", c', "two\r\nlines"], torch.tensor([[math.nan, 0.125], [-3.5, 7.0], [1000, -1000]])
    values = torch.cat([values, values[:, :1]], 1)
    write_table(tmp_path / "t.csv", names, names, values)
    table = read_named_table(tmp_path / "t.csv")
    assert (table.rows, table.columns) == (tuple(names), tuple(names))
    torch.testing.assert_close(table.values, values, equal_nan=True)


def test_checksum_and_source_are_checked(path):
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    ContextPrior.from_table(path, CLASSES, source="s", sha256=digest.upper())
    with pytest.raises(DataError, match="download it again"):
        ContextPrior.from_table(path, CLASSES, source="s", sha256="0" * 64)
    with pytest.raises(InputError, match="source"):
        ContextPrior.from_table(path, CLASSES, source=" ")
    with pytest.raises(InputError, match="spoon"):
        ContextPrior.from_table(path, ["spoon", "zebra"], source="s")
    with pytest.raises(DataError, match="missing"):
        ContextPrior.from_table(path.parent / "missing.csv", CLASSES, source="s")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "names in the first row"),
        (",cup\n", "names in the first row"),
        (",cup,cow\ncup,1\n", "line 2: expected 2 values"),
        (",cup\ncup,much\n", "line 2: expected numbers"),
        (",cup\ncup,inf\n", "line 2: expected numbers"),
        (",cup\ncup,nan\n", "line 2: expected numbers"),
        (",cup,cup\ncow,1,2\n", "first row, got cup"),
        (",cup\n,2\n", "no name"),
        (",cup\ncup,1\ncup,2\n", "first column, got cup"),
    ],
)
def test_errors_in_a_table_name_the_line(path, text, message):
    path.write_text(text)
    with pytest.raises(DataError, match=message):
        read_named_table(path)
    path.write_bytes(b"\xff\xfe,cup\n")
    with pytest.raises(DataError, match="CSV"):
        read_named_table(path)


def test_a_byte_order_mark_is_not_part_of_the_first_cell(path):
    path.write_text('\ufeff"of, with",cup\ncow,2\n', encoding="utf-8")
    table = read_named_table(path)
    assert (table.rows, table.columns, table.values.tolist()) == (("cow",), ("cup",), [[2.0]])


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 3), (4, 3), (3, 4)])
def test_the_number_of_names_is_limited(path, monkeypatch, rows, columns):
    monkeypatch.setattr(context_table, "_MOST", 3)
    names = [f"thing {index}" for index in range(4)]
    write_table(path, names[:rows], names[:columns], torch.zeros(rows, columns))
    if max(rows, columns) <= 3:
        assert read_named_table(path).values.shape == (rows, columns)
    else:
        with pytest.raises(DataError, match="expected 1 to 3 names"):
            read_named_table(path)


@pytest.mark.parametrize(
    ("edges", "profile"), [((), [1.0]), ((0.1,), [1.0, -1.0]), ((0.0, 0.1, 0.2), [1, 1 / 3, -1 / 3, -1])]
)
def test_cooccurrence_falls_from_the_nearest_band_to_the_farthest(path, edges, profile):
    near = ContextPrior.from_table(path, CLASSES, source="s", edges=(0.0, 0.2)).cooccurrence[..., 0]
    got = ContextPrior.from_table(path, CLASSES, source="s", edges=edges).cooccurrence
    torch.testing.assert_close(got, near[..., None] * torch.tensor(profile))


def test_a_class_in_any_row_or_column_of_the_table_is_known(path):
    path.write_text(",cow\ncup,1\n", encoding="utf-8")
    prior = ContextPrior.from_table(path, CLASSES, source="s")
    assert prior.metadata["table"]["missing"] == ["dining table", "zebra"]
    with pytest.raises(InputError, match=r"in the table \(cup, …\), got spoon, zebra, …"):
        ContextPrior.from_table(path, ["spoon", "zebra"], source="s")
    path.write_text(",cow\n" + "".join(f"thing {letter},1\n" for letter in "abcdef"), encoding="utf-8")
    with pytest.raises(InputError, match=r"in the table \(thing a, thing b, thing c, thing d, thing e, …\)"):
        ContextPrior.from_table(path, ["spoon", "zebra"], source="s")


def test_places_are_relative_to_the_mean_of_each_class(path, tmp_path):
    heights = tmp_path / "heights.csv"
    heights.write_text("class,top,bottom\ncow,0,4\ncup,30,10\n", encoding="utf-8")
    prior = ContextPrior.from_table(path, CLASSES, source="a test", places=heights)
    assert prior.place[[1, 3], :, 0].tolist() == [[10, -10], [-2, 2]]


def test_the_default_prior_is_that_of_coco():
    assert ContextPrior.from_pretrained().digest() == ContextPrior.from_pretrained("coco").digest()
