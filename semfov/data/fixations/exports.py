"""Tables of fixations as the programs of eye trackers export them, told by the names of their columns."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

from semfov.data.fixations.record import Fixations
from semfov.data.fixations.table import FrameError, Line, Origin, Size, Units, named_columns, of_source, records_of
from semfov.errors import DataError, check


class _Export(NamedTuple):
    """The columns of a program's table, each by its possible names without case, spaces and signs.

    Attributes:
        program: its name.
        point: columns of x and y.
        duration: column of the duration, and milliseconds for one of its unit.
        keep: a column, and the beginning of its values in the lines that count; none: all do.
        needs: further columns that tell the table from others, and columns that it does not have.
    """

    program: str
    point: tuple[str, str]
    duration: tuple[tuple[str, ...], float] = (("durationms", "duration"), 1.0)
    picture: tuple[str, ...] = ()
    subject: tuple[str, ...] = ()
    trial: tuple[str, ...] = ()
    number: tuple[str, ...] = ()
    size: tuple[str, str] | None = None
    keep: tuple[str, tuple[str, ...]] | None = None
    units: Units = "pixels"
    origin: Origin = "top left"
    needs: tuple[str, ...] = ()
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

OURS = ("picture", "subject", "target", "trial")
_GONE = ("", ".", "nan", "none", "null", "na")  # lost, or not a number
_EYES = {"21": "left", "l": "left", "left": "left", "22": "right", "r": "right", "right": "right"}
"""Sides of eyes by the first of these words in a field; the numbers are in psychopy/iohub/constants.py."""


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
    named = named_columns(columns, OURS)
    check(eye in (None, "left", "right"), "eye", "'left', 'right' or None", repr(eye))
    where, header, rows = of_source(source)
    by_key = {_key(name): name for name in reversed(header)}
    _split_location(by_key, rows)
    export = next((each for each in _EXPORTS if _fits(each, by_key)), None)
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
        who = tuple(line[name] for name in OURS)
        viewing, before = viewing + (who != before), who
        line["trial"] = f"{line['trial']} {viewing}"
        key = line.pop("number") or None
        kept[number if key is None else (viewing, key)] = place, line
    if not kept:
        raise DataError(f"{where}: expected fixations of {export.program}, got none that has a place on the picture")
    lines = _of_one_eye(list(kept.values()), eye)
    if not lines:
        raise DataError(f"{where}: expected fixations of the {eye} eye, got those of the other one")
    if not all(line["picture"] for _, line in lines):
        raise DataError(
            f"{where}: expected the name of the picture, which {export.program} does not give; give picture="
        )
    if size is None and not all(line["width"] and line["height"] for _, line in lines):
        raise FrameError(f"{where}: expected the size of the frame, which {export.program} does not give; give size=")
    return records_of(where, lines, size, units or export.units, origin or export.origin)


def _of_one_eye(lines: Sequence[tuple[str, dict[str, str]]], eye: str | None) -> list[Line]:
    """The lines of an eye, of the right one in viewings of both; lines that name no eye, or both, are kept."""
    words = [re.split(r"[\W_]", line.pop("eye").lower()) for _, line in lines]
    sides = [next((_EYES[word] for word in each if word in _EYES), "") for each in words]
    both = {line["trial"] for (_, line), side in zip(lines, sides, strict=True) if side == "right"}
    dropped = [
        side != eye if eye else side == "left" and line["trial"] in both
        for (_, line), side in zip(lines, sides, strict=True)
    ]
    return [line for line, side, drop in zip(lines, sides, dropped, strict=True) if not (side and drop)]


def is_export(header: Sequence[str]) -> bool:
    """Whether these are the columns of a table that `read_export` reads."""
    by_key = {_key(name): name for name in header}
    _split_location(by_key, [])
    return any(_fits(each, by_key) for each in _EXPORTS)


def _key(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _fits(export: _Export, by_key: Mapping[str, str]) -> bool:
    return {*export.point, *export.needs} <= {*by_key} and not {*export.lacks} & {*by_key}


def _split_location(by_key: dict[str, str], rows: Sequence[tuple[str, dict[str, str]]]) -> None:
    """Make two columns of one with pairs, `[x, y]`."""
    name = by_key.get("location")
    if name is None or "locationx" in by_key:
        return
    by_key |= {"locationx": "location_x", "locationy": "location_y"}
    for _, row in rows:
        pair = re.split(r"[,\s]+", row.get(name, "").strip("[]() "))
        row["location_x"], row["location_y"] = pair if len(pair) == 2 else ("", "")


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
    missing = [given for given in named.values() if given not in by_key.values()]
    if missing:
        raise DataError(f"{where}: expected the columns of columns=, got none named {', '.join(map(repr, missing))}")
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
            line["duration"] = repr(_finite(line["duration"]) * export.duration[1])
        return line

    return read


def _finite(text: str) -> float:
    """The number; NaN, which is refused with its place, for other texts."""
    try:
        return float(text)
    except ValueError:
        return math.nan
