"""JSON files of fixations: those of COCO-Search18, OSIE, and the benchmark of Travi, Ruarte, Bujia and Kamienkowski."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations, by_picture
from semfov.errors import DataError, InputError, check, check_data
from semfov.human.fixations.suspicions import warn_of_frames
from semfov.io.files import read_json, write_text
from semfov.io.schema import Array, Json, Maybe, Number, Object, Text, check_content

_COORDINATE = Number(low=-1e6, high=1e6)  # far outside any screen, but finite
_COORDINATES = Array(_COORDINATE)
_PIXELS = Array(_COORDINATE, least=1)
_MILLISECONDS = Array(Number(low=0, high=1e9))
_SIDE = Number(above=0, high=1e6)
_BOX = Maybe(Array(_COORDINATE, 4))

_SCREEN = 1680, 1050  # of COCO-Search18

_Edges = tuple[float, float, float, float]
_Stated = TypeVar("_Stated")
_Converted = TypeVar("_Converted")

_COCOSEARCH = Array(
    Object(
        {
            "name": Text(),
            "task": Text(),
            "X": _PIXELS,
            "Y": _PIXELS,
            "T": _MILLISECONDS,
            "bbox": _BOX,
            "width": _SIDE,
            "height": _SIDE,
        },
        others=Json(),
        required=("name", "X", "Y"),
    )
)
_OSIE = Object(
    others=Array(
        Object({"x": _COORDINATES, "y": _COORDINATES, "duration_ms": _MILLISECONDS}, required=("x", "y")),
    )
)
_RUARTE = Object(
    others=Object(
        {
            "X": _PIXELS,
            "Y": _PIXELS,
            "T": _MILLISECONDS,
            "image_height": _SIDE,
            "image_width": _SIDE,
            "receptive_height": _SIDE,
            "receptive_width": _SIDE,
            "target_bbox": _BOX,
            "target_object": Text(),
            "subject": Text(),
        },
        others=Json(),
        required=("X", "Y", "image_height", "image_width"),
    )
)


def read_cocosearch(
    path: str | PathLike[str],
    *,
    screen: tuple[int, int] | None = None,
    sizes: Mapping[str, tuple[int, int]] | None = None,
) -> list[Fixations]:
    """Read the trials of a COCO-Search18 file.

    The file is a list of objects with `name`, `X` and `Y`, and optionally `subject`, `task`, `bbox`, `T`, `fixOnTarget`
    (booleans, or 1 and 0), `width` and `height` (of the frame of the trial), and other keys.

    Args:
        path: the file.
        screen: `(width, height)` of the screen in pixels, to which the coordinates refer, for trials without a `width`
            and a `height`; None takes 1680 × 1050, the data set's.
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
    path = Path(path)
    scanpaths = []
    for number, trial in enumerate(_read(path, _COCOSEARCH)):
        name = f"{path}: [{number}] ({trial['name']})"
        points, durations = _points_and_durations(name, trial, ("X", "Y", "T"))
        scanpath = Fixations(
            picture=trial["name"],
            subject=str(trial.get("subject", path.stem)),
            points=points,
            size=_frame(name, trial, screen),
            durations=durations,
            target=trial.get("task"),
            box=_if_stated(_edges_of, trial.get("bbox")),
            found=_flag(f"{name}.fixOnTarget", trial.get("fixOnTarget")),
        )
        scanpaths.append(scanpath)
    return warn_of_frames(path, _in_pictures(scanpaths, sizes))


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
    for scanpath in fixations:
        trial = {
            "name": scanpath.picture,
            "subject": scanpath.subject,
            "task": scanpath.target,
            "bbox": _if_stated(_bbox_of, scanpath.box),
            "X": scanpath.points[:, 0].tolist(),
            "Y": scanpath.points[:, 1].tolist(),
            "length": len(scanpath),  # which programs for this data set read
            "T": _milliseconds(scanpath),
            "fixOnTarget": scanpath.found,
        }
        trials.append(_without_none(trial))
    write_text(path, json.dumps(trials) + "\n")


OSIE_FRAME = (800, 600)
"""Width and height of the pictures of OSIE, the frame of a file of its form for which no other one is given."""


def read_osie(path: str | PathLike[str], *, size: tuple[int, int] = OSIE_FRAME) -> list[Fixations]:
    """Read free-viewing fixations of OSIE from a JSON file.

    The file is an object with a list under each picture's name. An item of the list has the `x`, `y` and `duration_ms`
    of one person. People are numbered from 1 in the order of the list; one without a fixation is left out. (The data
    set itself is a MATLAB file with the same content.)

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
    path = Path(path)
    scanpaths = []
    for picture, people in _read(path, _OSIE).items():
        for number, person in enumerate(people):
            has_fixation = person["x"] or person["y"]
            if not has_fixation:
                continue
            name = f"{path}: {picture}[{number}]"
            points, durations = _points_and_durations(name, person, ("x", "y", "duration_ms"))
            scanpaths.append(Fixations(picture, str(number + 1), points, size, durations))
    return warn_of_frames(path, scanpaths)


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
    check(len({scanpath.size for scanpath in fixations}) <= 1, "fixations", "pictures of one size", "several sizes")
    pictures: dict[str, list[dict[str, object]]] = {}
    for picture, people in by_picture(fixations).items():
        pictures[picture] = []
        for scanpath in people:
            person = {
                "x": scanpath.points[:, 0].tolist(),
                "y": scanpath.points[:, 1].tolist(),
                "duration_ms": _milliseconds(scanpath),
            }
            pictures[picture].append(_without_none(person))
    write_text(path, json.dumps(pictures) + "\n")


def read_ruarte(
    path: str | PathLike[str],
    *,
    screen: tuple[int, int] | None = None,
    sizes: Mapping[str, tuple[int, int]] | None = None,
    subject: str | None = None,
) -> list[Fixations]:
    """Read the scanpaths of one person or one model.

    The file is an object with a trial under each picture's name. Coordinates of people are in pixels of the screen,
    coordinates of models in cells of the screen. The target box of a trial is `[first row, first column, last row, last
    column]`; in cells, the last row and column are inside the box. `T` is longer than `X` where a scanpath was cut at
    its target.

    Args:
        path: the file.
        screen: `(width, height)` in pixels to which all trials are converted; None leaves each trial in its own pixels
            or cells.
        sizes: `(width, height)` of the pictures by name (`coco_name` gives COCO's name of a picture). Where it is
            given, trials of these pictures are converted to pixels of the picture, and other trials are left out.
        subject: name of the person or model; None for the name in the file.

    Returns:
        One record for each trial.

    Raises:
        DataError: the content does not have this form; the message names the file, the trial and the field.

    >>> import tempfile
    >>> trial = '{"X": [0, 8], "Y": [0, 12], "image_width": 32, "image_height": 24, "target_object": "cup"}'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder, "scanpaths.json")
    ...     _ = path.write_text('{"000000000164.jpg": ' + trial + "}")
    ...     scanpath = read_ruarte(path, screen=(1600, 1200))[0]
    >>> scanpath.target, scanpath.points.tolist()
    ('cup', [[24.5, 24.5], [424.5, 624.5]])
    """
    path = Path(path)
    scanpaths = []
    for picture, trial in _read(path, _RUARTE).items():
        name = f"{path}: {picture}"
        points, durations = _points_and_durations(name, trial, ("X", "Y", "T"))
        is_in_cells = trial.get("receptive_width") == trial.get("receptive_height") == 1
        scanpath = Fixations(
            picture=picture,
            subject=subject if subject is not None else trial.get("subject", path.stem),
            points=points,
            size=(int(trial["image_width"]), int(trial["image_height"])),
            durations=durations,
            target=trial.get("target_object"),
            box=_if_stated(partial(_box_of_rows, int(is_in_cells)), trial.get("target_bbox")),
            found=_flag(f"{name}.target_found", trial.get("target_found")),
        )
        scanpaths.append(scanpath if screen is None else scanpath.resized(screen))
    return warn_of_frames(path, _in_pictures(scanpaths, sizes))


def write_ruarte(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write the scanpaths of one person or model in the format that `read_ruarte` reads, in pixels of their frames.

    Args:
        path: the file.
        fixations: the scanpaths, one for each picture.

    Raises:
        InputError: a picture has two scanpaths.

    >>> import tempfile
    >>> import numpy as np
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_ruarte(Path(folder, "scanpaths.json"), [Fixations("1.jpg", "4", np.zeros((3, 2)), (800, 600))])
    ...     len(read_ruarte(Path(folder, "scanpaths.json"))[0])
    3
    """
    # The file has one trial for each picture.
    trials = {}
    for scanpath in fixations:
        expected = "one scanpath for each picture"
        check(scanpath.picture not in trials, "fixations", expected, f"several for {scanpath.picture}")
        width, height = scanpath.size
        trial = {
            "subject": scanpath.subject,
            "image_height": height,
            "image_width": width,
            "screen_height": height,
            "screen_width": width,
            "X": scanpath.points[:, 0].tolist(),
            "Y": scanpath.points[:, 1].tolist(),
            "T": _milliseconds(scanpath),
            "target_object": scanpath.target,
            "target_bbox": _if_stated(_rows_of_box, scanpath.box),
            "target_found": scanpath.found,
        }
        trials[scanpath.picture] = _without_none(trial)
    write_text(path, json.dumps(trials) + "\n")


def coco_name(name: str) -> str:
    """Find COCO's name of a picture of the benchmark.

    Where the benchmark uses a picture again for a second target, it increases the first digit of its name.

    Args:
        name: name of the picture in the benchmark.

    Returns:
        Name of the picture in COCO.

    Raises:
        InputError: the name does not consist of twelve digits and `.jpg`.

    >>> coco_name("100000298773.jpg"), coco_name("000000000164.jpg")
    ('000000298773.jpg', '000000000164.jpg')
    """
    # COCO's own names begin with 0.
    if not re.fullmatch(r"\d{12}\.jpg", name):
        raise InputError(f"name: expected twelve digits and .jpg, such as '100000298773.jpg', got {name!r}")
    return "0" + name[1:]


def _read(path: Path, kind: Json) -> Any:
    """Read a JSON file; errors name the file, the record and the field."""
    value = read_json(path)
    check_content(path, value, kind)
    return value


def _flag(name: str, value: object) -> bool | None:
    """Read a boolean of a file, or 1 or 0 in its place."""
    check_data(value in (None, True, False), name, "true or false", repr(value))
    return _if_stated(bool, value)


def _without_none(values: Mapping[str, object]) -> dict[str, object]:
    """Take the values that are known, by their keys."""
    return {key: value for key, value in values.items() if value is not None}


def _milliseconds(scanpath: Fixations) -> list[float] | None:
    """List the durations of the fixations; None where they are not known."""
    return None if scanpath.durations is None else scanpath.durations.tolist()


def _if_stated(convert: Callable[[_Stated], _Converted], value: _Stated | None) -> _Converted | None:
    """Convert a value that may be missing, None."""
    return None if value is None else convert(value)


def _edges_of(box: Sequence[float]) -> _Edges:
    """Find the edges x1, y1, x2 and y2 of a box `[x, y, width, height]`."""
    x, y, width, height = box
    return float(x), float(y), float(x + width), float(y + height)


def _bbox_of(box: _Edges) -> list[float]:
    """Write the edges of a box as `[x, y, width, height]`."""
    x1, y1, x2, y2 = box
    return [x1, y1, x2 - x1, y2 - y1]


def _box_of_rows(side: int, box: Sequence[float]) -> _Edges:
    """Find the edges x1, y1, x2 and y2 of a box `[first row, first column, last row, last column]`.

    Args:
        side: 1 where they are numbers of cells, since the last ones are inside the box, which ends where the next
            cells begin; 0 in pixels.
        box: the box.
    """
    top, left, bottom, right = box
    return float(left), float(top), float(right + side), float(bottom + side)


def _rows_of_box(box: _Edges) -> list[float]:
    """Write the edges of a box in pixels as `[first row, first column, last row, last column]`."""
    x1, y1, x2, y2 = box
    return [y1, x1, y2, x2]


def _in_pictures(scanpaths: list[Fixations], sizes: Mapping[str, tuple[int, int]] | None) -> list[Fixations]:
    """Convert scanpaths to pixels of their pictures, without those of other pictures; None leaves all as they are."""
    if sizes is None:
        return scanpaths
    return [scanpath.in_picture(sizes[scanpath.picture]) for scanpath in scanpaths if scanpath.picture in sizes]


def _frame(name: str, trial: Mapping[str, Any], screen: tuple[int, int] | None) -> tuple[int, int]:
    """Find the frame of a trial of COCO-Search18: its own, else the screen."""
    sides = (trial.get("width"), trial.get("height"))
    if sides == (None, None):
        return _SCREEN if screen is None else screen
    width, height = sides
    if width is None or height is None:
        raise DataError(f"{name}: expected both a width and a height, or neither, got {sides}")
    frame = int(width), int(height)
    check_data(frame == sides, name, "a width and a height in whole pixels", sides)
    if screen is not None:
        check_data(tuple(screen) == frame, name, f"{screen}, which is given", frame)
    return frame


def _points_and_durations(
    name: str, trial: Mapping[str, Any], keys: tuple[str, str, str]
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Read the points and durations of a trial.

    Args:
        name: of the trial, for messages.
        trial: with lists of x, y and durations in ms.
        keys: of these lists.

    Returns:
        Points `(n, 2)`, and durations `(n,)`; None without any.

    Raises:
        DataError: the lists do not belong together.
    """
    x = trial[keys[0]]
    y = trial[keys[1]]
    times = trial.get(keys[2])
    check_data(len(x) == len(y), name, "as many Y as X", f"{len(x)} X and {len(y)} Y")
    points = np.array([*zip(x, y, strict=True)], dtype=np.float64)
    if times is None:
        return points, None
    # A scanpath that was cut may have more durations.
    check_data(len(times) >= len(x), f"{name}.{keys[2]}", f"durations of {len(x)} fixations", len(times))
    return points, np.asarray(times[: len(x)], dtype=np.float64)
