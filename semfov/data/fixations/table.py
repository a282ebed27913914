"""Fixations as a plain table with a line for each, which any program can write, and tables of eye trackers."""

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from semfov.data.fixations.columns import of_source
from semfov.data.fixations.record import Fixations
from semfov.data.fixations.suspicions import warn_of_frames
from semfov.errors import DataError, InputError, check, check_data, lookup
from semfov.io.files import write_text

_Units = Literal["pixels", "fractions"]
"""Unit of the coordinates of a table: pixels, whose centres are at integers, or fractions of the sides of the frame."""

_Origin = Literal["top left", "bottom left", "centre", "centre, y up"]
"""Where the coordinates of a table are 0. y points down from the top left and from the centre, else up."""

_COLUMNS = ("picture", "subject", "x", "y")
_SIZE = ("width", "height")
_MORE = ("target", "duration", "x1", "y1", "x2", "y2", "found", "trial")
"""Further columns that a table may have; their fields may be empty."""

_LARGEST = 1e6  # largest coordinate and side in pixels

_Size = tuple[int, int] | Mapping[str, tuple[int, int]]
"""`(width, height)` of all frames, or of each by the name of its picture."""

_Line = tuple[str, Mapping[str, str]]  # the place of a line in words, and its fields by our names of the columns


class FrameError(DataError):
    """A table does not tell the frame of its points, which `size` may give."""


def read_table(
    source: str | PathLike[str] | Any,
    *,
    columns: Mapping[str, str] | None = None,
    size: _Size | None = None,
    units: _Units = "pixels",
    origin: _Origin = "top left",
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
    lookup(units, get_args(_Units), "unit")
    lookup(origin, get_args(_Origin), "origin")
    named = _named_columns(columns, (*_COLUMNS, *_SIZE, *_MORE))
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
    return _records_of(where, lines, size, units, origin)


def _records_of(
    where: str, lines: Sequence[_Line], size: _Size | None, units: _Units, origin: _Origin
) -> list[Fixations]:
    """The records of lines, one for each scanpath, with a warning of what their coordinates look like."""
    groups: dict[tuple[str, ...], list[_Line]] = {}
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


def _named_columns(columns: Mapping[str, str] | None, known: Sequence[str]) -> dict[str, str]:
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


def _record(where: str, group: Sequence[_Line], size: _Size | None, units: _Units, origin: _Origin) -> Fixations:
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


def _frame(where: str, place: str, line: Mapping[str, str], size: _Size | None) -> tuple[int, int]:
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


def _placed(points: Any, frame: tuple[int, int], units: _Units, origin: _Origin, *, edges: bool = False) -> Any:
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


class _Export(NamedTuple):
    """The columns of a program's table, each by its possible names without case, spaces and signs."""

    program: str
    point: tuple[str, str]
    duration: tuple[tuple[str, ...], float] = (("durationms", "duration"), 1.0)  # and milliseconds of its unit
    picture: tuple[str, ...] = ()
    subject: tuple[str, ...] = ()
    trial: tuple[str, ...] = ()
    number: tuple[str, ...] = ()
    size: tuple[str, str] | None = None
    keep: tuple[str, tuple[str, ...]] | None = None  # a column, and how it begins in the lines that count
    units: _Units = "pixels"
    origin: _Origin = "top left"
    needs: tuple[str, ...] = ()  # further columns that tell the table from others
    lacks: tuple[str, ...] = ()


_TRUE = ("true", "1")
_PRO_LAB: dict[str, Any] = {
    "duration": (("gazeeventdurationms", "gazeeventduration", "eyemovementeventduration"), 1.0),
    "picture": ("presentedstimulusname", "presentedmedianame", "recordingmedianame"),
    "subject": ("participantname",),
    "trial": ("recordingname",),
    "number": ("eyemovementtypeindex",),
    "keep": ("eyemovementtype", ("fixation",)),
}  # fmt: skip
_PRO_LAB_SCREEN = {**_PRO_LAB, "size": ("recordingresolutionwidth", "recordingresolutionheight")}
_CLOUD: dict[str, Any] = {"subject": ("recordingid",), "trial": ("sectionid",), "number": ("fixationid",)}
_PLAYER: dict[str, Any] = {"point": ("normposx", "normposy"), "units": "fractions", "origin": "bottom left"}

_EXPORTS = (
    _Export("Tobii Pro Lab", ("fixationpointxmcsnorm", "fixationpointymcsnorm"), units="fractions",
            size=("presentedmediawidth", "presentedmediaheight"), needs=("presentedmediawidth",), **_PRO_LAB),
    _Export("Tobii Pro Lab", ("fixationpointxdacspx", "fixationpointydacspx"), **_PRO_LAB_SCREEN),
    _Export("Tobii Pro Lab", ("fixationpointx", "fixationpointy"), **_PRO_LAB_SCREEN),
    _Export("Tobii Studio", ("fixationpointxmcspx", "fixationpointymcspx"), (("gazeeventduration",), 1.0),
            ("medianame",), ("participantname",), ("recordingname",), ("fixationindex",),
            ("mediawidth", "mediaheight"), ("gazeeventtype", ("fixation",))),
    _Export("Pupil Cloud", ("fixationxpx", "fixationypx"), keep=("fixationdetectedinreferenceimage", _TRUE),
            needs=("fixationdetectedinreferenceimage",), **_CLOUD),
    _Export("Pupil Cloud", ("fixationxpx", "fixationypx"), **_CLOUD),
    _Export("Pupil Cloud", ("fixationxnormalized", "fixationynormalized"), units="fractions",
            keep=("fixationdetectedonsurface", _TRUE), needs=("fixationdetectedonsurface",), **_CLOUD),
    _Export("Pupil Player", number=("fixationid",), keep=("onsurf", _TRUE), needs=("onsurf", "fixationid"), **_PLAYER),
    _Export("Pupil Player", number=("id",), needs=("dispersion",), lacks=("onsurf",), **_PLAYER),
    _Export("PsychoPy", ("averagegazex", "averagegazey"), (("duration",), 1000.0), subject=("sessionid",),
            origin="centre, y up", needs=("duration",)),
    _Export("Gazepoint", ("fpogx", "fpogy"), (("fpogd",), 1000.0), ("medianame", "mediaid"), number=("fpogid",),
            keep=("fpogv", _TRUE), units="fractions"),
    _Export("PyGaze", ("endx", "endy"), needs=("starttime", "endtime"), lacks=("startx",)),
    _Export("pymovements", ("locationx", "locationy"), (("duration",), 1.0), ("stimulus", "image", "imageid", "textid"),
            ("subjectid", "participantid", "subject"), ("trialid", "trial"), keep=("name", ("fixation",)),
            needs=("onset", "offset")),
    _Export("EyeLink Data Viewer", ("currentfixx", "currentfixy"), (("currentfixduration",), 1.0),
            ("image", "imagename", "picture"), ("recordingsessionlabel", "datafile"), ("trialindex", "triallabel")),
)  # fmt: skip

_OURS = ("picture", "subject", "target", "trial")
_GONE = ("", ".", "nan", "none", "null", "na")  # lost, or not a number
_EYES = {"21": "left", "l": "left", "left": "left", "22": "right", "r": "right", "right": "right"}
"""Sides of eyes by the first of these words in a field; the numbers are in psychopy/iohub/constants.py."""


def read_export(
    source: str | PathLike[str] | Any,
    *,
    size: _Size | None = None,
    picture: str | None = None,
    subject: str | None = None,
    columns: Mapping[str, str] | None = None,
    units: _Units | None = None,
    origin: _Origin | None = None,
    eye: Literal["left", "right"] | None = None,
) -> list[Fixations]:
    r"""Read the fixations in a table that the program of an eye tracker exports.

    The names of the columns tell the program: Tobii Pro Lab and Tobii Studio; Pupil Cloud (also its reference images
    and surfaces) and Pupil Player (also surfaces); PsychoPy (events `FixationEndEvent` of ioHub); Gazepoint; PyGaze
    (the lists `Efix` of PyGazeAnalyser, under the names `starttime`, `endtime`, `duration`, `endx` and `endy`);
    pymovements (events with a `location`); and EyeLink Data Viewer (fixation reports). Units, origins and durations are
    those of the program. Lines that are no fixation, are not on the picture, or have no place are left out, and lines
    that repeat the number of a fixation are one.

    Args:
        source: the file, or a `pandas.DataFrame`.
        size: `(width, height)` of the frame, or of each picture by its name, where the table has none: the screen, the
            picture, or the camera of glasses.
        picture: name of the picture, where the table has none.
        subject: name of the person; None takes that of the table, or of the file.
        columns: columns of the table with our `picture`, `subject`, `target` and `trial`, such as
            `{"picture": "condition_image"}`.
        units: as for `read_table`, where it is not that of the program.
        origin: likewise.
        eye: `left` or `right`, where a column `eye` tells them; None takes the right one in viewings that have both.

    Returns:
        One record for each viewing, in the order in which they begin; convert those of a screen by
        `Fixations.in_picture`.

    Raises:
        InputError: an argument is unknown.
        DataError: it is no table of these programs, or has no fixation or no picture.
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
    named = _named_columns(columns, _OURS)
    check(eye in (None, "left", "right"), "eye", "'left', 'right' or None", repr(eye))
    where, header, rows = of_source(source)
    export, by_key = _export_of(header, rows)
    if export is None:
        programs = ", ".join(dict.fromkeys(each.program for each in _EXPORTS))
        raise DataError(
            f"{where}: expected the columns of a table of {programs}, got {', '.join(map(repr, header))[:300]}; "
            "use read_table with columns={…}"
        )
    read = _reader(export, by_key, named, where)
    default = {"picture": picture, "subject": subject}
    kept: dict[object, tuple[str, dict[str, str]]] = {}
    viewing, before = 0, None
    for number, (place, row) in enumerate(rows):
        line = read(row)
        if line is None:
            continue
        line |= {name: given for name, given in default.items() if given is not None}
        line["subject"] = line["subject"] or (Path(where).stem if len(header) and "." in where else "1")
        who = tuple(line[name] for name in _OURS)
        viewing, before = viewing + (who != before), who
        line["trial"] = f"{line['trial']} {viewing}"
        key = line.pop("number") or None
        kept[number if key is None else (viewing, key)] = place, line
    check_data(bool(kept), where, f"fixations of {export.program}", "none that has a place on the picture")
    lines = _of_one_eye(list(kept.values()), eye)
    check_data(bool(lines), where, f"fixations of the {eye} eye", "those of the other one")
    told, lacks = all(line["picture"] for _, line in lines), f"which {export.program} does not give"
    check_data(told, where, f"the name of the picture, {lacks}", "none; give picture=")
    if size is None and not all(line["width"] and line["height"] for _, line in lines):
        raise FrameError(f"{where}: expected the size of the frame, which {export.program} does not give; give size=")
    return _records_of(where, lines, size, units or export.units, origin or export.origin)


def _of_one_eye(lines: Sequence[tuple[str, dict[str, str]]], eye: str | None) -> list[_Line]:
    """The lines of an eye, of the right one in viewings of both; lines that name no eye, or both, are kept."""
    words = [re.split(r"[\W_]", line.pop("eye").lower()) for _, line in lines]
    sides = [next((_EYES[word] for word in each if word in _EYES), "") for each in words]
    both = {line["trial"] for (_, line), side in zip(lines, sides, strict=True) if side == "right"}
    dropped = [
        side != eye if eye else side == "left" and line["trial"] in both
        for (_, line), side in zip(lines, sides, strict=True)
    ]
    return [line for line, side, drop in zip(lines, sides, dropped, strict=True) if not (side and drop)]


def table_reader(source: Any, columns: Mapping[str, str] | None) -> Callable[..., list[Fixations]]:
    """The reader of a table, by the names of its columns; `columns` as for `read_table`."""
    header = of_source(source)[1]
    if {"picture", "subject", "x", "y"} <= {name.lower() for name in header} or not {*(columns or ())} <= {*_OURS}:
        return read_table
    return read_table if _export_of(header, [])[0] is None else read_export


def _export_of(
    header: Sequence[str], rows: Sequence[tuple[str, dict[str, str]]]
) -> tuple[_Export | None, dict[str, str]]:
    """The program of a table, and its columns by plain names; a column of pairs, `[x, y]`, becomes two."""
    by_key = {re.sub(r"[^a-z0-9]", "", name.lower()): name for name in reversed(header)}
    name = by_key.get("location")
    if name is not None and "locationx" not in by_key:
        by_key |= {"locationx": "location_x", "locationy": "location_y"}
        for _, row in rows:
            pair = re.split(r"[,\s]+", row.get(name, "").strip("[]() "))
            row["location_x"], row["location_y"] = pair if len(pair) == 2 else ("", "")
    fitting = (
        each for each in _EXPORTS if {*each.point, *each.needs} <= by_key.keys() and not {*each.lacks} & by_key.keys()
    )
    return next(fitting, None), by_key


def _reader(
    export: _Export, by_key: Mapping[str, str], named: Mapping[str, str], where: str
) -> Callable[[Mapping[str, str]], dict[str, str] | None]:
    """A function that gives the fields of a row by our names; None for one that is no fixation."""

    def column(names: Sequence[str]) -> str | None:
        return next((by_key[name] for name in names if name in by_key), None)

    fields = {name: column(getattr(export, name)) for name in ("picture", "subject", "trial", "number")}
    fields |= {
        "eye": column(("eye", "eyeused")),
        "x": by_key[export.point[0]],
        "y": by_key[export.point[1]],
        "duration": column(export.duration[0]),
    }
    for name, side in zip(("width", "height"), export.size or (), strict=False):
        fields[name] = column((side, f"{side}px"))
    missing = ", ".join(repr(given) for given in named.values() if given not in by_key.values())
    check_data(not missing, where, "the columns of columns=", f"none named {missing}")
    fields |= named
    keep = None if export.keep is None else column((export.keep[0],))

    def read(row: Mapping[str, str]) -> dict[str, str] | None:
        if keep is not None and export.keep is not None and not row[keep].lower().startswith(export.keep[1]):
            return None
        line = {name: "" if at is None else row.get(at, "") for name, at in fields.items()}
        line = {**dict.fromkeys(("target", "width", "height", "found", "x1", "y1", "x2", "y2"), ""), **line}
        if line["x"].lower() in _GONE or line["y"].lower() in _GONE:
            return None
        if line["duration"].lower() in _GONE:
            line["duration"] = ""
        elif export.duration[1] != 1:
            duration = math.nan  # which is refused with its place, as other texts are
            with suppress(ValueError):
                duration = float(line["duration"])
            line["duration"] = repr(duration * export.duration[1])
        return line

    return read
