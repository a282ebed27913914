"""Fixations as a plain table (CSV) with a line for each fixation, which any program can write."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from semfov.data.fixations.record import Fixations, ObjectBox, warn_outside
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular, write_text

_COLUMNS = ("picture", "subject", "x", "y", "width", "height")
"""Columns that a table must have."""
_MORE = ("target", "duration", "x1", "y1", "x2", "y2", "found")
"""Further columns that a table may have; their fields may be empty."""


def read_table(path: str | PathLike[str]) -> list[Fixations]:
    r"""Read fixations from a table.

    The first line holds the names of the columns: `picture`, `subject`, `x`, `y`, `width` and `height`, and perhaps
    `target`, `duration`, `x1`, `y1`, `x2`, `y2` and `found`, whose fields may be empty. The lines of one scanpath
    follow each other in order, and a new scanpath begins where picture, subject or target change. `x` and `y` are in
    pixels of a frame of `width` × `height`, pixel centres at integers. `duration` is in milliseconds. `x1`, `y1`, `x2`
    and `y2` are the target's box. `found` is `true` or `false`. pandas writes such a table by
    `frame.to_csv(path, index=False)`.

    Args:
        path: the file.

    Returns:
        One record for each scanpath.

    Raises:
        DataError: the content does not have this form; the message names the file, the line and the column.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "fixations.csv")
    ...     text = "picture,subject,x,y,width,height\na.jpg,1,40,30,80,60\na.jpg,1,52.5,31,80,60"
    ...     _ = path.write_text(text)
    ...     read_table(path)[0].points.tolist()
    [[40.0, 30.0], [52.5, 31.0]]
    """
    path = Path(path)
    check_regular(path)
    try:
        lines = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"), newline=""), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as a table ({error}); correct or replace the file") from None
    missing = [name for name in _COLUMNS if lines and name not in lines[0]]
    if missing:
        raise DataError(f"{path}: expected the columns {', '.join(_COLUMNS)}, got none named {', '.join(missing)}")
    groups: list[list[tuple[int, Mapping[str, str]]]] = []
    previous = None
    for number, line in enumerate(lines, start=2):
        who = line["picture"], line["subject"], line.get("target")
        if who != previous:
            groups.append([])
        groups[-1].append((number, line))
        previous = who
    return warn_outside(path, [_record(path, group) for group in groups])


def write_table(path: str | PathLike[str], fixations: Iterable[Fixations]) -> None:
    """Write fixations as a table that `read_table` reads.

    Args:
        path: the file.
        fixations: the records.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "fixations.csv")
    ...     write_table(path, [Fixations("a.jpg", "1", np.array([[40.0, 30.0]]), (80, 60), target="cup")])
    ...     print(path.read_text().splitlines()[1])
    a.jpg,1,40.0,30.0,80,60,cup,,,,,,
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([*_COLUMNS, *_MORE])
    for each in fixations:
        times = [""] * len(each) if each.durations is None else each.durations.tolist()
        box = [""] * 4 if each.box is None else each.box
        found = "" if each.found is None else str(each.found).lower()
        for (x, y), time in zip(each.points.tolist(), times, strict=True):
            rows.writerow([each.picture, each.subject, x, y, *each.size, each.target or "", time, *box, found])
    write_text(Path(path), text.getvalue())


def _record(path: Path, group: list[tuple[int, Mapping[str, str]]]) -> Fixations:
    first, line = group[0]
    points = np.array([[_number(path, at, row, name) for name in ("x", "y")] for at, row in group])
    times = [_maybe(path, at, row, "duration") for at, row in group]
    edges = [_maybe(path, first, line, name) for name in ("x1", "y1", "x2", "y2")]
    box: ObjectBox | None = None
    if all(edge is not None for edge in edges):
        x1, y1, x2, y2 = (float(edge) for edge in edges if edge is not None)
        box = x1, y1, x2, y2
    words = {"true": True, "false": False, "": None}
    found = (line.get("found") or "").lower()
    if found not in words:
        raise DataError(f"{path}: line {first}, found: expected true, false or nothing, got {found!r}")
    timed = None not in times
    try:
        return Fixations(
            picture=line["picture"],
            subject=line["subject"],
            points=points,
            size=(int(_number(path, first, line, "width")), int(_number(path, first, line, "height"))),
            durations=np.array(times, dtype=np.float64) if timed else None,
            target=line.get("target") or None,
            box=box,
            found=words[found],
        )
    except InputError as error:
        raise DataError(f"{path}: line {first}, {error}") from None


def _number(path: Path, at: int, line: Mapping[str, str], name: str) -> float:
    value = _maybe(path, at, line, name)
    if value is None:
        raise DataError(f"{path}: line {at}, {name}: expected a number, got nothing")
    return value


def _maybe(path: Path, at: int, line: Mapping[str, str], name: str) -> float | None:
    text = line.get(name)
    if not text:
        return None
    try:
        return float(text)
    except ValueError:
        raise DataError(f"{path}: line {at}, {name}: expected a number, got {text[:40]!r}") from None
