"""Coordinates on screens and in pictures: known mappings, and round trips."""

import json
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semfov.data.fixations import Fixations, Letterbox, coco_name, read_ruarte
from tests.refusals import refused

sides = st.integers(1, 3000)


@given(sides, sides, sides, sides)
def test_a_letterboxed_picture_fits_and_is_centred(width, height, across, down):
    placed = Letterbox((width, height), (across, down))
    corners = placed.to_screen(np.array([[-0.5, -0.5], [across - 0.5, down - 0.5]])) + 0.5
    left, top, right, bottom = corners.ravel()
    assert left == pytest.approx(width - right, abs=1e-6)
    assert top == pytest.approx(height - bottom, abs=1e-6)
    assert min(left, top) == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose(placed.to_picture(placed.to_screen(corners)), corners, atol=1e-6)
    np.testing.assert_allclose(placed.box_to_picture(placed.box_to_screen((1, 2, 3, 4))), (1, 2, 3, 4), atol=1e-6)


def test_letterbox_and_resizing_equal_values_computed_by_hand():
    # 640 × 480 on a screen of 1680 × 1050 becomes 1400 × 1050, with an offset of 140 from the left.
    placed = Letterbox((1680, 1050), (640, 480))
    assert placed.box_to_screen((0, 0, 640, 480)) == (140, 0, 1540, 1050)
    # 480 × 640 becomes 787.5 × 1050.
    assert Letterbox((1680, 1050), (480, 640)).offset == (446.25, 0)
    larger = Fixations("a.jpg", "1", [[0.0, 23.0]], (32, 24), box=(0, 0, 32, 24)).resized((1680, 1050))
    assert larger.box == (0, 0, 1680, 1050)
    np.testing.assert_allclose(larger.points, [[25.75, 1027.625]])
    refused(r"^picture:", Letterbox, (1680, 1050), (0, 5))


@pytest.mark.shared
def test_boxes_of_cocosearch_mapped_to_pictures_match_those_of_coco(shared):
    """Nine pictures are in both data sets. Boxes of COCO do not depend on the screen, so they check the mapping."""
    sizes, boxes = {}, defaultdict(list)
    for name in ("eval300", "fit"):
        data = json.loads((shared / f"coco/annotations/instances_{name}.json").read_text())
        names = {image["id"]: image["file_name"] for image in data["images"]}
        classes = {each["id"]: each["name"] for each in data["categories"]}
        sizes |= {image["file_name"]: (image["width"], image["height"]) for image in data["images"]}
        for each in data["annotations"]:
            x, y, w, h = each["bbox"]
            boxes[names[each["image_id"]], classes[each["category_id"]]].append((x, y, x + w, y + h))
    seen: dict[str, Fixations] = {}
    for file in sorted((shared / "human/cocosearch18/human_scanpaths").glob("*.json")):
        found = read_ruarte(file, sizes=sizes)
        seen |= {each.picture: each for each in found}
        assert all(each.inside.mean() > 0.5 for each in found)
    assert len(seen) == 9
    for each in seen.values():
        candidates = np.array(boxes[each.picture, each.target])
        off = np.abs(candidates - each.box).max(1).min()
        # Boxes of one data set are rounded to pixels of a reduced picture, those of the other to screen pixels.
        assert off < 2.5, (each.picture, off)


@pytest.mark.shared
def test_target_boxes_in_cells_of_models_match_those_in_pixels_of_people(shared):
    folder = shared / "human/cocosearch18"
    people = {each.picture: each for each in read_ruarte(folder / "human_scanpaths/subj01_scanpaths.json")}
    models = read_ruarte(folder / "predicted/nnIBS.json", screen=(1680, 1050))
    cell = np.array([1680 / 32, 1050 / 24] * 2)
    shifted = [
        np.abs((np.array(each.box) - people[each.picture].box) / cell).max()
        for each in models
        if each.picture in people
    ]
    assert len(shifted) > 500
    assert max(shifted) <= 1 + 1e-6
    assert coco_name("100000298773.jpg") == "000000298773.jpg"
