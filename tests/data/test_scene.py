import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.data import Annotation, Scene, box_coverage, legal_targets
from semfov.errors import InputError


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


@given(integer_boxes(), st.floats(0.1, 8))
def test_coverage_does_not_depend_on_the_scale(case, factor):
    boxes, (width, height) = case
    tensor = torch.tensor(boxes, dtype=torch.float64)
    for coverage in ("sum", "union"):
        small = box_coverage(tensor, (width, height), coverage)
        large = box_coverage(tensor * factor, (width * factor, height * factor), coverage)
        assert large == pytest.approx(small, abs=1e-9)


def test_a_target_that_covers_exactly_the_limit_is_legal():
    boxes = torch.tensor(
        [[0.0, 0.0, 128.0, 480.0], [0.0, 0.0, 129.0, 480.0]]
    )  # exactly 20 % of 640 x 480, and slightly more
    scene = Annotation(boxes, torch.tensor([2, 5]), torch.zeros(2, dtype=torch.bool), (640, 480))
    assert legal_targets(scene, 0.2) == [2]
    assert legal_targets(scene, None) == [2, 5]


def test_bad_arguments():
    with pytest.raises(InputError, match="coverage"):
        box_coverage(torch.zeros(1, 4), (4, 4), "mean")
    with pytest.raises(InputError, match="boxes"):
        box_coverage(torch.zeros(4, 3), (4, 4))


def test_size_is_width_and_height():
    assert Scene(1, "a", torch.zeros(3, 4, 6), torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)).size == (6, 4)
