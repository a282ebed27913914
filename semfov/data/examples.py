"""Example pictures: the embedded photographs by their names, and a sheet of all of them."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from semfov.data.classes import canonical_name
from semfov.data.scene import Scene
from semfov.data.scenes import CLASSES, PHOTOGRAPHS, EmbeddedScenes
from semfov.errors import InputError, lookup

_MARGIN = 40  # pixels of paper around the photographs
_PAPER = 0.95  # its lightness

EXAMPLES = (*(photograph.name for photograph in PHOTOGRAPHS), "sheet")
"""Names of the example pictures."""


def example(name: str) -> Tensor:
    """Read an example picture, which comes with the package.

    The examples are photographs from Flickr Commons without known copyright restrictions, and one large picture, a
    sheet of them.

    Args:
        name: `beach`, `market`, `lifeboat`, `aeroplane`, `farm` or `sheet`.

    Returns:
        The picture, `(3, H, W)`, RGB in [0, 1].

    Raises:
        InputError: there is no such example.

    >>> example("market").shape, example("sheet").shape
    (torch.Size([3, 407, 500]), torch.Size([3, 1026, 1760]))
    """
    return example_scene(name, CLASSES).image


def example_scene(name: str, classes: Sequence[str]) -> Scene:
    """Read an example picture, and the objects of the detector's classes in it.

    Args:
        name: as for `example`.
        classes: names of the detector's classes.

    Returns:
        The scene.
    """
    number = EXAMPLES.index(lookup(name, EXAMPLES, "example"))
    if name == "sheet":
        return sheet(classes)
    return EmbeddedScenes(classes, count=len(PHOTOGRAPHS))[number]


def sheet(classes: Sequence[str]) -> Scene:
    """Compose a sheet of all photographs, in two rows on white paper, with the boxes of single objects.

    Args:
        classes: names of the detector's classes.

    Returns:
        The sheet as one scene.
    """
    scenes = EmbeddedScenes(classes, count=len(PHOTOGRAPHS))
    prints = [_single(scenes, index) for index in range(len(scenes))]
    rows = [prints[0::2], prints[1::2]]
    width = max(_width(row) + _MARGIN * (len(row) + 1) for row in rows)
    height = sum(_height(row) for row in rows) + _MARGIN * (len(rows) + 1)
    paper = torch.full((3, height, width), _PAPER)
    boxes: list[Tensor] = []
    labels: list[Tensor] = []
    top = _MARGIN
    for row in rows:
        for scene, left in zip(row, _lefts(row, width), strict=True):
            right = left + scene.size[0]
            bottom = top + scene.size[1]
            paper[:, top:bottom, left:right] = scene.image
            boxes.append(scene.boxes + torch.tensor([left, top, left, top]))
            labels.append(scene.labels)
        top += _height(row) + _MARGIN
    return Scene("sheet", "sheet", paper, torch.cat(boxes), torch.cat(labels))


def _lefts(row: Sequence[Scene], width: int) -> list[int]:
    """Place the pictures of a row, with the same gap between all of them and at both ends; returns their left edges."""
    gap = (width - _width(row)) // (len(row) + 1)
    return [gap + _width(row[:number]) + gap * number for number in range(len(row))]


def _width(row: Sequence[Scene]) -> int:
    """Sum the widths of pictures."""
    return sum(scene.size[0] for scene in row)


def _height(row: Sequence[Scene]) -> int:
    """Find the height of the highest picture."""
    return max(scene.size[1] for scene in row)


def _single(scenes: EmbeddedScenes, index: int) -> Scene:
    """Read a scene without the boxes of crowds."""
    annotation = scenes.annotation(index)
    singles = annotation.take(~annotation.crowd)
    return replace(scenes[index], boxes=singles.boxes, labels=singles.labels)


def example_with(target: str | None, classes: Sequence[str]) -> str:
    """Return the name of the first example photograph that shows an object of a class.

    Args:
        target: name of the class; None for any photograph.
        classes: names of the detector's classes.

    Returns:
        Name of the example.

    Raises:
        InputError: no photograph shows the class.
    """
    if target is None:
        return PHOTOGRAPHS[0].name
    shown = set()
    for photograph in PHOTOGRAPHS:
        names = {CLASSES[label - 1] for label in photograph.objects.labels}
        if canonical_name(target) in names:
            return photograph.name
        shown |= names
    known = sorted({name for name in classes if canonical_name(name) in shown})
    raise InputError(
        f"target: expected a class in the pictures that come with semfov ({', '.join(known)}), got {target!r}; give a "
        f"photograph to search for it"
    )
