"""Reading and checking JSON files of fixations; errors name the file, the record and the field."""

from __future__ import annotations

import json
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from semfov.data.fixations.record import FixationValues
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular, write_text
from semfov.io.schema import Array as ListOf
from semfov.io.schema import Json, Number

PIXELS = ListOf(Number(low=-1e6, high=1e6), least=1)
"""Coordinates of fixations."""
MILLISECONDS = ListOf(Number(low=0, high=1e9))
"""Durations."""
SIDE = Number(above=0, high=1e6)
"""Width or height of a screen or a picture."""


def read_json(path: str | PathLike[str], kind: Json) -> Any:
    """Read a JSON file and check its content.

    Args:
        path: the file.
        kind: requirements of the content.

    Returns:
        The content.

    Raises:
        DataError: the file cannot be read, is not JSON, or its content does not meet the requirements; the message
            names the file, the record and the field.
    """
    path = Path(path)
    check_regular(path)
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({error}); correct or replace the file") from None
    check_record(kind, path, "", value)
    return value


def check_record(kind: Json, path: Path, name: str, value: Any) -> None:
    """Raise `DataError` unless a value meets requirements; the message names the file, the record and the field."""
    try:
        kind.check(name, value, {})
    except InputError as error:
        raise DataError(f"{path}: {str(error).lstrip('.: ') or 'unexpected content'}") from None


def points_of(path: Path, name: str, x: list[float], y: list[float]) -> FixationValues:
    """Points `(n, 2)` from lists of x and y."""
    if len(x) != len(y):
        raise DataError(f"{path}: {name}: expected as many Y as X, got {len(x)} X and {len(y)} Y")
    return np.stack([np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)], axis=1)


def durations_of(path: Path, name: str, times: list[float] | None, count: int) -> FixationValues | None:
    """The first `count` durations; a scanpath that was cut at its target may have more durations, but not fewer."""
    if times is None:
        return None
    if len(times) < count:
        raise DataError(f"{path}: {name}: expected durations of {count} fixations, got {len(times)}")
    return np.asarray(times[:count], dtype=np.float64)


def write_json(path: str | PathLike[str], value: Any) -> None:
    """Write JSON values atomically."""
    write_text(Path(path), json.dumps(value) + "\n")
