"""Reading of the tables that the programs of eye trackers export."""

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from os import PathLike
from pathlib import Path
from typing import Literal

from semfov.data.fixations.record import Fixations
from semfov.errors import DataError, check, check_data
from semfov.human.fixations.columns import LOST, DataFrame, Row, Table, table_of
from semfov.human.fixations.encodings import warn_of_letters
from semfov.human.fixations.programs import LENGTHS, PROGRAMS, TIMES, Column, Origin, Program, Units, program_of
from semfov.human.fixations.table import (
    SCANPATH,
    Coordinates,
    FrameError,
    PictureError,
    Size,
    name_pictures,
    named_columns,
    read_table,
    records_of,
    scaled,
)
from semfov.human.fixations.unfolding import unfolded

_NAMED = (*SCANPATH, "duration")  # fields whose columns a user may name
_OTHERS = ("width", "height", "found", "x1", "y1", "x2", "y2")  # fields that `read_table` has, and few programs
_EYE_KEYS = ("eye", "eyeused", "eyereported", "eyelr")
_EYES = {"21": "left", "l": "left", "left": "left", "22": "right", "r": "right", "right": "right"}
"""Sides of eyes by the first of these words in a field; the numbers are in psychopy/iohub/constants.py."""

_LASTING = re.compile(r"^duration$|(fix|event|gaze|movement).*duration")  # keys of what may be durations of fixations


def read_export(
    source: str | PathLike[str] | DataFrame,
    *,
    size: Size | None = None,
    picture: str | None = None,
    subject: str | None = None,
    columns: Mapping[str, str] | None = None,
    units: Units | None = None,
    origin: Origin | None = None,
    eye: Literal["left", "right"] | None = None,
) -> list[Fixations]:
    r"""Read the fixations in a table that the program of an eye tracker exports.

    The names of the columns tell the program: Tobii Pro Lab (of glasses, the fixations that are mapped to snapshots, if
    there are some) and Tobii Studio; Pupil Cloud (also its reference images and surfaces) and Pupil Player (also
    surfaces); PsychoPy (events `FixationEndEvent` of ioHub); Gazepoint; SMI BeGaze (event statistics) and SMI's IDF
    Event Detector; PyGaze (the lists `Efix` of PyGazeAnalyser, under the names `starttime`, `endtime`, `duration`,
    `endx` and `endy`); pymovements (events with a `location`); REMoDNaV; I2MC; iMotions; and EyeLink Data Viewer
    (fixation reports). Units are those in the names of the columns (`[MCS norm]`, `[μs]`), else those of the program,
    as origins are. Lines that are no fixation, are not on the picture, or have no place are left out; lines with the
    same number of a fixation count once. If some fixations have a picture, those without one, as between two pictures,
    are left out with a warning. In texts of the IDF Event Detector, a message with the name of a picture shows it until
    the next such message, or until the trial is over.

    Args:
        source: the file, or a `pandas.DataFrame`.
        size: `(width, height)` of the frame, or of each picture by its name, where the table has none: the screen, the
            picture, or the camera of glasses.
        picture: name of the picture, where the table has none or one.
        subject: name of the person; None takes that of the table, or of the file.
        columns: columns of the table with our `picture`, `subject`, `target`, `trial` and `duration`, such as
            `{"picture": "condition_image"}`.
        units: as for `read_table`, where it is not that of the table.
        origin: likewise.
        eye: `left` or `right`, where a column `eye` tells them; None takes the right one in viewings that have both.

    Returns:
        One record for each viewing, in the order in which they begin; convert those of a screen by
        `Fixations.in_picture`.

    Raises:
        InputError: an argument is unknown.
        DataError: it is no table of these programs, or has no fixation.
        PictureError: a `DataError`, it names no picture and `picture` is not given.
        FrameError: a `DataError`, it has no frame and `size` is not given.

    >>> import tempfile
    >>> text = "id,start_timestamp,duration,norm_pos_x,norm_pos_y,dispersion\n7,1.2,240,0.5,0.75,1.1\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "ann.csv")
    ...     _ = path.write_text(text)
    ...     (record,) = read_export(path, size=(1280, 720), picture="desk.jpg")
    >>> record.subject, record.points.tolist(), record.durations.tolist()
    ('ann', [[639.5, 179.5]], [240.0])
    """
    user_columns = named_columns(columns, _NAMED)
    check(eye in (None, "left", "right"), "eye", "'left', 'right' or None", repr(eye))
    stored = table_of(source)
    table = unfolded(stored)
    table_columns = [Column.of(name) for name in table.columns]
    program = program_of(table_columns)
    if program is None:
        raise DataError(f"{table.name}: {_of_no_program(stored)}")
    layout = _Layout.of(program, table_columns, user_columns, table.name)
    if layout.names["duration"] is None:
        _warn_of_durations(program, table_columns, table.name)
    table.check_different([*layout.names.values(), layout.filter])

    rows = layout.fixations_of(table)
    _name_people(rows, subject, table.name)
    if picture is not None:
        name_pictures(rows, picture, table.name)
    check_data(bool(rows), table.name, f"fixations of {program.name}", "none that has a place on the picture")
    rows = _of_one_eye(_viewings(rows), eye)
    check_data(bool(rows), table.name, f"fixations of the {eye} eye", "those of the other one")
    rows = _with_picture(rows, layout, table.name)
    lacks_frame = any("" in (row.fields["width"], row.fields["height"]) for row in rows)
    if size is None and lacks_frame:
        expected = f"the size of the frame, which {program.name} does not give"
        raise FrameError(f"{table.name}: expected {expected}; give size=")
    coordinates = Coordinates(units or layout.units, origin or program.origin)
    records = records_of(table.name, rows, size, coordinates)
    return warn_of_letters(table.name, table.encoding, records)


@dataclass(frozen=True)
class _Layout:
    """Where the fields of a fixation are in the table of a program, and in which units.

    Attributes:
        program: the program.
        names: of the columns, by our names of the fields; None for a field that the table does not have.
        filter: the column that tells fixations from other lines; None without one.
        units: of the points.
        milliseconds: of the unit of durations.
    """

    program: Program
    names: Mapping[str, str | None]
    filter: str | None
    units: Units
    milliseconds: float

    @classmethod
    def of(cls, program: Program, columns: Sequence[Column], named: Mapping[str, str], table: str) -> "_Layout":
        """Find the fields of a program's table.

        Args:
            program: the program.
            columns: of the table.
            named: names of columns that a user gives, by ours.
            table: name of the table, for messages.

        Returns:
            The layout.
        """
        names_in_table = {column.name for column in columns}
        missing = ", ".join(repr(name) for name in named.values() if name not in names_in_table)
        check_data(not missing, table, "the columns of columns=", f"none named {missing}")
        x, y = _point_columns(program, columns, table)
        names = {
            "picture": _column_name(program.picture, columns),
            "subject": _column_name(program.subject, columns),
            "trial": _column_name(program.trial, columns),
            "number": _column_name(program.number, columns),
            "eye": _column_name(_EYE_KEYS, columns),
            "width": _column_name(program.width, columns),
            "height": _column_name(program.height, columns),
            "x": x.name,
            "y": y.name,
            **named,
            "duration": None,
        }
        milliseconds = 1.0
        duration = _duration_column(program, columns, named.get("duration"))
        if duration is not None:
            names["duration"] = duration.name
            milliseconds = TIMES[duration.unit or program.time]
        return cls(
            program=program,
            names=names,
            filter=_column_name(program.filter, columns),
            units=LENGTHS.get(x.unit, program.units),
            milliseconds=milliseconds,
        )

    def fixations_of(self, table: Table) -> list[Row]:
        """Take the rows that are fixations with a place, with their fields by our names."""
        stored = [row for row in table.rows if self._is_fixation(row.fields)]
        fixations = [row._replace(fields=self._fields_of(row.fields)) for row in stored]
        return [row for row in fixations if "" not in (row.fields["x"], row.fields["y"])]

    def _is_fixation(self, stored: Mapping[str, str]) -> bool:
        """Tell whether a row is that of a fixation on the picture."""
        if self.filter is None:
            return True
        return stored[self.filter].lower().startswith(self.program.beginnings)

    def _fields_of(self, stored: Mapping[str, str]) -> dict[str, str]:
        """Take the fields of a row by our names; those that hold nothing are empty."""
        fields = dict.fromkeys(("target", *_OTHERS), "")
        for name, column in self.names.items():
            fields[name] = "" if column is None else stored.get(column, "")
        for name in (*_NAMED, "x", "y"):
            if fields[name].lower() in LOST:
                fields[name] = ""
        fields["duration"] = scaled(fields["duration"], self.milliseconds)
        return fields


def _column_name(keys: Sequence[str], columns: Sequence[Column]) -> str | None:
    """Find the name of the first column with one of some keys, of which the first counts most."""
    # Reversed, so that the first of several columns with a key counts.
    by_key = {column.key: column.name for column in reversed(columns)}
    return next((by_key[key] for key in keys if key in by_key), None)


def _duration_column(program: Program, columns: Sequence[Column], name: str | None) -> Column | None:
    """Find the column of durations in a unit that is read: that of a user's `name`, or of the program."""
    if name is None:
        candidates = [column for key, column in product(program.duration, columns) if column.key == key]
    else:
        candidates = [Column.of(name)]
    return next((column for column in candidates if (column.unit or program.time) in TIMES), None)


def _point_columns(program: Program, columns: Sequence[Column], table: str) -> tuple[Column, Column]:
    """Find the columns of x and y in a unit that is read; fractions, which are not rounded, before pixels.

    Args:
        program: the program, which knows the columns of points.
        columns: of the table.
        table: its name, for messages.

    Returns:
        The first pair in one frame and unit.
    """
    x_columns, y_columns = (program.of_point(key, columns) for key in program.point)
    in_units = [x for x in x_columns if x.length is not None]
    pairs = [(x, y) for x, y in product(in_units, y_columns) if (x.frame, x.unit) == (y.frame, y.unit)]
    names = ", ".join(repr(column.name) for column in (*x_columns, *y_columns))
    expected = f"points of {program.name} in px or norm"
    check_data(bool(pairs), table, expected, f"the columns {names}; export them in px")
    # Of several in fractions, or in pixels, this is the first.
    return max(pairs, key=lambda pair: pair[0].length == "fractions")


def _warn_of_durations(program: Program, columns: Sequence[Column], table: str) -> None:
    """Warn of columns that may be durations of fixations, but are not read."""
    lasting = [column for column in columns if column.key in program.duration or _LASTING.search(column.key)]
    if lasting:
        names = ", ".join(repr(column.name) for column in lasting)
        warnings.warn(
            f"{table}: no duration is read, although there is {names}; "
            "name it by columns={'duration': …}, in ms or s",
            stacklevel=3,
        )


def _name_people(rows: Sequence[Row], subject: str | None, table: str) -> None:
    """Write the name of the person into rows: that of a user, else that of the table, else of the file."""
    # Exports of one person often have the name in that of the file alone; a data frame has no file.
    default_name = Path(table).stem if "." in table else "1"
    for row in rows:
        stored = row.fields["subject"] or default_name
        row.fields["subject"] = stored if subject is None else subject


def _viewings(rows: Sequence[Row]) -> list[Row]:
    """Write the number of their viewing into `trial` of rows, and keep one row for each number of a fixation."""
    fixations: dict[object, Row] = {}
    viewing = 0
    previous = None
    for place, row in enumerate(rows):
        scanpath = tuple(row.fields[name] for name in SCANPATH)
        viewing += scanpath != previous
        previous = scanpath
        row.fields["trial"] = f"{row.fields['trial']} {viewing}"
        number = row.fields.pop("number")
        fixations[(viewing, number) if number else place] = row
    return list(fixations.values())


def _of_one_eye(rows: Sequence[Row], eye: str | None) -> list[Row]:
    """Take the rows of an eye, of the right one in viewings of both; rows that name no eye, or both, stay."""
    sides = [_side(row.fields.pop("eye")) for row in rows]
    trials = [row.fields["trial"] for row in rows]
    trials_of_right_eye = {trial for trial, side in zip(trials, sides, strict=True) if side == "right"}
    rows_of_eye = []
    for row, trial, side in zip(rows, trials, sides, strict=True):
        usual_eye = "right" if trial in trials_of_right_eye else "left"
        # Samples of both eyes would count each fixation twice.
        if side in ("", eye or usual_eye):
            rows_of_eye.append(row)
    return rows_of_eye


def _side(text: str) -> str:
    """Find the side of an eye, `left` or `right`, in a field; empty where it tells none."""
    for word in re.split(r"[\W_]", text.lower()):
        if word in _EYES:
            return _EYES[word]
    return ""


def _with_picture(rows: Sequence[Row], layout: _Layout, table: str) -> list[Row]:
    """Take the rows that name a picture, with a warning of those that do not."""
    with_picture = [row for row in rows if row.fields["picture"]]
    if not with_picture:
        expected = f"the name of the picture, which {layout.program.name} does not give"
        raise PictureError(
            f"{table}: expected {expected}, got none; give picture=, or name its column by columns={{…}}"
        )
    if len(with_picture) < len(rows):
        warnings.warn(
            f"{table}: {len(rows) - len(with_picture)} of {len(rows)} fixations are left out, as "
            f"{layout.names['picture']!r} names no picture, such as between two pictures",
            stacklevel=3,
        )
    return with_picture


def table_reader(
    source: str | PathLike[str] | DataFrame, columns: Mapping[str, str] | None
) -> Callable[..., list[Fixations]]:
    """Choose the reader of a table by the names of its columns.

    Args:
        source: the file, or a `pandas.DataFrame`.
        columns: as for `read_table`.

    Returns:
        `read_table` or `read_export`.
    """
    table = table_of(source)
    keys = {Column.of(name).key for name in table.columns}
    is_ours = {"picture", "subject", "x", "y"} <= keys
    names_points = not {*(columns or ())} <= {*_NAMED}
    if is_ours or names_points:
        return read_table
    # Unfolding looks at all rows, which most tables do not need.
    if _is_known(table) or _is_known(unfolded(table)):
        return read_export
    if {"x", "y"} <= keys:  # of one picture, or of one person
        return read_table
    raise DataError(f"{table.name}: {_of_no_program(table)}")


def _is_known(table: Table) -> bool:
    """Tell whether a table has the columns of a program."""
    return program_of([Column.of(name) for name in table.columns]) is not None


_GAZE = re.compile(r"gaze|pog|por[xy]|pred|raw[xy]|pupil")  # keys of samples
_PLACE = re.compile(r"fix.*[xy]$")  # keys of places of fixations


def _of_no_program(table: Table) -> str:
    """Say that a table is not known, with what it may be, and the remedy."""
    programs = ", ".join(dict.fromkeys(program.name for program in PROGRAMS))
    got = ", ".join(map(repr, table.columns))[:300]
    keys = [Column.of(column).key for column in table.columns]
    are_samples = any(map(_GAZE.search, keys)) and not any(map(_PLACE.search, keys))
    remedy = "name them by columns={…}"
    if are_samples:
        remedy = f"these look like samples, in which fixations are to be found first; else {remedy}"
    return f"expected the columns of a table of {programs}, or picture, subject, x and y, got {got}; {remedy}"
