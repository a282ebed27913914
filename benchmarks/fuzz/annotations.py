"""Fuzz COCO annotation files: valid, unusual, or with entries of the wrong kind."""

import copy
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
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


def annotation_files(data: st.DataObject) -> str:
    """`CocoScenes`: the boxes that a plain loop keeps, or `DataError`; wrong entries are never ignored."""
    document = draw_document(data)
    whole = json.dumps(document)
    damage = choose(data, ("none", "none", "value", "missing", "repeated id", "cut"), "damage")
    if damage == "value":
        holder, key = choose(data, places(document), "place")
        holder[key] = copy.deepcopy(choose(data, _JUNK, "junk"))
    elif damage == "missing":
        holder, key = choose(data, places(document), "place")
        del holder[key]
    elif damage == "repeated id":
        table = choose(data, [key for key in document if document[key]], "table")
        document[table].append(copy.deepcopy(document[table][0]))
    text = json.dumps(document)
    if damage == "cut":
        text = text[: data.draw(st.integers(0, len(text) - 1), label="length")]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for image in json.loads(whole)["images"]:
            (root / image["file_name"]).write_bytes(b"")
        path = root / "instances.json"
        path.write_text(text)
        options = {"min_instances": choose(data, (0, 1, 2), "min_instances"), "max_target_area": None}
        options["crowd"] = choose(data, ("keep", "drop"), "crowd")
        result = attempt(lambda: CocoScenes(root, path, CLASSES, **options))
    if damage in ("cut", "repeated id"):
        assert failed(result), "a damaged file was read"
    if damage == "value":
        images = document["images"] if isinstance(document["images"], list) else []
        strange = [image.get("file_name") for image in images if isinstance(image, dict)]
        outside = any(isinstance(name, str) and ("/" in name or "\0" in name) for name in strange)
        assert failed(result) or not outside, "a file outside of the root was taken"
    if failed(result):
        if damage == "none":
            assert not expected(document, **options) or not has_common_category(document), result
        return outcome(result)
    assert isinstance(result, CocoScenes)
    for index, annotation in enumerate(map(result.annotation, range(len(result)))):
        boxes, (width, height) = annotation.boxes, annotation.size
        assert bool((boxes[:, 2:] > boxes[:, :2]).all())
        assert bool((boxes >= 0).all())
        assert bool((boxes[:, 0::2] <= width).all() and (boxes[:, 1::2] <= height).all())
        assert bool(((annotation.labels >= 1) & (annotation.labels <= len(CLASSES))).all())
        assert result.targets(index) == sorted(set(annotation.labels.tolist()))
    if damage == "none":
        rows_by_image = expected(document, **options)
        assert result.ids == list(rows_by_image)
        for index, image in enumerate(rows_by_image):
            objects = result.annotation(index)
            rows = [[*box, label] for box, label in zip(objects.boxes.tolist(), objects.labels.tolist(), strict=True)]
            np.testing.assert_allclose(
                np.reshape(rows, (-1, 5)), np.reshape(rows_by_image[image], (-1, 5)), rtol=1e-6, atol=1e-6
            )
    return "result"


def draw_document(data: st.DataObject) -> dict[str, Any]:
    """A valid file with gaps between ids, unknown categories, crowds, and boxes without area or outside the image."""
    rng = draw_rng(data)
    images = rng.choice(1000, data.draw(st.integers(1, 4), label="images"), replace=False).tolist()
    names = [str(name) for name in rng.permutation(CATEGORIES)[: data.draw(st.integers(1, 5), label="categories")]]
    ids = rng.choice(90, len(names), replace=False).tolist()
    count = data.draw(st.integers(0, 8), label="annotations")
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


def has_common_category(document: dict[str, Any]) -> bool:
    """Whether the detector knows any of the categories."""
    return any(category["name"] in LABELS for category in document["categories"])


def expected(
    document: dict[str, Any], *, min_instances: int, crowd: str, max_target_area: None
) -> dict[int, list[list[float]]]:
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
