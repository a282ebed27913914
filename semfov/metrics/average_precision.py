"""The average precision of boxes against an annotation file in COCO's format."""

import contextlib
import io
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from semfov.data.annotations import ABSENT, PARTIAL, Annotations, Entry, Id
from semfov.data.classes import canonical_name

if TYPE_CHECKING:
    from pycocotools.coco import COCO


def average_precision(
    annotations: Annotations,
    results: Sequence[Entry],
    *,
    images: Collection[Id] | None = None,
    classes: Collection[str] | None = None,
    limit: int | None = None,
) -> tuple[float, float] | None:
    """Compute AP and AP50 of boxes by pycocotools' COCOeval, with the rules of LVIS where the file has its fields.

    COCOeval takes the id 0 for no match, needs areas, and takes categories of one name for several classes. So it
    judges a copy of the entries with ids from 1, the areas of the boxes, and one category for each name. Boxes without
    area are left out of the annotations, as nothing can overlap them.

    Args:
        annotations: the annotation file.
        results: `image_id`, `category_id`, `bbox` and `score` of each box.
        images: ids of the images that are judged; None for all.
        classes: names of the classes that are judged; None for all of the file.
        limit: largest number of boxes of a class in an image that count, the most confident first; None for all of
            them. COCO's own is 100.

    Returns:
        AP, the mean over overlaps from .50 to .95, and AP50; None if the images have no objects of the classes.

    >>> cup = {"category_id": 3, "bbox": [5, 5, 20, 30], "iscrowd": 0}
    >>> file = Annotations({0: {"file_name": "a.jpg"}}, {3: {"name": "cup"}}, {0: [cup]}, "")
    >>> found = average_precision(file, [{**cup, "image_id": 0, "score": 0.9}])
    >>> [round(value, 6) for value in found]
    [1.0, 1.0]
    """
    judged_images = sorted(annotations.images if images is None else images)
    image_ids = {image: number for number, image in enumerate(judged_images, 1)}
    class_ids = _class_ids(annotations, classes)
    truth = _copies(_objects(annotations, judged_images), image_ids, class_ids)
    boxes = _copies(results, image_ids, class_ids)

    # In LVIS a box counts only where its class is annotated, or known to be absent.
    of_lvis = {number for image, number in image_ids.items() if annotations.images[image].get(ABSENT) is not None}
    verified = {_pair(entry) for entry in truth} | _named(annotations, ABSENT, image_ids, class_ids)
    boxes = [box for box in boxes if box["image_id"] not in of_lvis or _pair(box) in verified]

    partial = _named(annotations, PARTIAL, image_ids, class_ids)
    precision = _precision(truth, boxes, partial, len(image_ids), limit)  # (overlaps, recalls, K)
    has_objects = (precision > -1).all((0, 1))
    if not has_objects.any():
        return None
    judged = precision[..., has_objects]
    return float(judged.mean()), float(judged[0].mean())  # the first overlap is .50


def _objects(annotations: Annotations, images: Iterable[Id]) -> list[Entry]:
    """List the objects of images that have an area, each with the id of its image."""
    objects: list[Entry] = []
    for image in images:
        for entry in annotations.objects[image]:
            _, _, width, height = entry["bbox"]
            if width > 0 and height > 0:
                objects.append({**entry, "image_id": image})
    return objects


def _class_ids(annotations: Annotations, classes: Collection[str] | None) -> dict[Id, int]:
    """Give the classes of the categories that are judged numbers from 1; categories of one name are one class."""
    names = {category: canonical_name(entry["name"]) for category, entry in annotations.categories.items()}
    judged = names.values() if classes is None else map(canonical_name, classes)
    numbers = {name: number for number, name in enumerate(sorted(set(judged)), 1)}
    return {category: numbers[name] for category, name in names.items() if name in numbers}


def _copies(entries: Iterable[Entry], image_ids: Mapping[Id, int], class_ids: Mapping[Id, int]) -> list[Entry]:
    """Copy the entries of images and classes that are judged, as COCOeval reads them rightly."""
    copies: list[Entry] = []
    for entry in entries:
        if entry["image_id"] not in image_ids or entry["category_id"] not in class_ids:
            continue
        box = entry["bbox"]
        copies.append(
            {
                "id": len(copies) + 1,
                "image_id": image_ids[entry["image_id"]],
                "category_id": class_ids[entry["category_id"]],
                "bbox": box,
                "area": box[2] * box[3],
                "iscrowd": entry.get("iscrowd", 0),
                "score": entry.get("score", 1.0),
            }
        )
    return copies


def _pair(entry: Entry) -> tuple[int, int]:
    """Name the image and the class of an entry."""
    return entry["image_id"], entry["category_id"]


def _named(
    annotations: Annotations, field: str, image_ids: Mapping[Id, int], class_ids: Mapping[Id, int]
) -> set[tuple[int, int]]:
    """List the images, each with a class that one of their fields names."""
    pairs = set()
    for image, number in image_ids.items():
        categories = annotations.images[image].get(field) or ()  # LVIS has the field, COCO has none
        pairs |= {(number, class_ids[category]) for category in categories if category in class_ids}
    return pairs


def _precision(
    truth: Sequence[Entry],
    boxes: Sequence[Entry],
    partial: Collection[tuple[int, int]],
    images: int,
    limit: int | None,
) -> NDArray[np.float64]:
    """Compute precision by overlap, recall and class of the boxes and the truth.

    Returns:
        `(10, 101, K)`, for the classes of both; -1 for those without objects.
    """
    from pycocotools.cocoeval import COCOeval

    classes = sorted({entry["category_id"] for entry in (*truth, *boxes)})
    if limit is None:
        limit = max(len(boxes), 1)  # so many boxes at most are there
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        judge = COCOeval(_indexed(truth, images, classes), _indexed(boxes, images, classes), "bbox")
        # One range of areas, all of them, whose label COCOeval expects beside it.
        judge.params.areaRng = [[0, math.inf]]
        judge.params.areaRngLbl = ["all"]
        judge.params.maxDets = [limit]
        judge.evaluate()
        results = filter(None, judge.evalImgs)  # None where an image has neither objects nor boxes of a class
        for result in results:
            # Where not every object is annotated, boxes without an object are no errors.
            if _pair(result) in partial:
                result["dtIgnore"] |= result["dtMatches"] == 0
        judge.accumulate()
    return judge.eval["precision"][..., 0, 0]  # of one range of areas, and one limit


def _indexed(entries: Sequence[Entry], images: int, classes: Sequence[int]) -> "COCO":
    """Put the entries of so many images into the form of an annotation file, which pycocotools reads."""
    from pycocotools.coco import COCO

    side = COCO()
    side.dataset = {
        "images": [{"id": number} for number in range(1, images + 1)],
        "categories": [{"id": number} for number in classes],
        "annotations": list(entries),
    }
    side.createIndex()
    return side
