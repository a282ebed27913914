"""Fixations as a plain table (CSV): a line for each fixation, which any program can write."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path

import numpy as np

from semfov.data.fixations.record import Box, Fixations
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular, write_text

COLUMNS = ("picture", "subject", "x", "y", "width", "height")
"""Columns that a table must have."""
MORE = ("target", "duration", "x1", "y1", "x2", "y2", "found")
"""Columns that it may have besides, after those; fields may be empty."""


def read_table(path: str | PathLike[str]) -> list[Fixations]:
    """Fixations from a table with a line of column names; lines of one scanpath follow each other in order.

    `x` and `y` are pixels of a frame of `width` × `height`, pixel centres at integers; `duration` is in milliseconds;
    `x1` to `y2` are the target's box and `found` is true or false. A scanpath ends where picture, subject or target
    change. pandas writes such a table by `frame.to_csv(path, index=False)`.

    Raises:
        DataError: something in the file is not so; names the file, the line and the column.
    """
    path = Path(path)
    check_regular(path)
    try:
        lines = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"), newline=""), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read as a table ({error})") from None
    missing = [name for name in COLUMNS if lines and name not in lines[0]]
    if missing:
        raise DataError(f"{path}: expected the columns {', '.join(COLUMNS)}; {', '.join(missing)} missing")
    groups: list[list[tuple[int, Mapping[str, str]]]] = []
    previous = None
    for number, line in enumerate(lines, start=2):
        who = line["picture"], line["subject"], line.get("target")
        if who != previous:
            groups.append([])
        groups[-1].append((number, line))
        previous = who
    return [_record(path, group) for group in groups]


def write_table(path: str | PathLike[str], fixations: Iterable[Fixations]) -> None:
    """Write fixations as a table that `read_table` reads back."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([*COLUMNS, *MORE])
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
    box: Box | None = None
    if all(edge is not None for edge in edges):
        x1, y1, x2, y2 = (float(edge) for edge in edges if edge is not None)
        box = x1, y1, x2, y2
    words = {"true": True, "false": False, "": None}
    found = (line.get("found") or "").lower()
    if found not in words:
        raise DataError(f"{path}: line {first}, found: expected true, false or nothing, got {found!r}")
    known = None not in times
    try:
        return Fixations(
            picture=line["picture"],
            subject=line["subject"],
            points=points,
            size=(int(_number(path, first, line, "width")), int(_number(path, first, line, "height"))),
            durations=np.array(times, dtype=np.float64) if known else None,
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
