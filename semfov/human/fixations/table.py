"""Fixations as a plain table with a line for each, which any program can write."""

import csv
import io
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import repeat
from os import PathLike
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations
from semfov.errors import DataError, InputError, check, check_data, lookup
from semfov.human.fixations.columns import LOST, DataFrame, Row, Table, table_of
from semfov.human.fixations.encodings import warn_of_letters
from semfov.human.fixations.programs import Column, Origin, Units
from semfov.human.fixations.suspicions import warn_of_frames
from semfov.io.files import write_text

_COLUMNS = ("picture", "subject", "x", "y")
_SIZE = ("width", "height")
_EDGES = ("x1", "y1", "x2", "y2")
_MORE = ("target", "duration", *_EDGES, "found", "trial")
"""Further columns that a table may have; their fields may be empty."""

_FIELDS = (*_COLUMNS, *_SIZE, *_MORE)
SCANPATH = ("picture", "subject", "target", "trial")
"""Fields that tell scanpaths apart."""

_FOUND = {"true": True, "false": False, "1": True, "0": False, "": None}

_ARGUMENTS = {"picture": "picture=", "subject": "subject=", **dict.fromkeys(_SIZE, "size=")}
"""Arguments that stand for a column: of a table of one picture, of one person, or of frames of one size."""

Size = tuple[int, int] | Mapping[str, tuple[int, int]]
"""`(width, height)` of all frames, or of each by the name of its picture."""


class FrameError(DataError):
    """Error for a table without the size of its frame; the argument `size` can give it."""


class PictureError(DataError):
    """Error for a table without names of pictures; the argument `picture` can give one."""


_ERRORS: dict[str, type[DataError]] = {"picture": PictureError, **dict.fromkeys(_SIZE, FrameError)}
"""Errors for columns that are missing, by which a caller knows what to give; the first counts."""


def read_table(
    source: str | PathLike[str] | DataFrame,
    *,
    columns: Mapping[str, str] | None = None,
    size: Size | None = None,
    picture: str | None = None,
    subject: str | None = None,
    units: Units | None = None,
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
    as spreadsheets write them. Units in the names of columns count: `x [px]` or `x [norm]`, `duration [s]`,
    `duration (μs)`. Lines without a place, such as those of samples that were lost, are left out with a warning.

    Args:
        source: the file, or a `pandas.DataFrame`.
        columns: names of the columns in the source by the names above, such as `{"x": "FPOGX"}`.
        size: `(width, height)` of the frame, or of each picture by its name, for a table without these columns.
        picture: name of the picture, for a table without this column, or with one name in it.
        subject: name of the person, for a table of one.
        units: `pixels`, or `fractions` of the sides of the frame; None takes the unit in the names of the columns, else
            pixels.
        origin: `top left`, `bottom left`, `centre`, or `centre, y up`, as in PsychoPy.

    Returns:
        One record for each scanpath, in the order in which they begin.

    Raises:
        InputError: an argument is unknown.
        DataError: the content does not have this form; the message names the file, the line and the column.
        PictureError: a `DataError`, the table names no picture and `picture` is not given.
        FrameError: a `DataError`, the table has no frame and `size` is not given.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "fixations.csv")
    ...     text = "picture,subject,x,y,width,height\na.jpg,1,40,30,80,60\na.jpg,1,52.5,31,80,60"
    ...     _ = path.write_text(text)
    ...     read_table(path)[0].points.tolist()
    [[40.0, 30.0], [52.5, 31.0]]
    """
    if units is not None:
        lookup(units, get_args(Units), "unit")
    lookup(origin, get_args(Origin), "origin")
    user_columns = named_columns(columns, _FIELDS)
    table = table_of(source)
    names = _column_names(table, user_columns)
    arguments = {"picture": picture, "subject": subject, "width": size, "height": size}
    needed = [field for field in (*_COLUMNS, *_SIZE) if arguments.get(field) is None]
    _check_columns(table, names, needed)
    table.check_different(names.values())
    if size is None:
        _check_sides(table.name, names)
    if units is None:
        units = _stated_units(table.name, names)
    milliseconds = _stated_milliseconds(table.name, names["duration"])
    _warn_of_durations(table, names["duration"])
    rows = [row._replace(fields=_fields_of(row, names, milliseconds)) for row in table.rows]
    rows = _with_place(table.name, rows)
    if picture is not None:
        name_pictures(rows, picture, table.name)
    if subject is not None:
        for row in rows:
            row.fields["subject"] = subject
    records = records_of(table.name, rows, size, Coordinates(units, origin))
    return warn_of_letters(table.name, table.encoding, records)


def _fields_of(row: Row, names: Mapping[str, str], milliseconds: float) -> dict[str, str]:
    """Take the fields of a row by our names.

    Args:
        row: of the table.
        names: of its columns, by ours.
        milliseconds: of the unit of its durations.

    Returns:
        All fields of `read_table`; those that the table does not have are empty, and durations are in ms.
    """
    fields = {field: row.fields.get(column, "") for field, column in names.items()}
    for field in ("duration", *_EDGES):
        if fields[field].lower() in LOST:
            fields[field] = ""
    fields["duration"] = scaled(fields["duration"], milliseconds)
    return fields


def _column_names(table: Table, named: Mapping[str, str]) -> dict[str, str]:
    """Find the names of a table's columns by ours: those that a user gives, else ours, in any case and with a unit."""
    # Reversed, so that the first of several such columns counts.
    by_key = {column.key: column for column in map(Column.of, reversed(table.columns))}
    names = dict(zip(_FIELDS, _FIELDS, strict=True))
    for name in _FIELDS:
        similar = by_key.get(name)
        if similar is None or name in table.columns:
            continue
        # A width in other units than pixels is not the one that is meant.
        if name not in _SIZE or similar.length == "pixels":
            names[name] = similar.name
    return {**names, **named}


def _warn_of_durations(table: Table, name: str) -> None:
    """Warn of a column of durations that is not read, for another has its name or none has."""
    similar = [column for column in table.columns if "duration" in column.lower()]
    if name not in table.columns and similar:
        warnings.warn(
            f"{table.name}: fixations have no durations; the column {similar[0]!r} is not read: name it as duration "
            "among the columns, or call it duration, with its unit, as in 'duration [ms]'",
            stacklevel=3,
        )


def _check_sides(table: str, names: Mapping[str, str]) -> None:
    """Raise `FrameError` for sides of frames whose columns have another unit than pixels in their names."""
    width, height = (Column.of(names[name]) for name in _SIZE)
    if {width.length, height.length} != {"pixels"}:
        raise FrameError(
            f"{table}: expected width and height in px, got the columns {width.name!r} and {height.name!r}; give size="
        )


def _stated_units(table: str, names: Mapping[str, str]) -> Units:
    """Read the unit of points and boxes from the names of their columns.

    Args:
        table: name of the table, for messages.
        names: of the columns, by ours.

    Returns:
        The unit; pixels where the columns of points state none.
    """
    x = Column.of(names["x"])
    y = Column.of(names["y"])
    if x.length is None or x.unit != y.unit:
        raise DataError(f"{table}: expected x and y in px or norm, got the columns {x.name!r} and {y.name!r}")
    for edge in (Column.of(names[name]) for name in _EDGES):
        # A box without a unit is in that of the points.
        is_in_units = edge.unit == "" or edge.length == x.length
        check_data(is_in_units, table, f"a box in {x.length}, as {x.name!r}", f"the column {edge.name!r}")
    return x.length


def _stated_milliseconds(table: str, name: str) -> float:
    """Read the milliseconds of the unit of durations from the name of their column; 1 where it has none."""
    milliseconds = Column.of(name).milliseconds
    if milliseconds is None:
        raise DataError(f"{table}: expected durations in s, ms or μs, got the column {name!r}; write them in ms")
    return milliseconds


def scaled(text: str, factor: float) -> str:
    """Multiply a number by a factor; a text that is no number stays, and causes an error later."""
    if factor == 1:
        return text
    try:
        return repr(float(text) * factor)
    except ValueError:
        return text


def _with_place(table: str, rows: Sequence[Row]) -> list[Row]:
    """Take the rows that have a place, with a warning of those that have none."""
    with_place = [row for row in rows if not {row.fields["x"].lower(), row.fields["y"].lower()} <= {*LOST}]
    if with_place and len(with_place) < len(rows):
        count = len(rows) - len(with_place)
        warnings.warn(f"{table}: {count} of {len(rows)} lines are left out, as they have no place", stacklevel=3)
    return with_place or [*rows]


def _check_columns(table: Table, names: Mapping[str, str], needed: Sequence[str]) -> None:
    """Raise `DataError` for a table that lacks some of the needed columns; `names` has its names by ours."""
    missing = [field for field in needed if names[field] not in table.columns]
    if not missing:
        return
    error = next((kind for field, kind in _ERRORS.items() if field in missing), DataError)
    got = f"none named {', '.join(names[field] for field in missing)}"
    among = ", ".join(map(repr, table.columns))[:300]
    remedy = _remedy_of_missing(missing)
    raise error(f"{table.name}: expected the columns {', '.join(needed)}, got {got} among {among}; {remedy}")


def _remedy_of_missing(fields: Sequence[str]) -> str:
    """Say what to do for fields whose columns are missing."""
    remedy = "name them by columns={…}"
    # Width and height have the same argument.
    arguments = dict.fromkeys(_ARGUMENTS[field] for field in fields if field in _ARGUMENTS)
    return f"{remedy} or give {', '.join(arguments)}" if arguments else remedy


def name_pictures(rows: Sequence[Row], picture: str, table: str) -> None:
    """Write a picture's name into the rows of a picture; raises `DataError` if they name several pictures."""
    names = sorted({row.fields["picture"] for row in rows if row.fields["picture"]})
    got = f"{len(names)} of them, such as {', '.join(names[:3])}; leave picture= out"
    check_data(len(names) <= 1, table, "at most one name of a picture beside picture=", got)
    for row in rows:
        # Where the table has a name, rows without it are fixations between two pictures.
        row.fields["picture"] = picture if row.fields["picture"] or not names else ""


class _Axes(NamedTuple):
    """An origin, `(x, y)` in shares of the sides from the top left corner, and whether y points down (1) or up (-1)."""

    corner: tuple[float, float]
    y_sign: int


_AXES: dict[Origin, _Axes] = {
    "top left": _Axes((0.0, 0.0), 1),
    "bottom left": _Axes((0.0, 1.0), -1),
    "centre": _Axes((0.5, 0.5), 1),
    "centre, y up": _Axes((0.5, 0.5), -1),
}


class Coordinates(NamedTuple):
    """Unit and origin of the points and boxes in a table."""

    units: Units
    origin: Origin

    def points(self, points: NDArray[np.float64], frame: tuple[int, int]) -> NDArray[np.float64]:
        """Convert points `(n, 2)` to pixels of a frame `(width, height)`, whose centres are at integers."""
        if self == ("pixels", "top left"):
            return points
        if self == ("pixels", "bottom left"):
            # Pixels that are counted from a corner have their centres at integers, half a pixel from their edges.
            points = points + 0.5
        return self._from_corner(points, frame) - 0.5

    def box(self, edges: Sequence[float], frame: tuple[int, int]) -> tuple[float, float, float, float]:
        """Convert the edges x1, y1, x2 and y2 of a box to pixels of a frame `(width, height)`."""
        corners = np.array(edges, dtype=np.float64).reshape(2, 2)
        if self != ("pixels", "top left"):
            corners = self._from_corner(corners, frame)
        if _AXES[self.origin].y_sign < 0:
            corners[:, 1] = corners[::-1, 1]  # y1 is the upper edge
        x1, y1, x2, y2 = corners.flatten().tolist()
        return x1, y1, x2, y2

    def _from_corner(self, places: NDArray[np.float64], frame: tuple[int, int]) -> NDArray[np.float64]:
        """Convert places `(n, 2)` to pixels from the top left corner of a frame, where 0 is its edge."""
        sides = np.array(frame, dtype=np.float64)
        axes = _AXES[self.origin]
        unit = sides if self.units == "fractions" else np.ones(2)
        return sides * axes.corner + unit * (1, axes.y_sign) * places


def records_of(table: str, rows: Sequence[Row], size: Size | None, coordinates: Coordinates) -> list[Fixations]:
    """Join the rows of each scanpath to one record, and warn if coordinates seem to be in another frame.

    Args:
        table: its name, for messages.
        rows: with the fields of `read_table` by our names.
        size: as for `read_table`.
        coordinates: of the points.

    Returns:
        The records, in the order in which they begin.

    Raises:
        DataError: rows do not belong together, or a field is wrong.
    """
    groups: dict[tuple[str, ...], list[Row]] = {}
    previous = None
    for row in rows:
        fields = row.fields
        scanpath = tuple(fields[name] for name in SCANPATH)
        begins_again = scanpath in groups and scanpath != previous
        # Without a trial, two viewings of a picture by one person would be taken for one.
        if begins_again and not fields["trial"]:
            raise DataError(
                f"{row}: expected the lines of a scanpath to follow each other, got those of "
                f"{fields['subject']!r} in {fields['picture']!r} again; sort them, or add a column `trial` that tells "
                "viewings apart"
            )
        groups.setdefault(scanpath, []).append(row)
        previous = scanpath
    records = [_record(group, size, coordinates) for group in groups.values()]
    return warn_of_frames(table, records, units=coordinates.units == "pixels", stacklevel=4)


def named_columns(columns: Mapping[str, str] | None, known: Sequence[str]) -> dict[str, str]:
    """Check the user's names of columns.

    Args:
        columns: names in a source by ours; None for none.
        known: our names.

    Returns:
        The names in a source by ours.

    Raises:
        InputError: it is no such mapping, or one of our names is not known.
    """
    if columns is None:
        return {}
    are_names = isinstance(columns, Mapping) and all(isinstance(name, str) for name in columns.values())
    check(are_names, "columns", "names of the source by ours, such as {'x': 'FPOGX'}", columns)
    return {lookup(ours, known, "column"): theirs for ours, theirs in columns.items()}


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
    rows.writerow(_FIELDS)
    viewings: Counter[tuple[str, str, str | None]] = Counter()
    for record in fixations:
        # A person may see a picture more than once: the number of the viewing tells the scanpaths apart.
        scanpath = record.picture, record.subject, record.target
        viewings[scanpath] += 1
        rows.writerows(_rows_of(record, viewings[scanpath]))
    write_text(Path(path), text.getvalue())


def _rows_of(record: Fixations, viewing: int) -> Iterator[list[object]]:
    """Yield the cells of each fixation of a record, the first, second or later viewing; what is not known is empty."""
    # The writer of CSV makes an empty cell of None.
    durations: Iterable[float | None] = repeat(None, len(record))
    if record.durations is not None:
        durations = record.durations.tolist()
    box = record.box or (None,) * len(_EDGES)
    found = {True: "true", False: "false", None: None}[record.found]
    for (x, y), duration in zip(record.points.tolist(), durations, strict=True):
        yield [record.picture, record.subject, x, y, *record.size, record.target, duration, *box, found, viewing]


def _record(rows: Sequence[Row], size: Size | None, coordinates: Coordinates) -> Fixations:
    """Make the record of the rows of a scanpath."""
    first = rows[0]
    fields = first.fields
    check_data(fields["picture"] != "", f"{first}, picture", "the name of a picture", "nothing")
    if size is None:
        _check_same(rows, _SIZE)
    _check_same(rows, (*_EDGES, "found"))
    frame = _frame(first, size)
    points = np.array([[row.number("x"), row.number("y")] for row in rows])
    durations = _durations(rows)
    box = _box(first, frame, coordinates)
    found = fields["found"].lower()
    check_data(found in _FOUND, f"{first}, found", "true, false or nothing", repr(found))
    try:
        return Fixations(
            picture=fields["picture"],
            subject=fields["subject"],
            points=coordinates.points(points, frame),
            size=frame,
            durations=durations,
            target=fields["target"] or None,
            box=box,
            found=_FOUND[found],
        )
    except InputError as error:
        raise DataError(f"{first}, {error}") from None


def _check_same(rows: Sequence[Row], names: Iterable[str]) -> None:
    """Raise `DataError` unless these fields are the same in all rows of a scanpath."""
    first = rows[0]
    for name in names:
        text = first.fields[name]
        for row in rows:
            if row.fields[name] != text:
                expected = f"{text!r}, as in {first.place}"
                raise DataError(f"{row}, {name}: expected {expected}, got {row.fields[name]!r}")


def _durations(rows: Sequence[Row]) -> NDArray[np.float64] | None:
    """Read the durations of the fixations of a scanpath in ms, `(n,)`; None where no row has one."""
    times = [row.number_or_none("duration") for row in rows]
    if all(time is None for time in times):
        return None
    for row, time in zip(rows, times, strict=True):
        expected = "a number, as in other lines of the scanpath"
        check_data(time is not None, f"{row}, duration", expected, "nothing; leave the line or the column out")
    return np.array(times, dtype=np.float64)


def _box(row: Row, frame: tuple[int, int], coordinates: Coordinates) -> tuple[float, float, float, float] | None:
    """Read the box of the target, in pixels of the frame; None where a row has none."""
    edges = [row.number_or_none(name) for name in _EDGES]
    numbers = [edge for edge in edges if edge is not None]
    check_data(len(numbers) in (0, len(_EDGES)), row, "all of x1, y1, x2 and y2, or none", "some")
    return coordinates.box(numbers, frame) if numbers else None


def _frame(row: Row, size: Size | None) -> tuple[int, int]:
    """Find the size of the frame of a scanpath."""
    sides: Sequence[float]
    if size is None:
        sides = [row.number(name) for name in _SIZE]
    elif isinstance(size, Mapping):
        picture = row.fields["picture"]
        check(picture in size, "size", f"a size of {picture!r}", "none")
        sides = [*size[picture]]
    else:
        check(isinstance(size, tuple | list | np.ndarray), "size", "(width, height) in pixels", size)
        sides = [*size]
    are_pixels = len(sides) == 2 and min(sides) > 0 and all(float(side).is_integer() for side in sides)
    check_data(are_pixels, f"{row}, size", "a width and a height in whole pixels", sides)
    width, height = map(int, sides)
    return width, height
