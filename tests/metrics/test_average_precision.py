"""Average precision against annotation files as other programs write them, and COCOeval where its numbers are right."""

import contextlib
import io
import json

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from semfov.data.annotations import read_annotations
from semfov.errors import DataError
from semfov.metrics.average_precision import average_precision

BOXES = [(0, "person", [4, 4, 30, 20]), (0, "dog", [60, 10, 20, 24]), (1, "person", [10, 40, 16, 30])]


def written(tmp_path, data):
    path = tmp_path / "gt.json"
    path.write_text(json.dumps(data))
    return read_annotations(path)


def coco_file(boxes=BOXES, first=1, names=("person", "dog", "cup")):
    """A file of two images of 100 × 80 pixels, as COCO's tools want it, with ids that begin at `first`."""
    return {
        "images": [{"id": first + n, "file_name": f"{n}.jpg", "width": 100, "height": 80} for n in range(2)],
        "categories": [{"id": first + n, "name": name} for n, name in enumerate(names)],
        "annotations": [
            {
                "id": first + n,
                "image_id": first + image,
                "category_id": first + names.index(name),
                "bbox": box,
                "area": box[2] * box[3],
                "iscrowd": 0,
            }
            for n, (image, name, box) in enumerate(boxes)
        ],
    }


def perfect(data):
    """Results with the boxes of all objects of a file that are no crowds."""
    entries = [each for each in data["annotations"] if not each.get("iscrowd") and min(each["bbox"][2:]) > 0]
    return [
        {"image_id": each["image_id"], "category_id": each["category_id"], "bbox": each["bbox"], "score": 0.9 - n / 1e4}
        for n, each in enumerate(entries)
    ]


def each_object(**fields):
    data = coco_file()
    for entry in data["annotations"]:
        entry |= fields
    return data


def each_object_without(*fields):
    data = coco_file()
    data["annotations"] = [{k: v for k, v in each.items() if k not in fields} for each in data["annotations"]]
    return data


def label_studio():
    """Ids from 0, names of files with Windows separators, an empty segmentation."""
    data = coco_file(first=0)
    for image in data["images"]:
        image["file_name"] = f"images\\1a2b3c4d-{image['file_name']}"
    for entry in data["annotations"]:
        entry |= {"segmentation": [], "ignore": 0}
    return data | {"info": {"contributor": "Label Studio"}}


def roboflow():
    """The first category is a name for all others, and is that of one of them in other letters."""
    data = coco_file(first=0, names=("Person", "person", "dog", "cup"))
    for category in data["categories"]:
        category["supercategory"] = "none" if category["id"] == 0 else "Person"
    return data


def torchvision_helper():
    """`convert_to_coco_api`: areas and ids of tensors, categories by number, no size of an image."""
    data = coco_file(first=0)
    for image in data["images"]:
        del image["width"], image["height"]
    return data


def cvat():
    data = each_object(attributes={"occluded": False, "rotation": 0.0}, segmentation=[], area=600.0)
    for image in data["images"]:
        image |= {"license": 0, "flickr_url": "", "coco_url": "", "date_captured": 0, "file_name": f"a/b/{image['id']}"}
    return data | {"licenses": [{"name": "", "id": 0, "url": ""}]}


def many_boxes():
    return coco_file([(0, "person", [(n % 16) * 6, (n // 16) * 5, 5, 4]) for n in range(256)])


def names_twice():
    """Two categories of one name, both with objects."""
    data = coco_file(names=("person", "dog", "cup", "dog"))
    data["annotations"].append({**data["annotations"][0], "id": 9, "category_id": 4, "bbox": [0, 50, 9, 9]})
    return data


def text_ids():
    data = coco_file()
    for each in (*data["images"], *data["categories"]):
        each["id"] = f"id-{each['id']}"
    for entry in data["annotations"]:
        entry |= {name: f"id-{entry[name]}" for name in ("id", "image_id", "category_id")}
    return data


def gaps():
    data = coco_file()
    for category in data["categories"]:
        category["id"] = category["id"] * 1000 - 7
    for entry in data["annotations"]:
        entry["category_id"] = entry["category_id"] * 1000 - 7
    return data


def float_ids():
    data = coco_file()
    for entry in data["annotations"]:
        entry |= {name: float(entry[name]) for name in ("id", "image_id", "category_id")}
    return data


def crowd():
    """A box around a crowd, in which boxes are no errors, and in which none is missing."""
    data = coco_file()
    data["annotations"].append({**data["annotations"][0], "id": 9, "iscrowd": 1, "bbox": [0, 0, 90, 70]})
    return data


def lvis():
    """Version 1: `coco_url` in place of names; a class that is annotated only in part."""
    data = coco_file()
    for image in data["images"]:
        del image["file_name"]
        image |= {"coco_url": f"http://localhost/{image['id']}.jpg", "neg_category_ids": [3]}
        image["not_exhaustive_category_ids"] = [1]
    for entry in data["annotations"]:
        del entry["iscrowd"]
    return data


FILES = {
    "as COCO's": coco_file,
    "ids from 0": lambda: coco_file(first=0),
    "Label Studio": label_studio,
    "Roboflow": roboflow,
    "torchvision": torchvision_helper,
    "CVAT": cvat,
    "256 boxes in one picture": many_boxes,
    "names twice": names_twice,
    "text ids": text_ids,
    "ids with gaps": gaps,
    "float ids": float_ids,
    "one id for all objects": lambda: each_object(id=1),
    "no ids of objects": lambda: each_object_without("id"),
    "no area": lambda: each_object_without("area"),
    "area null": lambda: each_object(area=None),
    "area 0": lambda: each_object(area=0),
    "area below 0": lambda: each_object(area=-1),
    "no iscrowd": lambda: each_object_without("iscrowd"),
    "iscrowd null": lambda: each_object(iscrowd=None),
    "crowd": crowd,
    "LVIS": lvis,
    "a box without area": lambda: coco_file([*BOXES, (1, "dog", [5, 5, 0, 9])]),
}


@pytest.mark.parametrize("make", FILES.values(), ids=FILES)
def test_the_boxes_of_the_file_itself_are_perfect(tmp_path, make):
    data = make()
    assert average_precision(written(tmp_path, data), perfect(data)) == pytest.approx((1, 1))


def test_numbers_may_be_texts_as_tables_have_them(tmp_path):
    """Ids of what an object refers to, too; what is no number is refused with its entry."""
    data = coco_file()
    for image in data["images"]:
        image |= {"width": "100", "height": "80"}
    for entry in data["annotations"]:
        entry |= {name: str(entry[name]) for name in ("image_id", "category_id", "iscrowd")}
        entry["bbox"] = [f"{number}.0" for number in entry["bbox"]]
    file = written(tmp_path, data)
    assert average_precision(file, perfect(coco_file())) == pytest.approx((1, 1))
    assert file.size(1) == (100, 80)
    for name, wrong in (("bbox", ["4", "nan", "9", "9"]), ("image_id", "9"), ("iscrowd", "yes")):
        entries = [data["annotations"][0], {**data["annotations"][1], name: wrong}]
        with pytest.raises(DataError, match=rf"gt\.json: annotations\[1\]: expected {name} to be .*, got"):
            written(tmp_path, {**data, "annotations": entries})


def by_pycocotools(data, results, limit=100):
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = data
        truth.createIndex()
        judge = COCOeval(truth, truth.loadRes(results), "bbox")
        judge.params.maxDets = [limit]
        judge.evaluate()
        judge.accumulate()
    precision = judge.eval["precision"][..., 0, 0]
    return precision[precision > -1].mean(), precision[0][precision[0] > -1].mean()


@pytest.mark.parametrize("seed", range(8))
def test_it_is_what_pycocotools_says_of_files_that_it_reads_rightly(tmp_path, seed):
    """Random boxes and crowds, and boxes near them or anywhere; some classes have no objects, and some no boxes."""
    random, names = np.random.default_rng(seed), ("person", "dog", "cup", "car")

    def box(near=None):
        corner, size = random.uniform(0, 60, 2), random.uniform(5, 40, 2)
        fresh = np.concatenate([corner, size])
        return (fresh if near is None else np.abs(np.array(near) + random.normal(0, 2, 4)) + 0.1).tolist()

    data = coco_file([(int(random.integers(2)), names[random.integers(3)], box()) for _ in range(30)], names=names)
    for entry in data["annotations"][::7]:
        entry["iscrowd"] = 1
    near = [(each["image_id"], each["category_id"], box(each["bbox"])) for each in data["annotations"][:25]]
    results = [
        {"image_id": image, "category_id": category, "bbox": place, "score": round(float(random.random()), 1)}
        for image, category, place in [*near, *((1 + n % 2, 1 + n % 4, box()) for n in range(12))]
    ]
    file = written(tmp_path, data)
    assert average_precision(file, results) == pytest.approx(by_pycocotools(data, results))
    assert average_precision(file, results, limit=2) == pytest.approx(by_pycocotools(data, results, limit=2))
    images = [each for each in data["annotations"] if each["image_id"] == 1]
    seen = [each for each in results if each["image_id"] == 1]
    only = {**data, "images": data["images"][:1], "annotations": images}
    assert average_precision(file, results, images=[1]) == pytest.approx(by_pycocotools(only, seen))


def test_only_the_classes_that_are_asked_for_are_judged(tmp_path):
    data = coco_file()
    file, results = written(tmp_path, data), perfect(data)
    wrong = [{**each, "bbox": [0, 70, 3, 3]} for each in results if each["category_id"] == 1]
    right = [each for each in results if each["category_id"] == 2]
    assert average_precision(file, wrong + right) == pytest.approx((0.5, 0.5))
    assert average_precision(file, wrong + right, classes=["Dog"]) == pytest.approx((1, 1))
    assert average_precision(file, wrong + right, classes=["cup"]) is None
    assert average_precision(file, []) == (0, 0)
    assert average_precision(file, [], images=[], classes=["dog"]) is None


def test_boxes_count_as_in_lvis(tmp_path):
    """A box of a class is an error only where the class is annotated in full, or known to be absent."""
    data = coco_file()
    stray = {"image_id": 2, "category_id": 2, "bbox": [50, 50, 20, 20], "score": 0.99}  # a dog in the second image

    def judged(**fields):
        for image in data["images"]:
            image |= {"neg_category_ids": [], "not_exhaustive_category_ids": []}
        data["images"][1] |= fields
        return average_precision(written(tmp_path, data), [stray, *perfect(data)], classes=["dog"])

    assert judged() == pytest.approx((1, 1))
    assert judged(neg_category_ids=[2]) == pytest.approx((0.5, 0.5))
    data["annotations"].append({**data["annotations"][2], "id": 9, "category_id": 2})
    assert judged(neg_category_ids=[]) == pytest.approx((2 / 3, 2 / 3))
    assert judged(not_exhaustive_category_ids=[2]) == pytest.approx((1, 1))
