"""The columns and lines of tables, in files of text and in data frames."""

import csv
import io
import re
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.sources import PHOTOGRAPHS, VIDEOS
from semfov.errors import DataError, check, check_data
from semfov.io.files import read_text, reading

_MISSING = ("None", "nan", "<NA>", "NaT")  # of pandas

_BEFORE = re.compile(r"(\s*\n|#[^\n]*\n|\"?sep=.\"?\s*\n)+", re.IGNORECASE)
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


def of_source(source: Any) -> tuple[str, list[str], list[tuple[str, dict[str, str]]]]:
    """The name of a file or of a `pandas.DataFrame`, the names of its columns, and its lines."""
    frame = hasattr(source, "to_dict") and hasattr(source, "columns")
    expected = "a file, or a pandas.DataFrame (pandas.DataFrame(source) makes one of lists)"
    check(frame or isinstance(source, str | PathLike), "source", expected, f"a {type(source).__name__}")
    if not frame:
        return str(source), *_of_file(Path(source))
    header = [str(name) for name in source.columns]
    _check_different("the table", header)
    rows = []
    for number, row in enumerate(source.itertuples(index=False, name=None)):
        # A column of whole numbers in which one is missing is one of floats.
        plain = [int(each) if isinstance(each, float) and each.is_integer() else each for each in row]
        texts = ["" if str(value) in _MISSING else str(value) for value in plain]  # missing values are empty
        rows.append((f"row {number}", dict(zip(header, texts, strict=True))))
    return "the table", header, rows


_PICTURES = (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\0", b"MM\0*", b"RIFF")
"""First bytes of pictures, whatever the names of their files say."""


def _of_file(path: Path) -> tuple[list[str], list[tuple[str, dict[str, str]]]]:
    """Names of the columns of a file, and its lines; decimal commas become points."""
    kind = path.suffix.lower()
    with reading(path), path.open("rb") as file:
        drawn = kind in PHOTOGRAPHS or file.read(4).startswith(_PICTURES)
    check_data(kind not in _REMEDIES, path, "a table of text, such as .csv", f"{kind}; {_REMEDIES.get(kind)}")
    got = "a video" if kind in VIDEOS else "a picture"
    check_data(not drawn and kind not in VIDEOS, path, "a table of fixations (.csv, .tsv, .json, .asc, …)", got)
    text = read_text(path)
    before = _BEFORE.match(text)
    text = text[before.end() :] if before else text
    separator = max(",;\t|", key=text.partition("\n")[0].count)
    try:
        table = csv.DictReader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
        lines = [(f"line {table.line_num}", line) for line in table]
    except csv.Error as error:
        raise DataError(f"{path}: cannot be read as a table ({error}); correct or replace the file") from None
    header = [(name or "").strip() for name in table.fieldnames or ()]
    _check_different(str(path), header)
    rows = []
    for place, line in lines:
        if None in line:
            raise DataError(f"{path}: {place}: expected {len(header)} fields, got more; quote them with {separator!r}")
        values = [(value or "").strip() for value in line.values()]
        if separator != ",":
            values = [value.replace(",", ".") if _DECIMAL.fullmatch(value) else value for value in values]
        rows.append((place, dict(zip(header, values, strict=True))))
    return header, rows


def _check_different(where: str, header: Sequence[str]) -> None:
    again = sorted({name for name in header if header.count(name) > 1 and name})
    check_data(not again, where, "columns of different names", f"several named {', '.join(again)}")
