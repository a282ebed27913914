"""Names of a detector's classes: COCO's, and outputs that do not stand for a class."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch

from semfov.detection.scores import Candidates
from semfov.errors import InputError, check

_NAMES = """
person, bicycle, car, motorcycle, airplane, bus, train, truck, boat, traffic light,
fire hydrant, stop sign, parking meter, bench, bird, cat, dog, horse, sheep, cow,
elephant, bear, zebra, giraffe, backpack, umbrella, handbag, tie, suitcase, frisbee,
skis, snowboard, sports ball, kite, baseball bat, baseball glove, skateboard, surfboard, tennis racket, bottle,
wine glass, cup, fork, knife, spoon, bowl, banana, apple, sandwich, orange,
broccoli, carrot, hot dog, pizza, donut, cake, chair, couch, potted plant, bed,
dining table, toilet, tv, laptop, mouse, remote, keyboard, cell phone, microwave, oven,
toaster, sink, refrigerator, book, clock, vase, scissors, teddy bear, hair drier, toothbrush
"""

COCO_CLASSES: tuple[str, ...] = tuple(name.strip() for name in _NAMES.split(","))

COCO_CATEGORIES = 91
"""Number of COCO's category ids: background, the 80 classes, and ids that stand for nothing."""


_PLACEHOLDERS = ("", "n/a", "none", "null", "background", "__background__", "no object", "no-object")
"""Names of outputs that do not stand for a class, in lower case: gaps in COCO's category ids, and background."""


NAMING = "give them by classes=cat,dog, or in classes.txt beside the file"
"""How names are given to a model that has none."""

_Name = TypeVar("_Name")


class UnnamedClasses(InputError):
    """The error of a model with scores of some classes, and no names for them; `count` is the number of the classes."""

    def __init__(self, count: int, file: Path, beside: Sequence[str] | None) -> None:
        got = "None" if beside is None else f"{len(beside)} names in a file beside it"
        super().__init__(
            f"classes: expected the names of the {count} classes of {file.name} in the order of its scores, got {got}; "
            f"give them by classes=cat,dog, as the list “classes” in {file.with_suffix('.json')}, or in classes.txt "
            "beside it"
        )
        self.count = count


def coco_categories() -> list[str]:
    """List the names of COCO's category ids, as outputs of models that are numbered by them.

    Returns:
        The names, background first, with placeholders where an id stands for nothing.
    """
    from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights  # takes seconds to import

    return FasterRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]


def names_in_order(names: Mapping[object, _Name]) -> list[_Name] | None:
    """List names in the order of their numbers.

    Args:
        names: by numbers from 0, which may be text, as in JSON.

    Returns:
        The names; None where their keys are other ones.

    >>> names_in_order({"1": "dog", "0": "cat"})
    ['cat', 'dog']
    """
    by_number = {str(number): name for number, name in names.items()}
    numbers = list(map(str, range(len(by_number))))
    if by_number.keys() != set(numbers):
        return None
    return [by_number[number] for number in numbers]


def without_placeholders(names: Sequence[str]) -> list[str]:
    """Drop the names of outputs that do not represent a class.

    >>> without_placeholders(["background", "cat"])
    ['cat']
    """
    return [name for name in names if name.lower() not in _PLACEHOLDERS]


def named_outputs(classes: Sequence[str]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Find the names that stand for a class; a whole number is a name, too.

    Args:
        classes: a name for each score of a head.

    Returns:
        The names without placeholders, and their places among the scores.

    Raises:
        InputError: they are no names, or two classes have one.
    """
    wrong = [name for name in classes if not _may_be_name(name)]
    remedy = "YAML reads no, off, yes and on so: put names in quotes, or give classes="
    check(not wrong, "classes", "names", f"{wrong[:3]}; {remedy}")
    names = [str(name).strip() for name in classes]
    by_place = {place: name for place, name in enumerate(names) if name.lower() not in _PLACEHOLDERS}
    named = tuple(by_place.values())
    are_distinct = len(set(named)) == len(named)
    check(are_distinct and bool(named), "classes", "at least one name, all different", named)
    return named, tuple(by_place)


def _may_be_name(name: object) -> bool:
    """Tell whether a value of a list of names is a text, a whole number, or None for a gap."""
    # True and False are whole numbers for Python.
    return isinstance(name, str | int | None) and not isinstance(name, bool)


def keep_classes(candidates: Candidates, places: Sequence[int], count: int) -> Candidates:
    """Keep the scores that stand for a class.

    Args:
        candidates: boxes with all scores of a head.
        places: places of the scores to keep.
        count: number of the names that were given for the scores.

    Returns:
        The boxes with these scores.

    Raises:
        InputError: the head has another number of scores.
    """
    channels = candidates.classes.shape[-1]
    check(channels == count, "classes", f"{channels} names, one for each score of the head", count)
    if len(places) == count:
        return candidates
    index = torch.tensor(places, device=candidates.classes.device)
    return replace(candidates, classes=candidates.classes.index_select(-1, index))
