"""Conversion of detections to other libraries (Supervision, COCO results) and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index
from typing import TYPE_CHECKING, SupportsIndex, TypedDict, cast

import numpy as np
import torch
from torch import Tensor

from semfov.data.classes import canonical_name, class_indices
from semfov.errors import InputError, check, needing
from semfov.io.tables import digits, pixels

if TYPE_CHECKING:
    import supervision


Category = Mapping[str, object]
"""A category of a COCO file, with `id` and `name`."""


class CocoResult(TypedDict):
    """A detection in COCO's format of results; boxes are `[x, y, width, height]` in pixels."""

    image_id: int | str
    category_id: int | str
    bbox: list[float]
    score: float


def named_detections(
    boxes: Tensor,
    labels: Tensor,
    scores: Tensor,
    classes: Sequence[str] | None,
    data: Mapping[str, object],
    track_ids: Tensor | None = None,
) -> supervision.Detections:
    """Make `supervision.Detections` of boxes.

    Args:
        boxes: `(L, 4)`, corners in pixels.
        labels: `(L,)`, classes from 1; Supervision counts from 0.
        scores: `(L,)`.
        classes: names of the classes, without background; None leaves them out.
        data: further data of the boxes by name.
        track_ids: `(L,)`, numbers of the objects of a stream; None without.

    Returns:
        The detections for Supervision.
    """
    numbers = (labels - 1).numpy()
    with needing("supervision", "supervision"):
        from supervision import Detections
    data = dict(data)
    if classes is not None:
        data["class_name"] = np.array([classes[number] for number in numbers.tolist()], dtype=str)
    tracker_id = None if track_ids is None else track_ids.numpy()
    return Detections(boxes.numpy(), None, scores.numpy(), numbers, tracker_id, data=data)


def coco_results(
    image_id: int | str,
    boxes: Tensor,
    labels: Tensor,
    scores: Tensor,
    ids: Mapping[int, int | str],
) -> list[CocoResult]:
    """Make COCO results of boxes.

    Args:
        image_id: id of the image.
        boxes: `(L, 4)`, corners in pixels.
        labels: `(L,)`, classes 1..K.
        scores: `(L,)`.
        ids: category id of each class.

    Returns:
        A result for each box.
    """
    check(_is_id(image_id), "image_id", "the whole number of an image, or text", repr(image_id))
    image_id = _plain_id(image_id)
    size = boxes[:, 2:] - boxes[:, :2]
    bboxes = torch.cat([boxes[:, :2], size], -1).double()  # left upper corner, width and height
    results: list[CocoResult] = []
    for label, bbox, score in zip(labels.tolist(), bboxes.tolist(), scores.double().tolist(), strict=True):
        results.append(
            {
                "image_id": image_id,
                "category_id": ids[label],
                "bbox": [pixels(number) for number in bbox],
                "score": digits(score),
            }
        )
    return results


def category_ids(
    categories: Sequence[int | str] | Sequence[Category], classes: Sequence[str] | None = None
) -> list[int | str]:
    """Find the category id of each class.

    Args:
        categories: the ids themselves, or the categories of a file, of which the first of each name counts.
        classes: names of the classes, for categories of a file.

    Returns:
        The ids in the order of the classes.

    Raises:
        InputError: an id is none, or a class has no category.
    """
    named = [category for category in categories if isinstance(category, Mapping)]
    if named:
        return _ids_by_name(named, classes)
    ids = cast(Sequence[int | str], categories)
    check(all(map(_is_id, ids)), "categories", "whole numbers or texts, or categories of a file", categories[:3])
    return list(map(_plain_id, ids))


def _ids_by_name(categories: Sequence[Category], classes: Sequence[str] | None) -> list[int | str]:
    """Find the ids of the categories of a file that have the names of classes, in their order."""
    if classes is None:
        raise InputError("classes: expected the names of the detector's classes to find their categories, got None")
    ids: dict[str, int | str] = {}
    for category in categories:
        name = canonical_name(str(category["name"]))
        ids.setdefault(name, _plain_id(cast(int | str, category["id"])))
    names = class_indices(classes)
    missing = [name for name in names if name not in ids]
    check(not missing, "categories", "a category for each class", f"none for {', '.join(missing[:3])}")
    return [ids[name] for name in names]


def _is_id(value: object) -> bool:
    """Tell whether a value is text, or a whole number of any library."""
    return isinstance(value, str) or (hasattr(value, "__index__") and not isinstance(value, bool))


def _plain_id(value: str | SupportsIndex) -> int | str:
    """Convert a whole number of any library to Python's."""
    return value if isinstance(value, str) else index(value)
