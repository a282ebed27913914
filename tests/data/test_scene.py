"""Scenes, how much of them boxes cover, and the scenes of a set that hold most objects."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.data import Annotation, EmbeddedScenes, Scene, box_coverage, legal_targets
from semfov.fit.windows import crowded
from tests.refusals import refused


@st.composite
def integer_boxes(draw):
    width, height = draw(st.integers(1, 30)), draw(st.integers(1, 30))
    boxes = []
    for _ in range(draw(st.integers(0, 8))):
        x1, y1 = draw(st.integers(0, width - 1)), draw(st.integers(0, height - 1))
        boxes.append((x1, y1, draw(st.integers(x1 + 1, width)), draw(st.integers(y1 + 1, height))))
    return np.array(boxes, dtype=np.int64).reshape(-1, 4), (width, height)


@given(integer_boxes())
def test_coverage_equals_counts_on_a_pixel_grid(case):
    boxes, (width, height) = case
    grid = np.zeros((height, width), dtype=int)
    for x1, y1, x2, y2 in boxes:
        grid[y1:y2, x1:x2] += 1
    tensor = torch.tensor(boxes, dtype=torch.float32)
    assert box_coverage(tensor, (width, height), "sum") == grid.sum() / grid.size
    assert box_coverage(tensor, (width, height), "union") == pytest.approx((grid > 0).mean(), abs=1e-12)


def test_a_target_that_covers_exactly_the_limit_is_legal():
    boxes = torch.tensor(
        [[0.0, 0.0, 128.0, 480.0], [0.0, 0.0, 129.0, 480.0]]
    )  # exactly 20 % of 640 x 480, and slightly more
    scene = Annotation(boxes, torch.tensor([2, 5]), torch.zeros(2, dtype=torch.bool), (640, 480))
    assert legal_targets(scene, 0.2) == [2]
    assert legal_targets(scene, None) == [2, 5]


def test_size_is_width_and_height():
    assert Scene(1, "a", torch.zeros(3, 4, 6), torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)).size == (6, 4)


def test_no_scene_that_is_left_out_holds_more_objects_than_one_that_is_kept():
    scenes = EmbeddedScenes(("person", "cat", "dog"), count=9, seed=3)
    most = crowded(scenes, 0.4)
    counts = {name: len(scenes.annotation(index).boxes) for index, name in enumerate(scenes.ids)}
    assert len(most) == len(most.ids) == 4  # 3.6 rounded up
    assert len(set(counts.values())) > 1
    left = [counts[name] for name in scenes.ids if name not in most.ids]
    assert min(counts[name] for name in most.ids) >= max(left)
    assert most.ids == sorted(most.ids)


def test_a_scene_is_that_of_the_set():
    scenes = EmbeddedScenes(("person", "cat", "dog"), count=6, seed=3)
    most = crowded(scenes, 0.5)
    for index, name in enumerate(most.ids):
        place = scenes.ids.index(name)
        assert torch.equal(most[index].image, scenes[place].image)
        assert torch.equal(most.annotation(index).boxes, scenes.annotation(place).boxes)
        assert most.targets(index) == scenes.targets(place)
        assert most.digest(index) == scenes.digest(place)
    assert most.classes == scenes.classes
    assert len({most.fingerprint, scenes.fingerprint, crowded(scenes, 0.3).fingerprint}) == 3


def test_coverages_and_shares_out_of_range_are_refused():
    refused("coverage", box_coverage, torch.zeros(1, 4), (4, 4), "mean")
    refused("boxes", box_coverage, torch.zeros(4, 3), (4, 4))
    for share in [0.0, -0.1, 1.5, float("nan")]:
        refused("share: expected above 0", crowded, EmbeddedScenes(("person",), count=2), share)
