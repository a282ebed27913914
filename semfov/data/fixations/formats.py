"""JSON files of fixations: those of COCO-Search18, OSIE, and the benchmark of Travi, Ruarte, Bujia and Kamienkowski."""

import json
import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from semfov.data.fixations.record import Fixations, by_picture
from semfov.data.fixations.suspicions import warn_of_frames
from semfov.errors import InputError, check, check_data
from semfov.io.files import read_json, write_text
from semfov.io.schema import Array, Json, Maybe, Number, Object, Text, check_content

_PIXELS = Array(Number(low=-1e6, high=1e6), least=1)
_MILLISECONDS = Array(Number(low=0, high=1e9))
_SIDE = Number(above=0, high=1e6)
_SCREEN = 1680, 1050  # of COCO-Search18
_BOX = Maybe(Array(Number(low=-1e6, high=1e6), 4))

_COCOSEARCH = Array(
    Object(
        {
            **{"name": Text(), "task": Text(), "X": _PIXELS, "Y": _PIXELS, "T": _MILLISECONDS, "bbox": _BOX},
            **dict.fromkeys(("width", "height"), _SIDE),
        },
        others=Json(),
        required=("name", "X", "Y"),
    )
)
_SOME = Array(Number(low=-1e6, high=1e6))
_OSIE = Object(others=Array(Object({"x": _SOME, "y": _SOME, "duration_ms": _MILLISECONDS}, required=("x", "y"))))
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
    path, scanpaths = Path(path), []
    for number, trial in enumerate(_read(path, _COCOSEARCH)):
        box = trial.get("bbox")
        name = f"[{number}] ({trial['name']})"
        record = _record(
            path,
            name,
            trial,
            picture=trial["name"],
            subject=str(trial.get("subject", path.stem)),
            size=_frame(f"{path}: {name}", trial, screen),
            target=trial.get("task"),
            box=None if box is None else tuple(map(float, (box[0], box[1], box[0] + box[2], box[1] + box[3]))),
            found=_flag(f"{path}: {name}.fixOnTarget", trial.get("fixOnTarget")),
        )
        scanpaths.append(record)
    if sizes is not None:
        scanpaths = [each.in_picture(sizes[each.picture]) for each in scanpaths if each.picture in sizes]
    return warn_of_frames(path, scanpaths)


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
        x1, y1, x2, y2 = each.box or (0.0, 0.0, 0.0, 0.0)
        trial = {
            "name": each.picture,
            "subject": each.subject,
            "task": each.target,
            "bbox": None if each.box is None else [x1, y1, x2 - x1, y2 - y1],
            "X": each.points[:, 0].tolist(),
            "Y": each.points[:, 1].tolist(),
            "length": len(each),
            "T": None if each.durations is None else each.durations.tolist(),
            "fixOnTarget": each.found,
        }
        trials.append({key: value for key, value in trial.items() if value is not None})
    write_text(path, json.dumps(trials) + "\n")


def read_osie(path: str | PathLike[str], *, size: tuple[int, int] = (800, 600)) -> list[Fixations]:
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
    path, scanpaths = Path(path), []
    for picture, people in _read(path, _OSIE).items():
        for number, person in enumerate(people):
            who = {"picture": picture, "subject": str(number + 1), "size": size}
            if person["x"] or person["y"]:
                scanpaths.append(_record(path, f"{picture}[{number}]", person, ("x", "y", "duration_ms"), **who))
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
    check(len({each.size for each in fixations}) <= 1, "fixations", "pictures of one size", "several sizes")
    pictures: dict[str, list[dict[str, Any]]] = {}
    for picture, people in by_picture(fixations).items():
        for each in people:
            times = {} if each.durations is None else {"duration_ms": each.durations.tolist()}
            person = {"x": each.points[:, 0].tolist(), "y": each.points[:, 1].tolist(), **times}
            pictures.setdefault(picture, []).append(person)
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
    path, scanpaths = Path(path), []
    for name, trial in _read(path, _RUARTE).items():
        # In cells, the last row and column are inside the box, which ends where the next cell begins.
        cells = trial.get("receptive_width") == trial.get("receptive_height") == 1
        box = trial.get("target_bbox")
        record = _record(
            path,
            name,
            trial,
            picture=name,
            subject=subject if subject is not None else trial.get("subject", path.stem),
            size=(int(trial["image_width"]), int(trial["image_height"])),
            target=trial.get("target_object"),
            box=None if box is None else tuple(map(float, (box[1], box[0], box[3] + cells, box[2] + cells))),
            found=_flag(f"{path}: {name}.target_found", trial.get("target_found")),
        )
        scanpaths.append(record if screen is None else record.resized(screen))
    if sizes is not None:
        scanpaths = [each.in_picture(sizes[each.picture]) for each in scanpaths if each.picture in sizes]
    return warn_of_frames(path, scanpaths)


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
    trials = {}
    for each in fixations:
        expected = "one scanpath for each picture"
        check(each.picture not in trials, "fixations", expected, f"several for {each.picture}")
        width, height = each.size
        x1, y1, x2, y2 = each.box or (0.0, 0.0, 0.0, 0.0)
        trial = {
            "subject": each.subject,
            "image_height": height,
            "image_width": width,
            "screen_height": height,
            "screen_width": width,
            "X": each.points[:, 0].tolist(),
            "Y": each.points[:, 1].tolist(),
            "T": None if each.durations is None else each.durations.tolist(),
            "target_object": each.target,
            "target_bbox": None if each.box is None else [y1, x1, y2, x2],
            "target_found": each.found,
        }
        trials[each.picture] = {key: value for key, value in trial.items() if value is not None}
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
    if not re.fullmatch(r"\d{12}\.jpg", name):
        raise InputError(f"name: expected twelve digits and .jpg, such as '100000298773.jpg', got {name!r}")
    return "0" + name[1:]


def _read(path: Path, kind: Json) -> Any:
    """The content of a JSON file; errors name the file, the record and the field."""
    value = read_json(path)
    check_content(path, value, kind)
    return value


def _flag(where: str, value: Any) -> bool | None:
    """A boolean of a file, or 1 or 0 in its place."""
    check_data(value is None or value in (True, False), where, "true or false", repr(value))
    return None if value is None else bool(value)


def _frame(where: str, trial: Mapping[str, Any], screen: tuple[int, int] | None) -> tuple[int, int]:
    """The frame of a trial of COCO-Search18: its own, else the screen."""
    own = trial.get("width"), trial.get("height")
    if own == (None, None):
        return _SCREEN if screen is None else screen
    check_data(None not in own, where, "both a width and a height, or neither", own)
    frame = int(own[0]), int(own[1])  # type: ignore[arg-type]  # which are not None
    check_data(frame == own, where, "a width and a height in whole pixels", own)
    check_data(screen is None or (*screen,) == frame, where, f"{screen}, which is given", frame)
    return frame


def _record(
    path: Path, name: str, trial: Mapping[str, Any], keys: tuple[str, str, str] = ("X", "Y", "T"), **fields: Any
) -> Fixations:
    """The record of a trial with lists of x, y and durations; a scanpath that was cut may have more durations."""
    x, y, times = trial[keys[0]], trial[keys[1]], trial.get(keys[2])
    count, most = len(x), len(x) if times is None else len(times)
    check_data(count == len(y), f"{path}: {name}", "as many Y as X", f"{count} X and {len(y)} Y")
    check_data(most >= count, f"{path}: {name}.{keys[2]}", f"durations of {count} fixations", most)
    durations = None if times is None else np.asarray(times[:count], dtype=np.float64)
    return Fixations(points=np.array([*zip(x, y, strict=True)], dtype=np.float64), durations=durations, **fields)
