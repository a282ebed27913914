"""Annotation files as programs write them: `semfov find FOLDER --annotations` calls perfect boxes perfect.

The detector is constant, and shows the boxes of the files. What differs between files is how they are written.
"""

import json
import re

import pytest
import torch
from PIL import Image

from semfov.detection import Candidates, Selection
from tests import small

SIDE = 32
NAMES = ("red", "wine glass")
BOXES = (("red", [4, 4, 16, 16]), ("wine glass", [22, 2, 8, 10]), ("red", [2, 22, 10, 8]))
MANY = tuple(("red", [2 * (n % 16), 2 * (n // 16), 2, 2]) for n in range(256))


def coco(files=("a.png", "b.png"), first=1, categories=NAMES, boxes=BOXES):
    """A file of two pictures with the same boxes, whose ids begin at `first`."""
    data = {
        "images": [{"id": first + n, "file_name": name, "width": SIDE, "height": SIDE} for n, name in enumerate(files)],
        "categories": [{"id": first + n, "name": name} for n, name in enumerate(categories)],
        "annotations": [],
    }
    for image in data["images"]:
        for name, box in boxes:
            number = first + len(data["annotations"])
            entry = {"id": number, "image_id": image["id"], "category_id": first + categories.index(name), "bbox": box}
            data["annotations"].append({**entry, "area": box[2] * box[3], "iscrowd": 0})
    return data


def changed(data, images=None, categories=None, annotations=None):
    """A file whose entries have other fields, as functions of the entries tell; None leaves a field out."""
    for key, change in (("images", images), ("categories", categories), ("annotations", annotations)):
        if change is not None:
            entries = [{**entry, **change(entry)} for entry in data[key]]
            data[key] = [{k: v for k, v in entry.items() if v is not None} for entry in entries]
    return data


def polygon(entry):
    x, y, width, height = entry["bbox"]
    return [[x, y, x + width, y, x + width, y + height, x, y + height]]


def text_id(entry):
    return {"id": str(entry["id"])}


def with_more(data, **fields):
    """A file with one entry more, like its first but for some fields."""
    data["annotations"].append({**data["annotations"][0], "id": 99, **fields})
    return data


def names_twice():
    """Objects of either class stand under two categories in turn."""
    data = coco(categories=("red", "wine glass", "Wine_Glass", "RED"))
    for entry in data["annotations"][::2]:
        entry["category_id"] = 5 - entry["category_id"]
    return data


def label_studio():
    return changed(coco(first=0), lambda image: {"file_name": rf"images\\0b51f2a7-{image['file_name']}"})


def roboflow():
    """The first category is a name for all others."""
    return coco(("a_png.rf.4a1cdeb7f3.jpg", "b_png.rf.00112233aa.jpg"), 0, ("things", *NAMES))


def cvat():
    image = {"license": 0, "flickr_url": "", "coco_url": "", "date_captured": 0}
    data = coco(("photos/a.png", "photos/b.png"))
    return changed(data, lambda _: image, annotations=lambda _: {"attributes": {"occluded": False}})


def torchvision():
    def floats(entry):
        return {"area": float(entry["area"]), "bbox": [float(number) for number in entry["bbox"]]}

    return changed(coco(first=0), lambda _: {"width": None, "height": None}, annotations=floats)


def coco_annotator():
    image = {"path": "/datasets/a.png", "annotated": True, "deleted": False, "category_ids": []}
    object_ = {"isbbox": True, "iscrowd": False, "color": "#1f77b4", "metadata": {}}
    return changed(coco(first=7), lambda _: image, annotations=lambda _: object_)


def lvis():
    """No names of files, no crowds, and what each picture surely lacks."""

    def addressed(image):
        address = f"http://images.localhost/train2017/{image['file_name']}"
        return {"file_name": None, "coco_url": address, "neg_category_ids": [], "not_exhaustive_category_ids": []}

    def renamed(category):
        return {"name": category["name"].replace(" ", "_"), "synset": "thing.n.01", "frequency": "c"}

    return changed(coco(), addressed, renamed, lambda _: {"iscrowd": None})


def texts():
    """YOLO's labels that were converted by way of a table: all numbers are texts."""
    size = {"width": f"{SIDE}", "height": f"{SIDE}.0"}

    def texts_of(entry):
        fields = {name: str(entry[name]) for name in ("image_id", "category_id", "area", "iscrowd")}
        return {**fields, "bbox": [f"{number}.0" for number in entry["bbox"]]}

    return changed(coco(("./images/a.jpg", "./images/b.jpg")), lambda _: size, annotations=texts_of)


def crowd():
    """A crowd as run lengths, with the picture as its box."""
    lengths = {"counts": [0, SIDE * SIDE], "size": [SIDE, SIDE]}
    return with_more(coco(), iscrowd=1, bbox=[0, 0, SIDE, SIDE], segmentation=lengths)


FILES = {
    "Label Studio": label_studio,
    "Roboflow": roboflow,
    "CVAT": cvat,
    "LabelMe": lambda: changed(coco(first=0), annotations=lambda e: {"segmentation": polygon(e), "bbox": None}),
    "torchvision": torchvision,
    "FiftyOne": lambda: changed(coco(), categories=lambda _: {"supercategory": "all"}),
    "supervision": lambda: changed(coco(first=0), annotations=lambda e: {"segmentation": [], "area": float(e["area"])}),
    "makesense": lambda: changed(coco(), annotations=lambda e: {"id": e["id"] - 1, "segmentation": polygon(e)}),
    "COCO Annotator": coco_annotator,
    "LVIS": lvis,
    "Datumaro, a crowd": crowd,
    "texts": texts,
    "ids are texts in one place": lambda: changed(coco(), text_id, text_id),
    "ids are stems": lambda: changed(
        coco(), lambda e: {"id": e["file_name"][0]}, annotations=lambda e: {"image_id": " ab"[e["image_id"]]}
    ),
    "polygons": lambda: changed(coco(), annotations=lambda e: {"segmentation": polygon(e), "bbox": []}),
    "no area, no iscrowd": lambda: changed(coco(), annotations=lambda _: {"area": None, "iscrowd": None}),
    "names twice": names_twice,
    "a category that the detector lacks": lambda: with_more(coco(categories=(*NAMES, "zebra")), category_id=3),
}


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.png", "b.png"):
        Image.linear_gradient("L").resize((SIDE, SIDE)).convert("RGB").save(folder / name)
    return folder


@pytest.fixture
def judged(run, agent, photos, tmp_path):
    """Looks at the pictures with a detector of constant boxes; returns the exit code and what was printed."""

    def judge(data, boxes=BOXES):
        x, y, width, height = torch.tensor([box for _, box in boxes]).float().unbind(-1)
        scores = torch.zeros(1, len(boxes), len(NAMES))
        for row, (name, _) in enumerate(boxes):
            scores[0, row, NAMES.index(name)] = 0.9 - row / 1000
        candidates = Candidates(torch.stack([x, y, x + width, y + height], -1)[None], scores)
        agent.eye.detector = small.Fixed(NAMES, candidates, selection=Selection(limit=300))
        file = tmp_path / "truth.json"
        file.write_text(json.dumps(data))
        return run("find", photos, "--passes", 1, "--out", tmp_path / "boxes.coco.json", "--annotations", file)

    return judge


@pytest.mark.parametrize("make", FILES.values(), ids=FILES)
def test_perfect_boxes_are_perfect(judged, make):
    code, printed = judged(make())
    assert re.search(r"AP 1\.000, AP50 1\.000 against \S*truth\.json \(2 pictures, 6 boxes\)", printed.out), printed
    assert code == 0


def test_so_are_256_in_each_picture(judged):
    code, printed = judged(coco(boxes=MANY), MANY)
    assert re.search(r"AP 1\.000, AP50 1\.000 against .* \(2 pictures, 512 boxes\)", printed.out), printed
    assert code == 0


def test_without_objects_of_the_classes_there_is_no_average_precision(judged):
    code, printed = judged({**coco(), "annotations": []})
    assert re.search(r"no AP: \S*truth\.json has no boxes of these classes", printed.out), printed
    assert code == 0


def test_objects_without_any_place_are_refused_with_their_entry(judged):
    lengths = {"counts": [0, 9], "size": [3, 3]}
    for segmentation in (None, [], [[]], lengths, [[1, "x"]]):
        code, printed = judged(with_more(coco(), bbox=[], segmentation=segmentation))
        assert "annotations[6]: expected bbox to be [x, y, width, height]" in printed.err
        assert code == 1
