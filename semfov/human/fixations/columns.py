"""The columns and rows of tables, in files of text and in data frames."""

import csv
import io
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple, Protocol

from semfov.data.picture_files import PHOTOGRAPHS, VIDEOS
from semfov.errors import DataError, check, check_data, type_of
from semfov.human.fixations.encodings import read_recording
from semfov.human.fixations.smi import Events, has_events
from semfov.io.files import reading

_MISSING = ("None", "nan", "<NA>", "NaT")  # of pandas

_PREAMBLE = re.compile(r"(\s*\n|#[^\n]*\n|\"?sep=.\"?\s*\n)+", re.IGNORECASE)
"""What may come before the names of the columns: empty lines, remarks, and the separator that a spreadsheet notes."""

_DECIMAL = re.compile(r"[+-]*(?=.*\d)\d*,[\deE-]*")  # a number with a decimal comma

_REMEDIES = {
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "save it as CSV, or give pandas.read_excel(file)"),
    **dict.fromkeys((".gz", ".zip", ".bz2", ".xz"), "unpack it, or give pandas.read_csv(file)"),
    ".parquet": "give pandas.read_parquet(file)",
    ".mat": "give a table of what scipy.io.loadmat(file) reads",
    ".edf": "convert it to .asc (edf2asc of the EyeLink Developers Kit)",
}
"""What to do with files that are no text, by their ends."""

_PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\0", b"MM\0*", b"RIFF")
"""First bytes of pictures, whatever the names of their files say."""

_SPREADSHEETS = (b"\xd0\xcf\x11\xe0", b"PK\x03\x04")
"""First bytes of spreadsheets, which a file `.xls` may be; EyeLink Data Viewer saves texts under that end."""

LOST = ("", ".", "-", "nan", "none", "null", "na", "undefined", "undefinednull")
"""Fields that hold nothing, in lower case."""

_LARGEST = 1e6  # largest coordinate and side in pixels


class DataFrame(Protocol):
    """Protocol of the parts of a `pandas.DataFrame` that are read."""

    @property
    def columns(self) -> Iterable[object]: ...

    def itertuples(self, index: bool, name: str | None) -> Iterable[tuple[object, ...]]: ...


class Row(NamedTuple):
    """A row of a table, with its number for error messages.

    Attributes:
        table: name of the table, for messages.
        place: of the row in it, in words, such as `line 3`.
        fields: by the names of the columns.
    """

    table: str
    place: str
    fields: dict[str, str]

    def __str__(self) -> str:
        """Name the row in a message."""
        return f"{self.table}: {self.place}"

    def number(self, name: str) -> float:
        """Read a field as a number; raises `DataError` if it is empty, or too large for a coordinate."""
        value = self.number_or_none(name)
        if value is None:
            raise DataError(f"{self}, {name}: expected a number, got nothing")
        if abs(value) > _LARGEST:
            raise DataError(f"{self}, {name}: expected a number up to {_LARGEST:g}, got {value:g}")
        return value

    def number_or_none(self, name: str) -> float | None:
        """Read a field as a number, or return None if the field is empty or missing."""
        text = self.fields.get(name)
        if not text:
            return None
        try:
            value = float(text.replace("_", "?"))  # which Python takes for a part of a number
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            remedy = "; write decimal points" if _DECIMAL.fullmatch(text) else ""
            raise DataError(f"{self}, {name}: expected a number, got {text[:40]!r}{remedy}")
        return value


class Table(NamedTuple):
    """A table.

    Attributes:
        name: for messages.
        columns: their names.
        rows: of fields by these names.
        repeated: names of several columns, of which the rows have the last one.
        encoding: of the file.
    """

    name: str
    columns: list[str]
    rows: list[Row]
    repeated: frozenset[str] = frozenset()
    encoding: str = "utf-8"

    @classmethod
    def of(
        cls, name: str, columns: list[str], lines: Iterable[tuple[str, Sequence[str]]], encoding: str = "utf-8"
    ) -> "Table":
        """Make a table from lines of text.

        Args:
            name: for messages.
            columns: their names.
            lines: the place of each in words, such as `line 3`, and a text for each column.
            encoding: of the file.

        Returns:
            The table.
        """
        rows = [Row(name, place, dict(zip(columns, texts, strict=True))) for place, texts in lines]
        repeated = frozenset(column for column, count in Counter(columns).items() if count > 1)
        return cls(name, columns, rows, repeated, encoding)

    def check_different(self, columns: Iterable[str | None]) -> None:
        """Raise `DataError` if several columns have the name of a column that is to be read."""
        repeated = sorted(self.repeated.intersection(columns))
        check_data(not repeated, self.name, "one column of a name", f"several named {', '.join(repeated)}")


def table_of(source: str | PathLike[str] | DataFrame) -> Table:
    """Read a table.

    Args:
        source: a file, or a `pandas.DataFrame`.

    Returns:
        The table; missing values are empty, and numbers have decimal points.

    Raises:
        InputError: it is neither.
        DataError: the file is no table of text.
    """
    if isinstance(source, str | PathLike):
        return _table_of_file(Path(source), str(source))
    is_frame = hasattr(source, "itertuples") and hasattr(source, "columns")
    expected = (
        "a file, or a pandas.DataFrame (pandas.DataFrame(source) makes one of lists, source.to_pandas() of Polars)"
    )
    check(is_frame, "source", expected, type_of(source))
    return _table_of_frame(source)


def _table_of_frame(frame: DataFrame) -> Table:
    """Make a table of a data frame, which has no name of its own."""
    lines = []
    for number, values in enumerate(frame.itertuples(index=False, name=None)):
        lines.append((f"row {number}", [*map(_text_of, values)]))
    return Table.of("the table", [*map(str, frame.columns)], lines)


def _text_of(value: object) -> str:
    """Write a value of a data frame as a file would have it."""
    # A column of whole numbers in which one is missing is one of floats.
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    text = str(value)
    return "" if text in _MISSING else text


def _table_of_file(path: Path, name: str) -> Table:
    """Read a table from a file of text, whose first line has the names of the columns.

    Args:
        path: the file.
        name: name of the table, for messages.

    Returns:
        The table.
    """
    _check_text_file(path)
    text, encoding = read_recording(path)
    if has_events(text):
        events = Events.of(text, name)
        fixations = [(place, _texts(line, events.separator)) for place, line in events.fixations]
        return Table.of(name, events.columns, fixations, encoding)
    preamble = _PREAMBLE.match(text)
    if preamble is not None:
        text = text[preamble.end() :]
    # The separator is what the names of the columns have most of.
    first_line = text.partition("\n")[0]
    separator = max(",;\t|", key=first_line.count)
    columns, lines = _columns_and_lines(path, text, separator)
    return Table.of(name, columns, lines, encoding)


def _columns_and_lines(path: Path, text: str, separator: str) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Split a text at its separator.

    Args:
        path: the file, for messages.
        text: its content, from the names of the columns on.
        separator: of the fields in a line.

    Returns:
        The names of the columns, and of each line that is not empty its place in words and a text for each column.
    """
    try:
        reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        columns = [column.strip() for column in next(reader, [])]
        lines = [(f"line {reader.line_num}", line) for line in reader if any(line)]
    except csv.Error as error:
        raise DataError(f"{path}: cannot be read as a table ({error}); correct or replace the file") from None
    filled = []
    for place, line in lines:
        left_out = len(columns) - len(line)  # a line may end early
        if left_out < 0:
            raise DataError(f"{path}: {place}: expected {len(columns)} fields, got more; quote them with {separator!r}")
        filled.append((place, _texts([*line, *[""] * left_out], separator)))
    return columns, filled


def _texts(fields: Iterable[str], separator: str) -> list[str]:
    """Strip the fields of a line, and make decimal commas points where commas do not separate fields."""
    texts = [field.strip() for field in fields]
    if separator == ",":
        return texts
    return [text.replace(",", ".") if _DECIMAL.fullmatch(text) else text for text in texts]


def _check_text_file(path: Path) -> None:
    """Raise `DataError` for a file that is no table of text, with what to do with it."""
    kind = path.suffix.lower()
    with reading(path), path.open("rb") as file:
        beginning = file.read(4)
    is_picture = kind in PHOTOGRAPHS or beginning.startswith(_PICTURES)
    is_text = kind not in _REMEDIES or (kind == ".xls" and beginning not in _SPREADSHEETS)
    check_data(is_text, path, "a table of text, such as .csv", f"{kind}; {_REMEDIES.get(kind)}")
    expected = "a table of fixations (.csv, .tsv, .json, .asc, …)"
    check_data(kind not in VIDEOS, path, expected, "a video")
    check_data(not is_picture, path, expected, "a picture")
