"""Fixations as a plain table with a line for each, which any program can write."""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, get_args

import numpy as np

from semfov.data.fixations.columns import of_source
from semfov.data.fixations.programs import Origin, Units
from semfov.data.fixations.record import Fixations
from semfov.data.fixations.suspicions import warn_of_frames
from semfov.errors import DataError, InputError, check, check_data, lookup
from semfov.io.files import write_text

_COLUMNS = ("picture", "subject", "x", "y")
_SIZE = ("width", "height")
_MORE = ("target", "duration", "x1", "y1", "x2", "y2", "found", "trial")
"""Further columns that a table may have; their fields may be empty."""

_LARGEST = 1e6  # largest coordinate and side in pixels

Size = tuple[int, int] | Mapping[str, tuple[int, int]]
"""`(width, height)` of all frames, or of each by the name of its picture."""

Line = tuple[str, Mapping[str, str]]  # the place of a line in words, and its fields by our names of the columns


class FrameError(DataError):
    """A table does not tell the frame of its points, which `size` may give."""


def read_table(
    source: str | PathLike[str] | Any,
    *,
    columns: Mapping[str, str] | None = None,
    size: Size | None = None,
    units: Units = "pixels",
    origin: Origin = "top left",
) -> list[Fixations]:
    r"""Read fixations from a table.

    The first line holds the names of the columns: `picture`, `subject`, `x`, `y`, `width` and `height`, and perhaps
    `target`, `duration`, `x1`, `y1`, `x2`, `y2`, `found` and `trial`, whose fields may be empty. `x` and `y` are in
    pixels of a frame of `width` × `height`, pixel centres at integers. `duration` is in milliseconds. `x1`, `y1`, `x2`
    and `y2` are the target's box, in the same unit and from the same origin, its edges. `found` is `true` or `false`.
    pandas writes such a table by `frame.to_csv(path, index=False)`.

    A scanpath has the fixations of one picture, subject, target and `trial`, in the order of the lines. `trial` tells
    two viewings of a picture by one person apart, and with it the lines of scanpaths may alternate. Without it the
    lines of a scanpath must follow each other.

    Fields are separated by commas, semicolons, tabs or bars, and numbers may have a decimal comma in all but the first,
    as spreadsheets write them.

    Args:
        source: the file, or a `pandas.DataFrame`.
        columns: names of the columns in the source by the names above, such as `{"x": "FPOGX"}`.
        size: `(width, height)` of the frame, or of each picture by its name, for a table without these columns.
        units: `pixels`, or `fractions` of the sides of the frame.
        origin: `top left`, `bottom left`, `centre`, or `centre, y up`, as in PsychoPy.

    Returns:
        One record for each scanpath, in the order in which they begin.

    Raises:
        InputError: an argument is unknown.
        DataError: the content does not have this form; the message names the file, the line and the column.
        FrameError: a `DataError`, the table has no frame and `size` is not given.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "fixations.csv")
    ...     text = "picture,subject,x,y,width,height\na.jpg,1,40,30,80,60\na.jpg,1,52.5,31,80,60"
    ...     _ = path.write_text(text)
    ...     read_table(path)[0].points.tolist()
    [[40.0, 30.0], [52.5, 31.0]]
    """
    lookup(units, get_args(Units), "unit")
    lookup(origin, get_args(Origin), "origin")
    named = named_columns(columns, (*_COLUMNS, *_SIZE, *_MORE))
    where, header, rows = of_source(source)
    by_lower = {name.lower(): name for name in reversed(header)}
    for name in (*_COLUMNS, *_SIZE, *_MORE):
        if name not in named and name not in header and name in by_lower:
            named[name] = by_lower[name]
    needed = (*_COLUMNS, *(() if size is not None else _SIZE))
    missing = [named.get(name, name) for name in needed if named.get(name, name) not in header]
    if missing:
        text = (
            f"{where}: expected the columns {', '.join(needed)}, got none named {', '.join(missing)} among "
            f"{', '.join(map(repr, header))[:300]}; name them by columns={{…}}"
        )
        if {*missing} & {*_SIZE}:
            raise FrameError(f"{text} or give size=")
        raise DataError(text)
    lines = [(place, {name: row.get(named.get(name, name), "") for name in (*needed, *_MORE)}) for place, row in rows]
    return records_of(where, lines, size, units, origin)


def records_of(where: str, lines: Sequence[Line], size: Size | None, units: Units, origin: Origin) -> list[Fixations]:
    """The records of lines, one for each scanpath, with a warning of what their coordinates look like."""
    groups: dict[tuple[str, ...], list[Line]] = {}
    previous = None
    for place, line in lines:
        who = tuple(line[name] for name in ("picture", "subject", "target", "trial"))
        if who in groups and who != previous and not line["trial"]:
            raise DataError(
                f"{where}: {place}: expected the lines of a scanpath to follow each other, got those of "
                f"{line['subject']!r} in {line['picture']!r} again; sort them, or add a column `trial` that tells "
                "viewings apart"
            )
        groups.setdefault(who, []).append((place, line))
        previous = who
    records = [_record(where, group, size, units, origin) for group in groups.values()]
    return warn_of_frames(where, records, units=units == "pixels", stacklevel=4)


def named_columns(columns: Mapping[str, str] | None, known: Sequence[str]) -> dict[str, str]:
    """The names of columns in a source by ours, of which some are known."""
    fits = columns is None or (isinstance(columns, Mapping) and all(isinstance(each, str) for each in columns.values()))
    check(fits, "columns", "names of the source by ours, such as {'x': 'FPOGX'}", columns)
    return {lookup(ours, known, "column"): theirs for ours, theirs in (columns or {}).items()}


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
    a.jpg,1,40.0,30.0,80,60,cup,,,,,,,1
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow([*_COLUMNS, *_SIZE, *_MORE])
    viewings: dict[tuple[str, str, str | None], int] = {}
    for each in fixations:
        times = [""] * len(each) if each.durations is None else each.durations.tolist()
        box = [""] * 4 if each.box is None else each.box
        found = "" if each.found is None else str(each.found).lower()
        who = each.picture, each.subject, each.target
        viewings[who] = trial = viewings.get(who, 0) + 1
        for (x, y), time in zip(each.points.tolist(), times, strict=True):
            rows.writerow([each.picture, each.subject, x, y, *each.size, each.target or "", time, *box, found, trial])
    write_text(Path(path), text.getvalue())


def _record(where: str, group: Sequence[Line], size: Size | None, units: Units, origin: Origin) -> Fixations:
    place, line = group[0]
    check_data(line["picture"] != "", f"{where}: {place}, picture", "the name of a picture", "nothing")
    for name in (*(() if size is not None else _SIZE), "x1", "y1", "x2", "y2", "found"):
        at, other = next((each for each in group if each[1][name] != line[name]), group[0])
        expected = f"{line[name]!r}, as in {place}"
        check_data(other is line, f"{where}: {at}, {name}", expected, repr(other[name]))
    frame = _frame(where, place, line, size)
    points = np.array([[_number(where, at, row, name) for name in ("x", "y")] for at, row in group])
    times = [_maybe(where, at, row, "duration") for at, row in group]
    lacking = next((at for (at, _), time in zip(group, times, strict=True) if time is None), place)
    timed = None not in times or {*times} == {None}
    check_data(timed, f"{where}: {lacking}, duration", "a number, as in other lines of the scanpath", "nothing")
    edges = [_maybe(where, place, line, name) for name in ("x1", "y1", "x2", "y2")]
    whole = None not in edges or {*edges} == {None}
    check_data(whole, f"{where}: {place}", "all of x1, y1, x2 and y2, or none", "some")
    box: tuple[float, float, float, float] | None = None
    if None not in edges:
        corners = _placed(np.array(edges, dtype=np.float64).reshape(2, 2), frame, units, origin, edges=True)
        if origin in ("bottom left", "centre, y up"):
            corners[:, 1] = corners[::-1, 1]
        x1, y1, x2, y2 = corners.flatten().tolist()
        box = x1, y1, x2, y2
    words = {"true": True, "false": False, "1": True, "0": False, "": None}
    found = line["found"].lower()
    check_data(found in words, f"{where}: {place}, found", "true, false or nothing", repr(found))
    try:
        return Fixations(
            picture=line["picture"],
            subject=line["subject"],
            points=_placed(points, frame, units, origin),
            size=frame,
            durations=None if None in times else np.array(times, dtype=np.float64),
            target=line["target"] or None,
            box=box,
            found=words[found],
        )
    except InputError as error:
        raise DataError(f"{where}: {place}, {error}") from None


def _frame(where: str, place: str, line: Mapping[str, str], size: Size | None) -> tuple[int, int]:
    """Size of the frame of a scanpath."""
    if size is None:
        sides = [_number(where, place, line, name) for name in _SIZE]
    elif isinstance(size, Mapping):
        check(line["picture"] in size, "size", f"a size of {line['picture']!r}", "none")
        sides = [*size[line["picture"]]]
    else:
        check(isinstance(size, tuple | list | np.ndarray), "size", "(width, height) in pixels", size)
        sides = [*size]
    whole = len(sides) == 2 and all(side > 0 and float(side).is_integer() for side in sides)
    check_data(whole, f"{where}: {place}, size", "a width and a height in whole pixels", sides)
    return int(sides[0]), int(sides[1])


def _placed(points: Any, frame: tuple[int, int], units: Units, origin: Origin, *, edges: bool = False) -> Any:
    """Points, or edges of pixels, in pixels from the top left, given in a unit from an origin."""
    if units == "pixels" and origin == "top left":
        return points
    sides = np.array(frame, dtype=np.float64)
    # Between here and the end 0 is an edge. Pixels that are counted from a corner have their centres at integers.
    counted = units == "pixels" and origin == "bottom left" and not edges
    places = (points + 0.5 if counted else points) * (sides if units == "fractions" else 1.0)
    if origin in ("bottom left", "centre, y up"):
        places[:, 1] *= -1
    if origin == "bottom left":
        places[:, 1] += sides[1]
    elif origin != "top left":
        places += sides / 2
    return places if edges else places - 0.5


def _number(where: str, at: str, line: Mapping[str, str], name: str) -> float:
    value = _maybe(where, at, line, name)
    if value is None:
        raise DataError(f"{where}: {at}, {name}: expected a number, got nothing")
    if abs(value) > _LARGEST:
        raise DataError(f"{where}: {at}, {name}: expected a number up to {_LARGEST:g}, got {value:g}")
    return value


def _maybe(where: str, at: str, line: Mapping[str, str], name: str) -> float | None:
    text = line.get(name)
    if not text:
        return None
    try:
        value = float(text.replace("_", "?"))  # what Python takes for a number
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{where}: {at}, {name}: expected a number, got {text[:40]!r}")
    return value
