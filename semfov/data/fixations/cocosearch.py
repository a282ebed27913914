"""JSON files of COCO-Search18 (Chen et al., 2021), which others write their scanpaths in too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.data.fixations.files import MILLISECONDS, PIXELS, durations_of, points_of, read_json, write_json
from semfov.data.fixations.record import Box, Fixations
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
    """Trials of COCO-Search18: a list of objects with `name`, `subject`, `task`, `bbox`, `X`, `Y`, `T` and others.

    Args:
        path: the file.
        screen: `(width, height)` in pixels that the coordinates are of.
        sizes: `(width, height)` of the pictures by name; trials of pictures that are here are brought from the screen,
            on which the picture is letterboxed, to pixels of the picture, and the others are left out.

    Raises:
        DataError: something in the file is not so; names the file, the trial and the field.
    """
    path, found = Path(path), []
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
            found.append(record)
        elif record.picture in sizes:
            found.append(record.in_picture(sizes[record.picture]))
    return found


def write_cocosearch(path: str | PathLike[str], fixations: Sequence[Fixations]) -> None:
    """Write scanpaths, in pixels of their frames."""
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


def _edges(box: list[float] | None) -> Box | None:
    if box is None:
        return None
    left, top, width, height = map(float, box)
    return left, top, left + width, top + height


def _flag(value: object) -> bool | None:
    return value if isinstance(value, bool) else None
