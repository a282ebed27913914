"""JSON files of COCO-Search18 (Chen et al., 2021), a format that other data sets and models also use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.files import MILLISECONDS, PIXELS, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Fixations, ObjectBox, warn_outside
from semfov.io.schema import Anything, Array, Maybe, Number, Object, Text

_TRIAL = Object(
    {
        "name": Text(),
        "task": Text(),
        "X": PIXELS,
        "Y": PIXELS,
        "T": MILLISECONDS,
        "bbox": Maybe(Array(Number(low=-1e6, high=1e6), 4)),
    },
    others=Anything(),
    required=("name", "X", "Y"),
)
_FILE = Array(_TRIAL)


def read_cocosearch(
    path: str | PathLike[str],
    *,
    screen: tuple[int, int] = (1680, 1050),
    sizes: Mapping[str, tuple[int, int]] | None = None,
) -> list[Fixations]:
    """Read the trials of a COCO-Search18 file.

    The file is a list of objects with `name`, `X` and `Y`, and optionally `subject`, `task`, `bbox`, `T`, `fixOnTarget`
    and other keys.

    Args:
        path: the file.
        screen: `(width, height)` of the screen in pixels, to which the coordinates refer.
        sizes: `(width, height)` of the pictures by name. Where it is given, trials of these pictures are converted from
            the screen, on which the picture is letterboxed, to pixels of the picture, and other trials are left out.

    Returns:
        One record for each trial, in the order of the file.

    Raises:
        DataError: the content does not have this form; the message names the file, the trial and the field.

    >>> import tempfile
    >>> trial = '{"name": "1.jpg", "subject": 4, "task": "cup", "X": [840, 700.5], "Y": [525, 300], "T": [250, 180]}'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "trials.json")
    ...     _ = path.write_text(f"[{trial}]")
    ...     scanpath = read_cocosearch(path)[0]
    >>> scanpath.target, scanpath.points.tolist()
    ('cup', [[840.0, 525.0], [700.5, 300.0]])
    """
    path, scanpaths = Path(path), []
    for number, trial in enumerate(read_json(path, _FILE)):
        name = f"[{number}] ({trial['name']})"
        points = points_of(path, name, trial["X"], trial["Y"])
        record = Fixations(
            picture=trial["name"],
            subject=str(trial.get("subject", path.stem)),
            points=points,
            size=screen,
            durations=durations_of(path, f"{name}.T", trial.get("T"), len(points)),
            target=trial.get("task"),
            box=_edges(trial.get("bbox")),
            found=_flag(trial.get("fixOnTarget")),
        )
        if sizes is None:
            scanpaths.append(record)
        elif record.picture in sizes:
            scanpaths.append(record.in_picture(sizes[record.picture]))
    return warn_outside(path, scanpaths)


def write_cocosearch(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write scanpaths in the format of COCO-Search18, in pixels of their frames.

    Args:
        path: the file.
        fixations: the scanpaths.

    >>> import tempfile
    >>> import numpy as np
    >>> scanpath = Fixations("1.jpg", "4", np.array([[839.5, 524.5]]), (1680, 1050), target="cup")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_cocosearch(Path(folder, "trials.json"), [scanpath])
    ...     read_cocosearch(Path(folder, "trials.json"))[0].target
    'cup'
    """
    trials = []
    for each in fixations:
        trial: dict[str, Any] = {"name": each.picture, "subject": each.subject}
        if each.target is not None:
            trial["task"] = each.target
        if each.box is not None:
            x1, y1, x2, y2 = each.box
            trial["bbox"] = [x1, y1, x2 - x1, y2 - y1]
        trial |= {"X": each.points[:, 0].tolist(), "Y": each.points[:, 1].tolist(), "length": len(each)}
        if each.durations is not None:
            trial["T"] = each.durations.tolist()
        if each.found is not None:
            trial["fixOnTarget"] = each.found
        trials.append(trial)
    write_json(path, trials)


def _edges(box: list[float] | None) -> ObjectBox | None:
    if box is None:
        return None
    left, top, width, height = map(float, box)
    return left, top, left + width, top + height


def _flag(value: object) -> bool | None:
    return value if isinstance(value, bool) else None
