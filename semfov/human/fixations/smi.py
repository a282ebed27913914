"""Events of SMI eye trackers, as their IDF Event Detector writes them: several tables in one text."""

import math
import re
from bisect import bisect_right
from typing import NamedTuple

from semfov.data.picture_files import PHOTOGRAPHS, VIDEOS
from semfov.errors import DataError, check_data
from semfov.human.fixations.encodings import file_name

# The first lines have the names of the columns of each kind of event, and then the events follow. The converter of the
# same program begins lines that are no events with two signs.
_SIGNS = r"^(?:##[ \t]*)?"
_SECTION = re.compile(_SIGNS + r"Table Header for ([\w ]+?):?[ \t]*\r?\n(?:##[ \t]*)?([^\r\n]+)", re.MULTILINE)
_FIXATIONS = "fixations"  # the section that there must be
_SUBJECT = re.compile(_SIGNS + r"Subject:[ \t;,]*(\w[^\r\n]*?)\s*$", re.MULTILINE)
_SCREEN = re.compile(_SIGNS + r"Calibration Area:\W*(\d+)\D+(\d+)\s*$", re.MULTILINE)

_MESSAGE = re.compile(r"^(?:#\s*)?Message:\s*(.+?)\s*$")
_ADDED = ("Eye", "Stimulus", "Participant", "Calibration Area Width", "Calibration Area Height")
"""Columns that are made of the names of events, the messages, and the first lines."""

_FIRST_FIELDS = ("event type", "trial", "number", "start")
"""What lines of all kinds of events begin with."""


class _View(NamedTuple):
    """A picture on the screen: from when on, in the time of the events, and in which trial."""

    start: float
    trial: str
    picture: str


class _Fixation(NamedTuple):
    """A line of a fixation: its time, its place in words, and its fields."""

    start: float
    place: str
    fields: list[str]


class Events(NamedTuple):
    """The fixations of a recording.

    Attributes:
        columns: names of the fields of a fixation.
        separator: of the fields in a line.
        fixations: the line of each fixation in words, such as `line 30`, and its fields, in the order of time.
    """

    columns: list[str]
    separator: str
    fixations: list[tuple[str, list[str]]]

    @classmethod
    def of(cls, text: str, name: str) -> "Events":
        """Read the fixations of a text, with the picture that was on the screen when each of them began.

        A message with the name of a picture, such as `# Message: a.jpg`, shows it until the next one, or until the
        trial is over. Fixations at other times have no picture.

        Args:
            text: the content of the file.
            name: name of the file, for messages.

        Returns:
            The fixations.

        Raises:
            DataError: a line has not the fields that its kind of events has.
        """
        sections = {section.lower(): columns for section, columns in _SECTION.findall(text)}
        separator = max("\t;,", key=sections[_FIXATIONS].count)
        columns = [column.strip() for column in sections[_FIXATIONS].split(separator)]
        begins_right = tuple(map(str.lower, columns[: len(_FIRST_FIELDS)])) == _FIRST_FIELDS
        expected = "columns of fixations that begin with Event Type, Trial, Number, Start"
        check_data(begins_right, name, expected, ", ".join(columns)[:200])
        views, fixations = _events(text, separator, len(columns), name)
        head = _head(text)
        lines = []
        for start, place, fields in fixations:
            eye = fields[0].rpartition(" ")[2]
            lines.append((place, [*fields, eye, _picture_at(start, fields[1], views), *head]))
        return cls([*columns, *_ADDED], separator, lines)


def has_events(text: str) -> bool:
    """Tell whether a text has events of an SMI eye tracker that include fixations."""
    return any(section.lower() == _FIXATIONS for section, _ in _SECTION.findall(text))


def _events(text: str, separator: str, count: int, name: str) -> tuple[list[_View], list[_Fixation]]:
    """Read the views and the fixations of a text, in the order of time.

    Args:
        text: the text.
        separator: of the fields in a line.
        count: number of fields of a fixation.
        name: of the text, for messages.
    """
    views: list[_View] = []
    fixations: list[_Fixation] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = [field.strip() for field in line.split(separator)]
        kind = fields[0].lower().replace(" ", "")
        place = f"line {number}"
        if kind.startswith("userevent"):
            views += _views(fields, separator, f"{name}: {place}")
        elif kind.startswith("fixation"):
            check_data(len(fields) == count, f"{name}: {place}", f"{count} fields", len(fields))
            fixations.append(_Fixation(_time(fields[3], f"{name}: {place}"), place, fields))
    # Some texts have one kind of events, or one eye, after the other.
    views.sort(key=lambda view: view.start)
    fixations.sort(key=lambda fixation: fixation.start)
    return views, fixations


def _head(text: str) -> list[str]:
    """Read the name of the person, and the width and the height of the screen; what is not there is empty."""
    subject = _SUBJECT.search(text)
    screen = _SCREEN.search(text)
    sides = ("", "") if screen is None else screen.groups()
    return ["" if subject is None else subject[1], *sides]


def _views(fields: list[str], separator: str, place: str) -> list[_View]:
    """Make the view of a message; none of one that names no picture."""
    message = _MESSAGE.match(separator.join(fields[len(_FIRST_FIELDS) :]))
    if message is None or not message[1].lower().endswith((*PHOTOGRAPHS, *VIDEOS)):
        return []
    return [_View(_time(fields[3], place), fields[1], file_name(message[1]))]


def _picture_at(start: float, trial: str, views: list[_View]) -> str:
    """Name the picture of the last view that has begun, if it is of this trial."""
    begun = bisect_right(views, start, key=lambda view: view.start)
    if not begun:
        return ""
    last = views[begun - 1]
    return last.picture if last.trial == trial else ""


def _time(text: str, place: str) -> float:
    """Read the time of an event, in microseconds."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not math.isfinite(time):
        raise DataError(f"{place}: expected the time of an event, got {text[:40]!r}")
    return time
