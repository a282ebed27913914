"""Names of a detector's classes, and the places in its output that stand for no class."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from semfov.detection.scores import Candidates
from semfov.errors import check

PLACEHOLDERS = ("", "N/A", "__background__")
"""Names of outputs that no object has: COCO's category ids have gaps, and heads count background in."""


def named(classes: Sequence[str]) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """The names that stand for a class, and where they stand.

    >>> named(["__background__", "cat", "N/A", "dog"])
    (('cat', 'dog'), (1, 3))
    """
    places = tuple(index for index, name in enumerate(classes) if name not in PLACEHOLDERS)
    names = tuple(classes[index] for index in places)
    check(len(set(names)) == len(names) > 0, "classes", "names that differ", names)
    return names, places


def keep_classes(candidates: Candidates, places: Sequence[int], count: int) -> Candidates:
    """Candidates with the scores at `places` only, of `count` that a head is expected to give."""
    channels = candidates.classes.shape[-1]
    check(channels == count, "classes", f"{channels} names, as many as the head has scores", count)
    if len(places) == count:
        return candidates
    index = torch.tensor(places, device=candidates.classes.device)
    return replace(candidates, classes=candidates.classes.index_select(-1, index))
