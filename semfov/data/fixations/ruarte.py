"""JSON files of scanpaths as the visual search benchmark of Travi, Ruarte, Bujia and Kamienkowski keeps them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path

from semfov.data.fixations.files import MILLISECONDS, PIXELS, SIDE, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Box, Fixations
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
    """Scanpaths of one person or one model: an object with a trial under each picture's name.

    People's are in pixels of the screen, models' in its cells. A trial's target box is rows and columns, first and last
    one; of cells, the last ones belong to it. `T` is longer than `X` where a scanpath was cut at its target.

    Args:
        path: the file.
        screen: `(width, height)` in pixels that all trials are brought to; None leaves each in its own pixels or cells.
        sizes: `(width, height)` of the pictures by name (`coco_name` leads to COCO's); trials of pictures that are here
            are brought to pixels of the picture, and the others are left out.
        subject: who looked; None: as the file says.

    Raises:
        DataError: something in the file is not so; names the file, the trial and the field.
    """
    path, found = Path(path), []
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
        found.append(record)
    return found


def write_ruarte(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write the scanpaths of one person or model, one for each picture, in pixels of their frames.

    Raises:
        InputError: a picture has two.
    """
    trials = {}
    for each in fixations:
        check(each.picture not in trials, "fixations", "one scanpath for each picture", f"two for {each.picture}")
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
    """COCO's name of a picture that the benchmark uses for a second target and then counts up in its first digit.

    >>> coco_name("100000298773.jpg"), coco_name("000000000164.jpg")
    ('000000298773.jpg', '000000000164.jpg')
    """
    if not re.fullmatch(r"\d{12}\.jpg", name):
        raise InputError(f"name: expected one such as '100000298773.jpg', got {name!r}")
    return "0" + name[1:]


def _edges(rows_and_columns: list[float] | None, cells: bool) -> Box | None:
    if rows_and_columns is None:
        return None
    top, left, bottom, right = map(float, rows_and_columns)
    # The last cell ends where the next begins.
    return left, top, right + cells, bottom + cells
