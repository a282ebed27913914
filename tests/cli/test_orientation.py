"""Photographs that EXIF turns, judged by annotations of what viewers show, and of the pixels as they are stored."""

import csv
import json
import re

import numpy as np
import pytest
from PIL import Image
from pycocotools.coco import COCO

from semfov.cli import compare as command

TURNS = {1: 0, 3: 2, 6: 1, 8: -1}
"""Quarter turns to the left that undo each orientation: the stored pixels of an upright picture."""

FRAMES = [(1, "upright"), (3, "upright"), (6, "upright"), (6, "stored"), (8, "upright"), (8, "stored")]


@pytest.fixture
def turned(tmp_path):
    """Stores a picture so that an orientation turns it upright, and annotates its red square in one of the frames."""

    def store(upright, orientation, frame, suffix="png"):
        stored = np.rot90(np.asarray(upright), TURNS[orientation])
        exif = Image.Exif()
        exif[0x0112] = orientation
        path = tmp_path / f"turned.{suffix}"
        Image.fromarray(np.ascontiguousarray(stored)).save(path, exif=exif)
        annotated = stored if frame == "stored" else np.asarray(upright)
        is_red = annotated[..., 0] > 200
        rows = is_red.any(1).nonzero()[0]
        columns = is_red.any(0).nonzero()[0]
        box = [int(columns[0]), int(rows[0]), len(columns), len(rows)]
        height, width = is_red.shape
        truth = {
            "images": [{"id": 1, "file_name": path.name, "width": width, "height": height}],
            "annotations": [{"id": 1, "image_id": 1, "category_id": 4, "bbox": box, "area": box[2] * box[3]}],
            "categories": [{"id": 4, "name": "red"}],
        }
        file = tmp_path / "truth.json"
        file.write_text(json.dumps(truth))
        return path, file, box

    return store


@pytest.mark.parametrize(("orientation", "frame"), FRAMES)
@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_boxes_are_written_in_the_frame_of_the_annotations(run, photo, turned, tmp_path, orientation, frame, suffix):
    picture, truth, box = turned(Image.open(photo), orientation, frame, suffix)
    out = tmp_path / "boxes.coco.json"
    code, printed = run("find", picture, "--target", "red", "--out", out, "--annotations", truth)
    assert code == 0, printed.err
    assert re.search(r"AP (1|0\.[89])\S*, AP50 1\.000 against", printed.out)
    (found,) = json.loads(out.read_text())
    assert found["bbox"] == pytest.approx(box, abs=1.5)
    assert COCO(str(truth)).loadRes(str(out)).getAnnIds() == [1]


def test_a_square_picture_is_judged_upright(run, photo, turned, tmp_path):
    picture, truth, box = turned(Image.open(photo).crop((0, 0, 120, 120)), 6, "upright")
    out = tmp_path / "boxes.coco.json"
    assert run("find", picture, "--target", "red", "--out", out, "--annotations", truth)[0] == 0
    (found,) = json.loads(out.read_text())
    assert found["bbox"] == pytest.approx(box, abs=1.5)


@pytest.mark.parametrize(("orientation", "frame"), FRAMES)
def test_ways_are_compared_in_the_frame_of_the_annotations(
    run, agent, evidence, large, turned, tmp_path, monkeypatch, orientation, frame
):
    monkeypatch.setattr(command, "make_agent", lambda options: agent)
    monkeypatch.setattr(command, "detector_classes", lambda options: None)
    agent.windows = evidence
    picture, truth, _ = turned(Image.open(large), orientation, frame)
    options = ("--target", "red", "--passes", 2, "--with", "sahi", "--slice", 480, "--out", tmp_path / "out")
    code, printed = run("compare", picture, "--annotations", truth, *options)
    assert code == 0, printed.err
    rows = csv.DictReader((tmp_path / "out" / "compare.csv").read_text("utf-8").splitlines())
    (slices,) = [row for row in rows if row["way"] == "all slices"]
    assert (float(slices["ap50"]), slices["right"], slices["reference"]) == (1.0, "1", "1")
