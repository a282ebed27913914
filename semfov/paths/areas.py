"""Areas of a picture and the share of fixations in them: named boxes, and the smallest areas with a given share."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from semfov.errors import InputError, check, printable
from semfov.io.files import read_json

Area = tuple[float, float, float, float]
"""Left, top, right and bottom edge of a box, in pixels of the picture."""

Boxes = Mapping[str, Sequence[float]]
"""Boxes by name."""

AreasLike = Boxes | Mapping[str, Boxes] | str | PathLike[str]
"""Boxes by name; the same for each picture by its name, where they lie elsewhere in each; a text such as
`logo:10,20,200,80 price:300,40,420,90`; or a JSON file of one of the first two."""

_MOST = 100  # areas of a picture
_LONGEST = 60  # letters of a name
_NUMBER = r"-?\d+(?:\.\d+)?"
_FORM = "areas by name as NAME:LEFT,TOP,RIGHT,BOTTOM, with blanks between them, or a file .json"


def read_areas(areas: AreasLike, size: tuple[int, int], names: Sequence[str] = ()) -> dict[str, Area]:
    """Read areas of interest, and check that they lie in a picture.

    Args:
        areas: boxes by name, as left, top, right and bottom edge in pixels; the same by picture; a text; or a file.
        size: `(width, height)` of the picture in pixels.
        names: names of the picture, if the boxes are given by picture.

    Returns:
        The boxes by name, in their order.

    Raises:
        InputError: an area has another form, is empty or reaches out of the picture, or there are none for the picture.
        DataError: the file cannot be read.

    >>> read_areas("logo:10,20,200,80 price:300,40,420,90", (640, 480))
    {'logo': (10.0, 20.0, 200.0, 80.0), 'price': (300.0, 40.0, 420.0, 90.0)}
    >>> read_areas({"a.png": {"logo": (10, 20, 200, 80)}, "b.png": {"logo": (9, 9, 99, 99)}}, (640, 480), ["a.png"])
    {'logo': (10.0, 20.0, 200.0, 80.0)}
    """
    boxes: Mapping[str, object] = boxes_of(areas)
    if boxes and all(map(_holds_boxes, boxes.values())):
        boxes = _boxes_in_picture(boxes, names)
    check(0 < len(boxes) <= _MOST, "areas", f"1 to {_MOST} areas by name", len(boxes))
    return {name: _checked(name, box, size) for name, box in boxes.items()}


def _holds_boxes(value: object) -> bool:
    """Tell whether a value holds boxes by name, and is not a box whose edges have names."""
    return isinstance(value, Mapping) and not any(isinstance(edge, Real) for edge in value.values())


def _boxes_in_picture(boxes_by_picture: Mapping[str, object], names: Sequence[str]) -> Mapping[str, object]:
    """Find the boxes of the picture with one of these names."""
    for name in names:
        boxes = boxes_by_picture.get(name)
        if isinstance(boxes, Mapping):
            return boxes
    expected = f"boxes for {' or '.join(dict.fromkeys(names))}"
    raise InputError(f"areas: expected {expected}, got those of {', '.join(map(repr, boxes_by_picture))}")


def boxes_of(areas: AreasLike) -> Boxes | Mapping[str, Boxes]:
    """Read the boxes by name from what a caller gave; `read_areas` checks them for a picture.

    Args:
        areas: as for `read_areas`.

    Returns:
        The boxes by name, or those of each picture by its name.

    Raises:
        InputError: the text or the content of the file has another form.
        DataError: the file cannot be read.
    """
    if isinstance(areas, str) and not areas.lower().endswith(".json"):
        return _parsed(areas)
    if isinstance(areas, str | PathLike):
        path = Path(areas)
        # Of two areas of one name, the last one would replace the first without a word.
        content = read_json(path, unique=True)
        check(isinstance(content, dict), f"areas ({path})", 'boxes by name, {"logo": [10, 20, 200, 80]}', content)
        return dict(content)
    check(isinstance(areas, Mapping), "areas", "a mapping of names to boxes, a text or a file .json", areas)
    return areas


def _parsed(text: str) -> dict[str, Sequence[float]]:
    """Read a text of areas."""
    boxes: dict[str, Sequence[float]] = {}
    for word in text.split():
        name, _, numbers = word.rpartition(":")
        is_written = name != "" and re.fullmatch(rf"{_NUMBER}(,{_NUMBER}){{3}}", numbers) is not None
        check(is_written, "areas", _FORM, repr(word))
        check(name not in boxes, "areas", "a name for each area", f"{name!r} twice")
        boxes[name] = [float(number) for number in numbers.split(",")]
    return boxes


def _checked(name: object, box: object, size: tuple[int, int]) -> Area:
    """Check name and edges of an area.

    Args:
        name: a short text that can be printed.
        box: left, top, right and bottom edge in pixels.
        size: `(width, height)` of the picture in pixels.
    """
    is_named = isinstance(name, str) and 0 < len(name) <= _LONGEST and name == printable(name)
    check(is_named, "areas", f"names of 1 to {_LONGEST} letters", repr(name)[:80])
    argument = f"areas[{name!r}]"
    edges = _numbers_of(box)
    if edges is None or len(edges) != 4:
        form = "four numbers: left, top, right and bottom edge in pixels"
        raise InputError(f"{argument}: expected {form}, got {box} (right = left + width)")
    left, top, right, bottom = edges
    width, height = size
    lies_inside = 0 <= left < right <= width and 0 <= top < bottom <= height
    inside = f"left < right and top < bottom in a picture of {width} × {height} px (right = left + width)"
    check(lies_inside, argument, inside, f"{left:g},{top:g},{right:g},{bottom:g}")
    return left, top, right, bottom


def _numbers_of(box: object) -> list[float] | None:
    """Convert what should be a sequence of numbers; None if it is something else."""
    if not isinstance(box, Sequence) or isinstance(box, str):
        return None
    try:
        return [float(edge) for edge in box]
    except (TypeError, ValueError):
        return None


def share_in(density: Tensor, area: Area) -> float:
    """Sum a density over an area; pixels that it covers in part count in part.

    Args:
        density: `(H, W)`, probability of a fixation in each pixel.
        area: left, top, right and bottom edge, in pixels.

    Returns:
        The probability of a fixation in the area.

    >>> round(share_in(torch.full((4, 5), 0.05), (0.5, 1, 2.5, 3)), 6)
    0.2
    """
    left, top, right, bottom = area
    height, width = density.shape
    rows = _covered(height, top, bottom)  # (H,)
    columns = _covered(width, left, right)  # (W,)
    return float(rows @ density.double() @ columns)


def _covered(length: int, start: float, end: float) -> Tensor:
    """Compute the share of each pixel of a line that lies between two edges, `(length,)`."""
    first = torch.arange(length, dtype=torch.float64)
    return (first + 1).clamp(max=end).sub(first.clamp(min=start)).clamp(min=0)


def shares_around(density: Tensor) -> Tensor:
    """Compute for each cell the share of fixations in the smallest area that reaches it.

    The smallest area with a share of the fixations has the cells with the highest density.

    Args:
        density: `(rows, columns)`, with sum 1.

    Returns:
        `(rows, columns)`, from the density of the highest cell to 1.

    >>> shares_around(torch.tensor([[0.1, 0.6], [0.3, 0.0]]))
    tensor([[1.0000, 0.6000],
            [0.9000, 1.0000]])
    """
    values, order = density.flatten().sort(descending=True, stable=True)
    shares = torch.empty_like(values)
    shares[order] = values.cumsum(0)
    return shares.view_as(density)


def border_of(density: Tensor, share: float) -> float:
    """Find the density at the border of the smallest area with a share of the fixations.

    Args:
        density: `(rows, columns)`, with sum 1.
        share: from 0 to 1.

    Returns:
        The density of the last cell that belongs to the area.

    >>> round(border_of(torch.tensor([[0.1, 0.6], [0.3, 0.0]]), 0.7), 3)
    0.3
    """
    ordered = density.flatten().double().sort(descending=True).values
    last = int(torch.searchsorted(ordered.cumsum(0), share))
    # Rounding can leave the sum of all cells below a share of 1.
    return float(ordered[min(last, len(ordered) - 1)])


def percentage_points(difference: float) -> str:
    """Write the difference of two shares in percentage points, with its sign.

    >>> percentage_points(0.0123), percentage_points(-0.048), percentage_points(-0.0001)
    ('+1.2', '\N{MINUS SIGN}4.8', '+0.0')
    """
    rounded = round(100 * difference, 1) + 0.0  # which has no negative zero
    return f"{rounded:+.1f}".replace("-", "\N{MINUS SIGN}")


def percent(share: float) -> str:
    """Write a share in percent, without a decimal from one percent on.

    >>> percent(0.316), percent(0.0042)
    ('32 %', '0.4 %')
    """
    return f"{100 * share:.0f} %" if share >= 0.01 or share == 0 else f"{100 * share:.1f} %"
