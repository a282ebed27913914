"""The average precision of boxes against an annotation file in COCO's format."""

import contextlib
import io
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semfov.data.annotations import ABSENT, PARTIAL, Annotations, Id
from semfov.data.classes import canonical_name

_Entry = Mapping[str, Any]


def average_precision(
    annotations: Annotations,
    results: Sequence[_Entry],
    *,
    images: Collection[Id] | None = None,
    classes: Collection[str] | None = None,
    limit: int | None = None,
) -> tuple[float, float] | None:
    """AP and AP50 of boxes by pycocotools' COCOeval, with the rules of LVIS where the file has its fields.

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
    >>> [round(each, 6) for each in found]
    [1.0, 1.0]
    """
    image_ids = {
        image: number for number, image in enumerate(sorted(annotations.images if images is None else images), 1)
    }
    class_ids = _class_ids(annotations, classes)

    objects = ({**each, "image_id": image} for image in image_ids for each in annotations.objects[image])
    truth = _copies((each for each in objects if min(each["bbox"][2:]) > 0), image_ids, class_ids)
    found = _copies(results, image_ids, class_ids)

    # In LVIS a box counts only where its class is annotated, or known to be absent.
    known = _pairs(truth) | _named(annotations, ABSENT, image_ids, class_ids)
    of_lvis = {number for image, number in image_ids.items() if annotations.images[image].get(ABSENT) is not None}
    found = [box for box in found if box["image_id"] not in of_lvis or (box["image_id"], box["category_id"]) in known]

    partial = _named(annotations, PARTIAL, image_ids, class_ids)
    precision = _precision(truth, found, partial, len(image_ids), limit)
    judged = precision[..., (precision > -1).all((0, 1))]
    return (float(judged.mean()), float(judged[0].mean())) if judged.size else None


def _class_ids(annotations: Annotations, classes: Collection[str] | None) -> dict[Id, int]:
    """Number of the class, from 1, of each category that is judged; categories of one name are one class."""
    names = {id_: canonical_name(category["name"]) for id_, category in annotations.categories.items()}
    judged = {*names.values()} if classes is None else {canonical_name(name) for name in classes}
    numbers = {name: number for number, name in enumerate(sorted(judged), 1)}
    return {id_: numbers[name] for id_, name in names.items() if name in judged}


def _copies(
    entries: Iterable[_Entry], image_ids: Mapping[Id, int], class_ids: Mapping[Id, int]
) -> list[dict[str, Any]]:
    """The entries of images and classes that are judged, as COCOeval reads them rightly."""
    judged = [each for each in entries if each["image_id"] in image_ids and each["category_id"] in class_ids]
    return [
        {
            "id": number,
            "image_id": image_ids[each["image_id"]],
            "category_id": class_ids[each["category_id"]],
            "bbox": each["bbox"],
            "area": each["bbox"][2] * each["bbox"][3],
            "iscrowd": each.get("iscrowd", 0),
            "score": each.get("score", 1.0),
        }
        for number, each in enumerate(judged, 1)
    ]


def _pairs(entries: Iterable[_Entry]) -> set[tuple[int, int]]:
    """Images, each with a class of which it has entries."""
    return {(each["image_id"], each["category_id"]) for each in entries}


def _named(
    annotations: Annotations, field: str, image_ids: Mapping[Id, int], class_ids: Mapping[Id, int]
) -> set[tuple[int, int]]:
    """Images, each with a class that one of their fields names."""
    return {
        (number, class_ids[category])
        for image, number in image_ids.items()
        for category in annotations.images[image].get(field) or ()
        if category in class_ids
    }


def _precision(
    truth: Sequence[_Entry],
    found: Sequence[_Entry],
    partial: Collection[tuple[int, int]],
    images: int,
    limit: int | None,
) -> NDArray[np.float64]:
    """Precision by overlap, recall and class `(10, 101, K)` of the classes of both; -1 for those without objects.

    In pairs `partial` of image and class not every object is annotated, so that boxes without an object are no errors.
    """
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    classes = sorted({each["category_id"] for each in (*truth, *found)})
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        sides = []
        for entries in (truth, found):
            side = COCO()
            side.dataset = {
                "images": [{"id": number} for number in range(1, images + 1)],
                "categories": [{"id": number} for number in classes],
                "annotations": list(entries),
            }
            side.createIndex()
            sides.append(side)
        judge = COCOeval(*sides, "bbox")
        judge.params.areaRng, judge.params.areaRngLbl = [[0, math.inf]], ["all"]
        judge.params.maxDets = [max(len(found), 1) if limit is None else limit]
        judge.evaluate()
        for each in judge.evalImgs:
            if each is not None and (each["image_id"], each["category_id"]) in partial:
                each["dtIgnore"] |= each["dtMatches"] == 0
        judge.accumulate()
    return judge.eval["precision"][..., 0, 0]
