"""JSON files of scanpaths in the format of the visual search benchmark of Travi, Ruarte, Bujia and Kamienkowski."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

from semfov.data.fixations.files import MILLISECONDS, PIXELS, SIDE, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Fixations, ObjectBox, warn_outside
from semfov.errors import DataError, InputError, check
from semfov.io.schema import Anything, Array, Maybe, Number, Object, Text

_EDGE = Number(low=-1e6, high=1e6)
_TRIAL = Object(
    {
        "X": PIXELS,
        "Y": PIXELS,
        "T": MILLISECONDS,
        "image_height": SIDE,
        "image_width": SIDE,
        "receptive_height": Number(above=0, high=1e6),
        "receptive_width": Number(above=0, high=1e6),
        "target_bbox": Maybe(Array(_EDGE, 4)),
        "target_object": Text(),
        "subject": Text(),
    },
    others=Anything(),
    required=("X", "Y", "image_height", "image_width"),
)
_FILE = Object(others=_TRIAL)


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
    for name, trial in read_json(path, _FILE).items():
        points = points_of(path, name, trial["X"], trial["Y"])
        size = (int(trial["image_width"]), int(trial["image_height"]))
        cells = trial.get("receptive_width") == trial.get("receptive_height") == 1
        flag = trial.get("target_found")
        if flag is not None and not isinstance(flag, bool):
            raise DataError(f"{path}: {name}.target_found: expected true or false, got {flag!r}")
        record = Fixations(
            picture=name,
            subject=subject if subject is not None else trial.get("subject", path.stem),
            points=points,
            size=size,
            durations=durations_of(path, f"{name}.T", trial.get("T"), len(points)),
            target=trial.get("target_object"),
            box=_edges(trial.get("target_bbox"), cells),
            found=flag,
        )
        if screen is not None:
            record = record.resized(screen)
        if sizes is not None:
            if name not in sizes:
                continue
            record = record.in_picture(sizes[name])
        scanpaths.append(record)
    return warn_outside(path, scanpaths)


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
        trial = {
            "subject": each.subject,
            "image_height": height,
            "image_width": width,
            "screen_height": height,
            "screen_width": width,
            "X": each.points[:, 0].tolist(),
            "Y": each.points[:, 1].tolist(),
        }
        if each.durations is not None:
            trial["T"] = each.durations.tolist()
        if each.target is not None:
            trial["target_object"] = each.target
        if each.box is not None:
            x1, y1, x2, y2 = each.box
            trial["target_bbox"] = [y1, x1, y2, x2]
        if each.found is not None:
            trial["target_found"] = each.found
        trials[each.picture] = trial
    write_json(path, trials)


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


def _edges(rows_and_columns: list[float] | None, cells: bool) -> ObjectBox | None:
    if rows_and_columns is None:
        return None
    top, left, bottom, right = map(float, rows_and_columns)
    # The last cell is inside the box, so the box ends where the next cell begins.
    return left, top, right + cells, bottom + cells
