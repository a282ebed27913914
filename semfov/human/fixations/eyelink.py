"""Fixations in the text files of EyeLink trackers (ASC, as written by edf2asc)."""

import math
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from semfov.data.fixations.record import Fixations
from semfov.errors import DataError, check, check_data
from semfov.human.fixations.encodings import WINDOWS, file_name, warn_of_letters
from semfov.human.fixations.suspicions import warn_of_frames
from semfov.io.files import read_encoded

_MESSAGE = re.compile(r"^MSG\s+(\d+(?:\.\d+)?)\s+(?:(-?\d+)\s+(?=!V\s|TRIAL))?(.*)$")
"""The time of a message, the milliseconds by which it is late, and its text."""

# Messages of a trial: a picture is loaded, its name, and the screen is cleared.
_LOAD = re.compile(r"^!V\s+IMGLOAD\s+(\S+)\s+(.+?)\s*$", re.IGNORECASE)
_VARIABLE = re.compile(r"^(?:!V\s+TRIAL_VAR|var)\s+(?:image|picture|img|stimulus)\s+(.+?)\s*$", re.IGNORECASE)
# Trials of Experiment Builder, in which a name may follow without a space, and of OpenSesame.
_BEGIN = re.compile(r"^(?:TRIALID|start_trial\b)\s*(.*)$")
_RESULT = re.compile(r"^(?:TRIAL_RESULT|(?:end_trial|stop_trial)\b)")
_CLEAR = re.compile(r"^!V\s+CLEAR\b", re.IGNORECASE)
# What follows `IMGLOAD` and its mode: a name, x and y, and perhaps width and height.
_PLACED = re.compile(r"^(.+?)\s+(-?[\d.]+)\s+(-?[\d.]+)(?:\s+([\d.]+)\s+([\d.]+))?$")
_SIDE = r"[\s,]+(-?[\d.]+)"
_FRAME = re.compile(rf"^MSG\s+\S+\s+(?:DISPLAY|GAZE)_COORDS\s*=?{4 * _SIDE}")
_LOST = re.compile(r"\b(?:MESSAGES?|MSGS?|EVENTS?|DATA)\s+LOST\b|\bLOST_?\s?DATA\w*", re.IGNORECASE)

_Place = tuple[float, float, float, float]


class _Fixation(NamedTuple):
    """A line `EFIX`: its eye, `L` or `R`, its beginning in ms, its duration and its place on the screen."""

    eye: str
    start: float
    duration: float
    x: float
    y: float


@dataclass
class _View:
    """A picture on the screen: from when to when, in ms, and `(x, y, width, height)` where its message tells them."""

    picture: str
    start: float
    end: float = math.inf
    place: _Place | None = None
    fixations: list[_Fixation] = field(default_factory=list)


@dataclass
class _Trial:
    """A trial: its name, its time, and the views of the pictures that were loaded in it."""

    name: str
    start: float
    end: float = math.inf
    views: list[_View] = field(default_factory=list)

    def show(self, picture: str, time: float, place: _Place | None) -> None:
        """Begin the view of a picture, which ends that of the one before."""
        self.hide(time)
        self.views.append(_View(picture, time, place=place))

    def hide(self, time: float) -> None:
        """End the view of the picture that is on the screen."""
        if self.views:
            self.views[-1].end = min(self.views[-1].end, time)

    def close(self, time: float) -> None:
        """End the trial."""
        self.hide(time)
        self.end = min(self.end, time)

    def viewed(self) -> list[_View]:
        """List the views of its pictures; the whole trial is one where no picture was loaded."""
        return self.views or [_View(self.name, self.start, self.end)]


def read_eyelink(
    path: str | PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    eye: Literal["left", "right"] | None = None,
    subject: str | None = None,
) -> list[Fixations]:
    r"""Read the fixations of an ASC file of an EyeLink tracker.

    Fixations are the lines `EFIX`, and trials begin with the message `TRIALID`, or with `start_trial` of OpenSesame;
    without them, a recording with messages of pictures is one trial. A picture is on the screen from its message `!V
    IMGLOAD` to the next one, to `!V CLEAR` or `TRIAL_RESULT`, or to the `END` of the recording; it has the fixations
    that begin in this time. A trial without such a message is of the picture that `!V TRIAL_VAR image`, or
    `var image`, names, else of the name after `TRIALID`.

    The frame is that of `DISPLAY_COORDS` or `GAZE_COORDS`, from whose first corner the points are counted (EyeLink 1000
    User Manual, section 4.9). It is the picture where `!V IMGLOAD CENTER` or `TOP_LEFT` has its place and size.
    Fixations without a place, and those at other times, are left out.

    Args:
        path: the file.
        size: `(width, height)` of the screen; None takes that of the file.
        eye: `left` or `right`; None takes, of each picture in each trial, the right one where both were recorded.
        subject: name of the person; None takes that of the file.

    Returns:
        One record for each picture in each trial with fixations; convert those of a screen by `Fixations.in_picture`,
        and others by `Fixations.resized`.

    Raises:
        DataError: the file cannot be read, or has no fixation or no size of the screen.

    >>> import tempfile
    >>> text = "MSG 1 DISPLAY_COORDS 0 0 1023 767\nMSG 2 TRIALID 1\nMSG 3 !V IMGLOAD FILL a.jpg\n"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "ann.asc")
    ...     _ = path.write_text(text + "EFIX R 10 209 200 512.3 384.1 1200\n")
    ...     (record,) = read_eyelink(path)
    >>> record.picture, record.subject, record.size, record.points.tolist()
    ('a.jpg', 'ann', (1024, 768), [[512.3, 384.1]])
    """
    path = Path(path)
    check(eye in (None, "left", "right"), "eye", "'left', 'right' or None", repr(eye))
    text, encoding = read_encoded(path, WINDOWS)
    lines = text.splitlines()
    trials, fixations = _events(path, lines)
    views: list[_View] = []
    for trial in trials:
        views += trial.viewed()
    _share_out(fixations, views)
    viewed = [view for view in views if view.fixations]
    check_data(bool(viewed), path, "lines EFIX after a message TRIALID", _lack_of_fixations(trials, lines))

    screen = _screen(path, lines, size)
    views_of_one_eye = [replace(view, fixations=_of_one_eye(view.fixations, eye)) for view in viewed]
    views_of_eye = [view for view in views_of_one_eye if view.fixations]
    check_data(bool(views_of_eye), path, f"fixations of the {eye} eye", "those of the other one")
    person = path.stem if subject is None else subject
    records = [_record(view, screen, person) for view in views_of_eye]

    remarks = [*_lost(lines), *_outside_views(trials, fixations)]
    of_other_eye = len(viewed) - len(views_of_eye)
    if of_other_eye:
        remarks.append(f"{of_other_eye} of {len(viewed)} pictures have no fixation of the {eye} eye")
    if remarks:
        warnings.warn(f"{path}: {'; '.join(remarks)}", stacklevel=2)
    return warn_of_letters(path, encoding, warn_of_frames(path, records))


def _screen(path: Path, lines: Iterable[str], size: tuple[int, int] | None) -> _Place:
    """Find the screen, `(x, y, width, height)`, in the pixels of the points; `size` overrides that of the file."""
    frame = next(filter(None, map(_FRAME.match, lines)), None)
    if frame is not None:
        left, top, right, bottom = map(float, frame.groups())
        # The message has the first and the last pixel.
        stated_size = (round(right - left) + 1, round(bottom - top) + 1)
        return left, top, *(stated_size if size is None else size)
    if size is None:
        raise DataError(f"{path}: expected a message DISPLAY_COORDS, got none; give size=")
    return 0.0, 0.0, *size


def _record(view: _View, screen: _Place, person: str) -> Fixations:
    """Make the record of a view, in pixels from the corner of the picture, or of the screen where it has no place."""
    left, top, width, height = view.place or screen
    points = np.array([(fixation.x - left, fixation.y - top) for fixation in view.fixations])  # (n, 2)
    durations = np.array([fixation.duration for fixation in view.fixations])  # (n,), ms
    return Fixations(view.picture, person, points, (round(width), round(height)), durations=durations)


def _events(path: Path, lines: Sequence[str]) -> tuple[list[_Trial], list[_Fixation]]:
    """Read the trials of a recording with the pictures in them, and all fixations that have a place."""
    trials: list[_Trial] = []
    fixations: list[_Fixation] = []
    messages = [message[3] for line in lines if (message := _MESSAGE.match(line))]
    shows_pictures = any(map(_LOAD.match, messages))
    has_trials = any(map(_BEGIN.match, messages))
    if shows_pictures and not has_trials:
        trials.append(_Trial("trial 1", -math.inf))
    for number, line in enumerate(lines, start=1):
        try:
            fixation = _read_event(line, trials)
        except (ValueError, IndexError):
            raise DataError(f"{path}: line {number}: expected an event of EyeLink, got {line[:60]!r}") from None
        if fixation is not None:
            fixations.append(fixation)
    return trials, fixations


def _read_event(line: str, trials: list[_Trial]) -> _Fixation | None:
    """Add what a line tells to the trials; returns the fixation that it tells, if it has a place in a trial."""
    if message := _MESSAGE.match(line):
        time, delay, text = message.groups()
        _read_message(text, float(time) - float(delay or 0), trials)
        return None
    words = line.split()
    if not trials or not words:
        return None
    if words[0] == "END":
        trials[-1].hide(float(words[1]))
    if words[0] == "EFIX":
        return _fixation(words)
    return None


def _fixation(words: Sequence[str]) -> _Fixation | None:
    """Read the words of a line `EFIX`; None for a fixation whose place the tracker has lost, and writes as a point."""
    _, eye, *numbers = words
    if "." in numbers[3:5]:
        return None
    start, _, duration, x, y = map(float, numbers[:5])
    return _Fixation(eye[:1], start, duration, x, y)


def _read_message(text: str, time: float, trials: list[_Trial]) -> None:
    """Add what a message tells to the trials: a new one, its end, or the pictures on the screen."""
    if begin := _BEGIN.match(text):
        if trials:
            trials[-1].close(time)
        # Some experiments give a trial no name.
        trials.append(_Trial(begin[1].strip() or f"trial {len(trials) + 1}", time))
        return
    if not trials:
        return
    trial = trials[-1]
    if _RESULT.match(text):
        trial.close(time)
    elif _CLEAR.match(text):
        trial.hide(time)
    elif load := _LOAD.match(text):
        picture, place = _loaded(load[1].upper(), load[2])
        trial.show(picture, time, place)
    elif variable := _VARIABLE.match(text):
        trial.name = file_name(variable[1])


def _loaded(mode: str, rest: str) -> tuple[str, _Place | None]:
    """Read the picture of a message `IMGLOAD`, and its place on the screen where the message has it with its size.

    Args:
        mode: how the picture is placed, such as `FILL`, `TOP_LEFT` or `CENTER`.
        rest: of the message: the name of the file, and perhaps x, y, width and height.

    Returns:
        The name, and the place.
    """
    placed = _PLACED.match(rest)
    # A name may end in numbers, too, and a picture that fills the screen has no place in its message.
    if placed is None or mode == "FILL":
        return file_name(rest), None
    name, *numbers = placed.groups()
    return file_name(name), None if None in numbers else _place(mode, *map(float, numbers))


def _place(mode: str, x: float, y: float, width: float, height: float) -> _Place | None:
    """Find the place of a picture from the numbers of its message; None where it has no area."""
    if min(width, height) < 1:
        return None
    if mode == "CENTER":  # x and y are those of the middle
        return x - width / 2, y - height / 2, width, height
    return x, y, width, height


def _share_out(fixations: Iterable[_Fixation], views: Sequence[_View]) -> None:
    """Give each fixation to the view in whose time it begins."""
    ordered = sorted(views, key=lambda view: view.start)
    # Views follow each other, so that of those that have begun only the last can still be on the screen.
    starts = np.array([view.start for view in ordered])
    for fixation in fixations:
        number = int(np.searchsorted(starts, fixation.start, side="right")) - 1
        if number >= 0 and fixation.start < ordered[number].end:
            ordered[number].fixations.append(fixation)


def _of_one_eye(fixations: Sequence[_Fixation], eye: str | None) -> list[_Fixation]:
    """Take the fixations of an eye; None takes the right one where it has any."""
    if eye is None:
        eye = "right" if any(fixation.eye == "R" for fixation in fixations) else "left"
    side = eye[0].upper()
    return [fixation for fixation in fixations if fixation.eye == side]


def _lack_of_fixations(trials: Sequence[_Trial], lines: Iterable[str]) -> str:
    """Say what is there instead of fixations in trials."""
    if trials:
        return "none in the time of a picture"
    count = sum(line.startswith("EFIX") for line in lines)
    if count == 0:
        return "none; convert the events, too"
    return f"{count} EFIX, but no such message, nor !V IMGLOAD, so no picture; write a table for read_table"


def _lost(lines: Sequence[str]) -> list[str]:
    """Say which messages and data the recording says were lost, with their lines."""
    lost = [number for number, line in enumerate(lines, start=1) if _LOST.search(line)]
    if not lost:
        return []
    numbers = ", ".join(map(str, lost[:5])) + (", …" if lost[5:] else "")
    return [f"messages or data were lost (line {numbers}), so pictures may be missing or wrong from there on"]


def _outside_views(trials: Sequence[_Trial], fixations: Sequence[_Fixation]) -> list[str]:
    """Say of how many trials all fixations lie outside the time of their pictures."""
    starts = np.sort([fixation.start for fixation in fixations])  # (n,), to find those of a trial by bisection
    missed = []
    for trial in trials:
        first, end = np.searchsorted(starts, (trial.start, trial.end))
        has_fixations = bool(end > first)
        any_on_picture = any(view.fixations for view in trial.views)
        if has_fixations and trial.views and not any_on_picture:
            missed.append(trial)
    if not missed:
        return []
    picture = missed[0].views[0].picture
    return [
        f"the fixations of {len(missed)} of {len(trials)} trials, such as that of {picture}, are left out, as none "
        "begins while the picture is on the screen (IMGLOAD to TRIAL_RESULT or END)"
    ]
