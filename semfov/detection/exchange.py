"""What detections become in other libraries (Supervision, COCO results), and score vectors of boxes from there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import index
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from semfov.data.classes import canonical_name, class_indices
from semfov.errors import InputError, check, needing
from semfov.io.tables import digits, pixels

if TYPE_CHECKING:
    import supervision


def named_detections(
    boxes: Tensor, labels: Tensor, scores: Tensor, classes: Sequence[str] | None, data: Mapping[str, Any]
) -> supervision.Detections:
    """`supervision.Detections` of boxes, with classes from 0, their names unless None, and further data."""
    numbers = (labels - 1).numpy()
    names = {} if classes is None else {"class_name": np.array([classes[n] for n in numbers.tolist()], dtype=str)}
    with needing("supervision", "supervision"):
        from supervision import Detections
    return Detections(boxes.numpy(), None, scores.numpy(), numbers, data={**data, **names})


def coco_results(
    image_id: int | str, boxes: Tensor, labels: Tensor, scores: Tensor, ids: Mapping[int, int | str]
) -> list[dict[str, Any]]:
    """COCO results of boxes (corners), with the category id of each class 1..K from `ids`."""
    check(_is_id(image_id), "image_id", "the whole number of an image, or text", repr(image_id))
    image_id = _plain_id(image_id)
    size = boxes[:, 2:] - boxes[:, :2]
    placed = torch.cat([boxes[:, :2], size], -1).double().tolist()
    return [
        {"image_id": image_id, "category_id": ids[label], "bbox": [*map(pixels, box)], "score": digits(score)}
        for label, box, score in zip(labels.tolist(), placed, scores.double().tolist(), strict=True)
    ]


def category_ids(
    categories: Sequence[int | str] | Sequence[Mapping[str, Any]], classes: Sequence[str] | None = None
) -> list[int | str]:
    """The category id of each class: ids as they are, or those of a file's categories, the first of each name."""
    named = [category for category in categories if isinstance(category, Mapping)]
    if not named:
        ids = [each for each in categories if not isinstance(each, Mapping)]
        check(all(map(_is_id, ids)), "categories", "whole numbers or texts, or categories of a file", categories[:3])
        return [_plain_id(each) for each in ids]
    if classes is None:
        raise InputError("classes: expected the names of the detector's classes to find their categories, got None")
    by_name = {canonical_name(str(category["name"])): _plain_id(category["id"]) for category in reversed(named)}
    names = class_indices(classes)
    missing = [name for name in names if name not in by_name]
    check(not missing, "categories", "a category for each class", f"none for {', '.join(missing[:3])}")
    return [by_name[name] for name in names]


def _is_id(value: object) -> bool:
    """Whether a value is text, or a whole number of any library."""
    return isinstance(value, str) or (hasattr(value, "__index__") and not isinstance(value, bool))


def _plain_id(value: Any) -> int | str:
    return value if isinstance(value, str) else index(value)
