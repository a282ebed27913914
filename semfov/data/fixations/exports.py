"""Reading of the tables that the programs of eye trackers export."""

import math
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal

from semfov.data.fixations.columns import of_source
from semfov.data.fixations.programs import LENGTHS, PROGRAMS, TIMES, Column, Origin, Program, Units, program_of
from semfov.data.fixations.record import Fixations
from semfov.data.fixations.table import FrameError, Size, named_columns, read_table, records_of
from semfov.errors import DataError, check, check_data

_OURS = ("picture", "subject", "target", "trial")
_NAMED = (*_OURS, "duration")
_GONE = ("", ".", "-", "nan", "none", "null", "na", "undefined", "undefinednull")  # lost, or no number
_EYES = {"21": "left", "l": "left", "left": "left", "22": "right", "r": "right", "right": "right"}
"""Sides of eyes by the first of these words in a field; the numbers are in psychopy/iohub/constants.py."""

_LASTING = re.compile(r"^duration$|(fix|event|gaze|movement).*duration")  # keys of what may be durations of fixations


class PictureError(DataError):
    """A table does not name the picture, which `picture` may give."""


def read_export(
    source: str | PathLike[str] | Any,
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

    The names of the columns tell the program: Tobii Pro Lab and Tobii Studio; Pupil Cloud (also its reference images
    and surfaces) and Pupil Player (also surfaces); PsychoPy (events `FixationEndEvent` of ioHub); Gazepoint; SMI BeGaze
    (event statistics); PyGaze (the lists `Efix` of PyGazeAnalyser, under the names `starttime`, `endtime`, `duration`,
    `endx` and `endy`); pymovements (events with a `location`); and EyeLink Data Viewer (fixation reports). Units are
    those in the names of the columns (`[MCS norm]`, `[μs]`), else those of the program, as origins are. Lines that are
    no fixation, are not on the picture, or have no place are left out, and lines that repeat the number of a fixation
    are one. Fixations without a picture are left out with a warning where others have one, as between two pictures.

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
    named = named_columns(columns, _NAMED)
    check(eye in (None, "left", "right"), "eye", "'left', 'right' or None", repr(eye))
    where, header, rows = of_source(source)
    known = _columns_of(header, rows)
    program = program_of(known)
    if program is None:
        programs = ", ".join(dict.fromkeys(each.name for each in PROGRAMS))
        raise DataError(
            f"{where}: expected the columns of a table of {programs}, got {', '.join(map(repr, header))[:300]}; "
            "use read_table with columns={…}"
        )
    layout = _Layout.of(program, known, named, where)
    if layout.unread:
        warnings.warn(f"{where}: {layout.unread}", stacklevel=2)
    lines = [(place, line) for place, row in rows if (line := layout.fields_of(row)) is not None]
    file = Path(where).stem if len(header) and "." in where else "1"
    for _, line in lines:
        line["subject"] = subject if subject is not None else line["subject"] or file
    _name_pictures(lines, picture, where)
    check_data(bool(lines), where, f"fixations of {program.name}", "none that has a place on the picture")
    lines = _of_one_eye(_viewings(lines), eye)
    check_data(bool(lines), where, f"fixations of the {eye} eye", "those of the other one")
    lines = _with_picture(lines, layout, where)
    if size is None and not all(line["width"] and line["height"] for _, line in lines):
        raise FrameError(f"{where}: expected the size of the frame, which {program.name} does not give; give size=")
    return records_of(where, lines, size, units or layout.units, origin or program.origin)


_Fields = tuple[str, dict[str, str]]  # the place of a line in words, and its fields by our names


def _columns_of(header: Sequence[str], rows: Sequence[tuple[str, dict[str, str]]]) -> list[Column]:
    """The columns of a table; a column `location` of pairs, `[x, y]`, becomes two."""
    columns = [Column.of(name) for name in header]
    keys = {column.key: column.name for column in columns}
    if "location" not in keys or "locationx" in keys:
        return columns
    for _, row in rows:
        pair = re.split(r"[,\s]+", row.get(keys["location"], "").strip("[]() "))
        row["location_x"], row["location_y"] = pair if len(pair) == 2 else ("", "")
    return [*columns, Column.of("location_x"), Column.of("location_y")]


@dataclass(frozen=True)
class _Layout:
    """Where the fields of a fixation are in the table of a program, and in which units."""

    program: Program
    names: Mapping[str, str | None]  # of the columns, by our names
    keep: str | None  # the column that tells fixations from other lines
    units: Units
    milliseconds: float  # of the unit of durations
    unread: str  # a sentence on columns that may be durations, but are not read

    @classmethod
    def of(cls, program: Program, columns: Sequence[Column], named: Mapping[str, str], where: str) -> "_Layout":
        """Find the fields of a program's table; `named` are names of columns by ours, which a user gives."""
        missing = ", ".join(repr(given) for given in named.values() if given not in {each.name for each in columns})
        check_data(not missing, where, "the columns of columns=", f"none named {missing}")

        def name_of(keys: Sequence[str]) -> str | None:
            found = (column.name for key in keys for column in columns if column.key == key)
            return next(found, None)

        x, y = _point_columns(program, columns, where)
        lasting = [column for key in program.duration for column in columns if column.key == key]
        if "duration" in named:
            lasting = [Column.of(named["duration"])]
        duration = next((column for column in lasting if (column.unit or program.time) in TIMES), None)
        names = {field: name_of(getattr(program, field)) for field in ("picture", "subject", "trial", "number")}
        names |= {"eye": name_of(("eye", "eyeused", "eyereported", "eyelr")), "x": x.name, "y": y.name}
        names["duration"] = None if duration is None else duration.name
        for field, key in zip(("width", "height"), program.size or (), strict=False):
            names[field] = name_of((key,))
        return cls(
            program=program,
            names={**names, **{field: name for field, name in named.items() if field != "duration"}},
            keep=None if program.keep is None else name_of((program.keep[0],)),
            units=LENGTHS.get(x.unit, program.units),
            milliseconds=1.0 if duration is None else TIMES[duration.unit or program.time],
            unread="" if duration is not None else _unread(columns),
        )

    def fields_of(self, row: Mapping[str, str]) -> dict[str, str] | None:
        """The fields of a row by our names; None for a row that is no fixation, or has no place."""
        program = self.program
        beginnings = ("",) if program.keep is None else program.keep[1]
        if self.keep is not None and not row[self.keep].lower().startswith(beginnings):
            return None
        line = {name: "" if at is None else row.get(at, "") for name, at in self.names.items()}
        line = {**dict.fromkeys(("target", "width", "height", "found", "x1", "y1", "x2", "y2"), ""), **line}
        if line["x"].lower() in _GONE or line["y"].lower() in _GONE:
            return None
        for name in ("duration", *_OURS):
            if line[name].lower() in _GONE:
                line[name] = ""
        if line["duration"] and self.milliseconds != 1:
            duration = math.nan  # which is refused with its place, as other texts are
            with suppress(ValueError):
                duration = float(line["duration"])
            line["duration"] = repr(duration * self.milliseconds)
        return line


def _point_columns(program: Program, columns: Sequence[Column], where: str) -> tuple[Column, Column]:
    """The columns of x and y, in a unit that is read; fractions, which are not rounded to pixels, before pixels."""
    across, down = (program.of_point(key, columns) for key in program.point)
    pairs = [(x, y) for x in across for y in down if (x.frame, x.unit) == (y.frame, y.unit)]
    read = [(x, y) for x, y in pairs if not x.unit or x.unit in LENGTHS]
    got = ", ".join(repr(column.name) for column in (*across, *down))
    check_data(bool(read), where, f"points of {program.name} in px or norm", f"the columns {got}; export them in px")
    return min(read, key=lambda pair: LENGTHS.get(pair[0].unit) != "fractions")


def _unread(columns: Sequence[Column]) -> str:
    """A sentence on columns that may be durations of fixations, but are not read; empty where there is none."""
    names = ", ".join(repr(column.name) for column in columns if _LASTING.search(column.key))
    return names and f"no duration is read, although there is {names}; name it by columns={{'duration': …}}, in ms or s"


def _name_pictures(lines: Sequence[_Fields], picture: str | None, where: str) -> None:
    """Write the name of the picture that a user gives into lines of one picture."""
    if picture is None:
        return
    names = sorted({line["picture"] for _, line in lines if line["picture"]})
    got = f"{len(names)} of them, such as {', '.join(names[:3])}; leave picture= out"
    check_data(len(names) <= 1, where, "at most one name of a picture beside picture=", got)
    for _, line in lines:
        line["picture"] = picture if line["picture"] or not names else ""


def _viewings(lines: Sequence[_Fields]) -> list[_Fields]:
    """The lines with the number of their viewing in `trial`, and one line for each number of a fixation."""
    kept: dict[object, _Fields] = {}
    viewing, before = 0, None
    for number, (place, line) in enumerate(lines):
        who = tuple(line[name] for name in _OURS)
        viewing += who != before
        before = who
        line["trial"] = f"{line['trial']} {viewing}"
        key = line.pop("number") or None
        kept[number if key is None else (viewing, key)] = place, line
    return list(kept.values())


def _of_one_eye(lines: Sequence[_Fields], eye: str | None) -> list[_Fields]:
    """The lines of an eye, of the right one in viewings of both; lines that name no eye, or both, are kept."""
    words = [re.split(r"[\W_]", line.pop("eye").lower()) for _, line in lines]
    sides = [next((_EYES[word] for word in each if word in _EYES), "") for each in words]
    both = {line["trial"] for (_, line), side in zip(lines, sides, strict=True) if side == "right"}
    dropped = [
        side != eye if eye else side == "left" and line["trial"] in both
        for (_, line), side in zip(lines, sides, strict=True)
    ]
    return [line for line, side, drop in zip(lines, sides, dropped, strict=True) if not (side and drop)]


def _with_picture(lines: Sequence[_Fields], layout: _Layout, where: str) -> list[_Fields]:
    """The lines that name a picture; those that do not are left out with a warning."""
    shown = [(place, line) for place, line in lines if line["picture"]]
    if not shown:
        lacks = f"the name of the picture, which {layout.program.name} does not give"
        raise PictureError(f"{where}: expected {lacks}, got none; give picture=")
    if len(shown) < len(lines):
        warnings.warn(
            f"{where}: {len(lines) - len(shown)} of {len(lines)} fixations are left out, as "
            f"{layout.names['picture']!r} names no picture, such as between two pictures",
            stacklevel=3,
        )
    return shown


def table_reader(source: Any, columns: Mapping[str, str] | None) -> Callable[..., list[Fixations]]:
    """The reader of a table, by the names of its columns; `columns` as for `read_table`."""
    header = of_source(source)[1]
    if {"picture", "subject", "x", "y"} <= {name.lower() for name in header} or not {*(columns or ())} <= {*_NAMED}:
        return read_table
    return read_table if program_of(_columns_of(header, [])) is None else read_export
