"""Fixations of OSIE (Xu et al., 2014) as JSON: 15 people, three seconds, pictures of 800 × 600 pixels."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.files import MILLISECONDS, PIXELS, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Fixations, by_picture, warn_outside
from semfov.errors import check
from semfov.io.schema import Array, Object

_FILE = Object(others=Array(Object({"x": PIXELS, "y": PIXELS, "duration_ms": MILLISECONDS}, required=("x", "y"))))


def read_osie(path: str | PathLike[str], *, size: tuple[int, int] = (800, 600)) -> list[Fixations]:
    """Read free-viewing fixations of OSIE from a JSON file.

    The file is an object with a list under each picture's name. An item of the list has the `x`, `y` and `duration_ms`
    of one person. People are numbered from 1 in the order of the list. (The data set itself is a MATLAB file with the
    same content.)

    Args:
        path: the file.
        size: `(width, height)` of the pictures.

    Returns:
        One record for each picture and person.

    Raises:
        DataError: the content does not have this form; the message names the file, the picture, the person and the
            field.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "osie.json")
    ...     _ = path.write_text('{"1001.jpg": [{"x": [400, 350], "y": [300, 290], "duration_ms": [210, 180]}]}')
    ...     scanpath = read_osie(path)[0]
    >>> scanpath.picture, scanpath.subject, scanpath.durations.tolist()
    ('1001.jpg', '1', [210.0, 180.0])
    """
    path, scanpaths = Path(path), []
    for picture, people in read_json(path, _FILE).items():
        for number, person in enumerate(people):
            name = f"{picture}[{number}]"
            points = points_of(path, name, person["x"], person["y"])
            times = durations_of(path, f"{name}.duration_ms", person.get("duration_ms"), len(points))
            scanpaths.append(Fixations(picture, str(number + 1), points, size, times))
    return warn_outside(path, scanpaths)


def write_osie(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write free-viewing fixations in the format that `read_osie` reads.

    Args:
        path: the file.
        fixations: records of pictures of one size; the people of a picture are written in the order given.

    Raises:
        InputError: the pictures have different sizes, for which the file has no field.

    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_osie(Path(folder, "osie.json"), [Fixations("1001.jpg", "7", np.zeros((3, 2)), (800, 600))])
    ...     len(read_osie(Path(folder, "osie.json"))[0])
    3
    """
    check(len({each.size for each in fixations}) <= 1, "fixations", "pictures of one size", "several sizes")
    pictures: dict[str, list[dict[str, Any]]] = {}
    for picture, people in by_picture(fixations).items():
        pictures[picture] = []
        for each in people:
            person: dict[str, Any] = {"x": each.points[:, 0].tolist(), "y": each.points[:, 1].tolist()}
            if each.durations is not None:
                person["duration_ms"] = each.durations.tolist()
            pictures[picture].append(person)
    write_json(path, pictures)
