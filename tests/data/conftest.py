import json

import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT = 40, 30


@pytest.fixture(scope="session")
def photographs(tmp_path_factory):
    """A folder with three small images, 10.png, 20.png and 30.png."""
    folder = tmp_path_factory.mktemp("photographs")
    for number in (10, 20, 30):
        pixels = np.random.default_rng(number).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


def coco(boxes=(), categories=("person", "cat", "tv")):
    """A COCO file as a dict: `boxes` are (image, category name, bbox), and optionally a dict of more keys."""
    return {
        "images": [
            {"id": n, "file_name": f"{n}.png", "width": WIDTH, "height": HEIGHT} for n in (30, 10, 20)
        ],  # not sorted
        "categories": [{"id": 7 * i + 3, "name": name} for i, name in enumerate(categories)],
        "annotations": [
            {"id": i, "image_id": image, "category_id": 7 * categories.index(name) + 3, "bbox": list(box)} | extra
            for i, (image, name, box, *rest) in enumerate(boxes)
            for extra in (rest[0] if rest else {},)
        ],
    }


@pytest.fixture
def make_coco(tmp_path):
    """Function that writes a COCO file and returns its path: make_coco(boxes, categories=...), make_coco(data=dict)."""

    def make(boxes=(), *, data=None, **options):
        path = tmp_path / "instances.json"
        path.write_text(json.dumps(coco(boxes, **options) if data is None else data))
        return path

    return make


@pytest.fixture(scope="session")
def coco_dict():
    """The function `coco`, for tests that change the dict before they write it."""
    return coco
