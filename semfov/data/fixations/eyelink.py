"""Fixations in the text files of EyeLink trackers (ASC, as edf2asc writes them)."""

import re
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np

from semfov.data.fixations.record import Fixations
from semfov.data.fixations.suspicions import warn_of_frames
from semfov.errors import DataError, check, check_data
from semfov.io.files import read_text

_PICTURE = re.compile(r"^(?:!V IMGLOAD \S+|!V TRIAL_VAR (?:image|picture|img|stimulus))\s+(\S+)", re.IGNORECASE)
_SIDE = r"[\s,]+(-?[\d.]+)"
_FRAME = re.compile(rf"^MSG\s+\S+\s+(?:DISPLAY|GAZE)_COORDS\s*=?{4 * _SIDE}")


def read_eyelink(
    path: str | PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    eye: Literal["left", "right"] | None = None,
    subject: str | None = None,
) -> list[Fixations]:
    r"""Read the fixations of an ASC file of an EyeLink tracker.

    Fixations are the lines `EFIX`, and trials begin with the message `TRIALID`. A trial is of the picture that a
    message `!V IMGLOAD` or `!V TRIAL_VAR image` names, else of the name after `TRIALID`. The frame is that of
    `DISPLAY_COORDS` or `GAZE_COORDS`, from whose first corner the points are counted (EyeLink 1000 User Manual,
    section 4.9). Fixations without a place, and those before the first trial, are left out.

    Args:
        path: the file.
        size: `(width, height)` of the screen; None takes that of the file.
        eye: `left` or `right`; None takes the right one where both were recorded.
        subject: name of the person; None takes that of the file.

    Returns:
        One record for each trial with fixations; convert them by `Fixations.in_picture`.

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
    lines = read_text(path, "cp1252").splitlines()
    trials: list[tuple[str, dict[str, list[tuple[float, float, float]]]]] = []
    frame = next((match for line in lines if (match := _FRAME.match(line))), None)
    x1, y1, x2, y2 = (0.0, 0.0, 0.0, 0.0) if frame is None else map(float, frame.groups())
    for number, line in enumerate(lines, start=1):
        words = line.split()
        try:
            if words[:1] == ["MSG"]:
                message = line.split(None, 2)[2] if len(words) > 2 else ""
                picture = _PICTURE.match(message)
                if message.startswith("TRIALID"):
                    trials.append((message[7:].strip() or f"trial {len(trials) + 1}", {}))
                elif picture is not None and trials:
                    trials[-1] = (picture[1].replace("\\", "/").rpartition("/")[2], trials[-1][1])
            elif words[:1] == ["EFIX"] and trials and "." not in words[5:7]:
                time, x, y = (float(words[place]) for place in (4, 5, 6))
                trials[-1][1].setdefault(words[1][:1], []).append((x - x1, y - y1, time))
        except (ValueError, IndexError):
            raise DataError(f"{path}: line {number}: expected an event of EyeLink, got {line[:60]!r}") from None
    seen = {each for _, eyes in trials for each in eyes}
    check_data(bool(seen), path, "lines EFIX after a message TRIALID", "none; convert the events, too")
    check_data(size is not None or frame is not None, path, "a message DISPLAY_COORDS", "none; give size=")
    size = (round(x2 - x1) + 1, round(y2 - y1) + 1) if size is None else size
    chosen = eye[0].upper() if eye is not None else "R" if "R" in seen else "L"
    name = path.stem if subject is None else subject
    records = []
    for picture_name, eyes in trials:
        rows = np.array(eyes.get(chosen, []), dtype=np.float64)
        if len(rows):
            records.append(Fixations(picture_name, name, rows[:, :2], size, durations=rows[:, 2]))
    check_data(bool(records), path, f"fixations of the {eye} eye", "those of the other one")
    return warn_of_frames(path, records)
