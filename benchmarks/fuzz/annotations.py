"""Fuzz COCO annotation files: valid, unusual, or with entries of the wrong kind."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.fuzz.runner import Case, Draw
from semfov.data.coco import CocoScenes

CLASSES = ("person", "cat", "tv")
CATEGORIES = ("person", "cat", "tvmonitor", "unicorn", "Cat food")
LABELS = {"person": 1, "cat": 2, "tvmonitor": 3}
WIDTH, HEIGHT = 40, 30
_JUNK: list[Any] = [
    None, True, -1, 0, 7, 10**400, 1.5, "", "x", "../../etc/passwd", [], [1], [0, 0, -1, 1], [0, 0, "1", 1],
    [0, 0, 1], {}, {"id": 1}, float("nan"), float("inf"), [float("nan"), 0, 1, 1], "\0", [[[[]]]],
    "/etc/passwd", "a\0b", "\ud800", "..", "\n",
]  # fmt: skip


def annotation_files(draw: Draw, folder: Path) -> Case:
    """`CocoScenes`: the boxes that a plain loop keeps, or `DataError`; wrong entries are never ignored."""
    document = draw_document(draw)
    for image in document["images"]:
        (folder / image["file_name"]).write_bytes(b"")
    options: dict[str, Any] = {"min_instances": draw.choose((0, 1, 2), "min_instances"), "max_target_area": None}
    options["crowd"] = draw.choose(("keep", "drop"), "crowd")
    damage = draw.choose(("none", "none", "value", "missing", "repeated id", "cut"), "damage")
    rows_by_image = expected(document, options["min_instances"], options["crowd"]) if damage == "none" else {}
    known = any(category["name"] in LABELS for category in document["categories"])
    outside = False
    if damage in ("value", "missing"):
        holder, key = draw.choose(places(document), "place")
        if damage == "missing":
            del holder[key]
        else:
            holder[key] = copy.deepcopy(draw.choose(_JUNK, "junk"))
            images = document["images"] if isinstance(document["images"], list) else []
            names = [image.get("file_name") for image in images if isinstance(image, dict)]
            outside = any(isinstance(name, str) and ("/" in name or "\0" in name) for name in names)
    elif damage == "repeated id":
        table = draw.choose([key for key in document if document[key]], "table")
        document[table].append(copy.deepcopy(document[table][0]))
    text = json.dumps(document)
    if damage == "cut":
        text = text[: draw.integer(0, len(text) - 1, "length")]
    path = folder / "instances.json"
    path.write_text(text)

    def check(scenes: CocoScenes) -> None:
        for index, annotation in enumerate(map(scenes.annotation, range(len(scenes)))):
            boxes, (width, height) = annotation.boxes, annotation.size
            assert bool((boxes[:, 2:] > boxes[:, :2]).all())
            assert bool((boxes >= 0).all())
            assert bool((boxes[:, 0::2] <= width).all() and (boxes[:, 1::2] <= height).all())
            assert bool(((annotation.labels >= 1) & (annotation.labels <= len(CLASSES))).all())
            assert scenes.targets(index) == sorted(set(annotation.labels.tolist()))
            if damage == "none":
                rows = torch.cat([boxes, annotation.labels[:, None]], -1)
                right = np.reshape(rows_by_image[scenes.ids[index]], (-1, 5))
                np.testing.assert_allclose(rows.numpy(), right, rtol=1e-6, atol=1e-6)
        assert damage != "none" or scenes.ids == list(rows_by_image)

    # A valid file without a picture to keep is refused, too. Places of pictures that are left out do not matter.
    return Case(
        lambda: CocoScenes(folder, path, CLASSES, **options),
        check,
        may=damage != "none" or not rows_by_image or not known,
        must=damage in ("cut", "repeated id") or (outside and options["min_instances"] == 0),
    )


def draw_document(draw: Draw) -> dict[str, Any]:
    """Write a valid file with gaps between ids, unknown categories, crowds, and boxes empty or outside the image."""
    rng = draw.rng
    images = rng.choice(1000, draw.integer(1, 4, "images"), replace=False).tolist()
    names = [str(name) for name in rng.permutation(CATEGORIES)[: draw.integer(1, 5, "categories")]]
    ids = rng.choice(90, len(names), replace=False).tolist()
    count = draw.integer(0, 8, "annotations")
    annotations = []
    for identity in rng.choice(10**9, count, replace=False).tolist():
        corner, extent = rng.uniform(-20, 50, 2), rng.uniform(0, 60, 2) * (rng.random(2) < 0.9)
        box = np.concatenate([corner, extent]) * (1e6 if rng.random() < 0.05 else 1.0)
        entry = {
            "id": identity,
            "image_id": int(rng.choice(images)),
            "category_id": int(rng.choice(ids)),
            "bbox": box.round(2).tolist(),
            "iscrowd": int(rng.random() < 0.2),
            "area": -1,
        }
        annotations.append(entry)
    return {
        "images": [{"id": i, "file_name": f"{i}.png", "width": WIDTH, "height": HEIGHT} for i in images],
        "categories": [{"id": i, "name": name} for i, name in zip(ids, names, strict=True)],
        "annotations": annotations,
    }


def places(document: dict[str, Any]) -> list[tuple[Any, Any]]:
    """All values that matter, each as its container and its key."""
    values: list[tuple[Any, Any]] = [(document, key) for key in document]
    for table in document.values():
        values += [(table, index) for index in range(len(table))]
        values += [(entry, key) for entry in table for key in entry if key != "area"]
    return values


def expected(document: dict[str, Any], min_instances: int, crowd: str) -> dict[int, list[list[float]]]:
    """Rows `[x1, y1, x2, y2, label]` of every image that should be kept, by a plain loop."""
    names = {category["id"]: category["name"] for category in document["categories"]}
    rows_by_image = {}
    for image in sorted(entry["id"] for entry in document["images"]):
        instances, rows = 0, []
        for entry in document["annotations"]:
            x, y, width, height = entry["bbox"]
            edges = [max(x, 0), max(y, 0), min(x + width, WIDTH), min(y + height, HEIGHT)]
            box = [float(np.float32(edge)) for edge in edges]
            if entry["image_id"] != image or box[2] <= box[0] or box[3] <= box[1]:
                continue
            if crowd == "drop" and entry["iscrowd"]:
                continue
            instances += 1
            if names[entry["category_id"]] in LABELS:
                rows.append([*box, float(LABELS[names[entry["category_id"]]])])
        if instances >= min_instances:
            rows_by_image[image] = rows
    return rows_by_image
