"""Fixations of OSIE (Xu et al., 2014) as JSON: 15 people, three seconds, pictures of 800 × 600 pixels."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.files import MILLISECONDS, PIXELS, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Fixations, by_picture
from semfov.errors import check
from semfov.io.schema import Array, Object

_FILE = Object(others=Array(Object({"x": PIXELS, "y": PIXELS, "duration_ms": MILLISECONDS}, required=("x", "y"))))


def read_osie(path: str | PathLike[str], *, size: tuple[int, int] = (800, 600)) -> list[Fixations]:
    """Free viewing: an object with a list under each picture's name, in which each person has `x`, `y`, `duration_ms`.

    People are numbered from 1 in the order of the list. The data set itself is a MATLAB file with the same in it.

    Args:
        path: the file.
        size: `(width, height)` of the pictures.

    Raises:
        DataError: something in the file is not so; names the file, the picture, the person and the field.
    """
    path, found = Path(path), []
    for picture, people in read_json(path, _FILE).items():
        for number, person in enumerate(people):
            name = f"{picture}[{number}]"
            points = points_of(path, name, person["x"], person["y"])
            times = durations_of(path, f"{name}.duration_ms", person.get("duration_ms"), len(points))
            found.append(Fixations(picture, str(number + 1), points, size, times))
    return found


def write_osie(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write free viewing; people stand in the order that they are given in, and all pictures have one size.

    Raises:
        InputError: pictures of different sizes, which the file has no place for.
    """
    check(len({each.size for each in fixations}) <= 1, "fixations", "pictures of one size", "several")
    pictures: dict[str, list[dict[str, Any]]] = {}
    for picture, people in by_picture(fixations).items():
        pictures[picture] = []
        for each in people:
            person: dict[str, Any] = {"x": each.points[:, 0].tolist(), "y": each.points[:, 1].tolist()}
            if each.durations is not None:
                person["duration_ms"] = each.durations.tolist()
            pictures[picture].append(person)
    write_json(path, pictures)
