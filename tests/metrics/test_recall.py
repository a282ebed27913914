"""Objects found for an allowed number of false boxes: against loops, and counts by hand."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.errors import InputError
from semfov.metrics.recall import found_objects, score_for


def overlap(a, b):
    across = min(a[2], b[2]) - max(a[0], b[0])
    down = min(a[3], b[3]) - max(a[1], b[1])
    shared = max(across, 0) * max(down, 0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def found_by_loop(boxes, scores, truth, labels, iou):
    """Box by box in descending order of score, over all classes at once."""
    free = dict(enumerate(zip(truth, labels, strict=True)))
    found, false = [0.0] * len(truth), []
    best = [(max(row[1:]), row.index(max(row[1:]), 1), n) for n, row in enumerate(scores)]
    for score, label, n in sorted(best, key=lambda each: (-each[0], each[2])):
        fits = [(overlap(boxes[n], box), -m) for m, (box, own) in free.items() if own == label]
        if fits and max(fits)[0] >= iou:
            m = -max(fits)[1]
            found[m] = score
            del free[m]
        else:
            false.append(score)
    return found, false


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_found_objects_equal_those_of_a_loop(seed, dtype):
    generator = torch.Generator().manual_seed(seed)
    truth = torch.randint(0, 12, (6, 2), generator=generator).to(dtype)
    truth = torch.cat([truth, truth + torch.randint(4, 9, (6, 2), generator=generator)], -1)
    labels = torch.randint(1, 4, (6,), generator=generator)
    shift = torch.rand(20, 4, generator=generator, dtype=dtype)
    boxes = truth[torch.randint(6, (20,), generator=generator)] + shift
    scores = torch.rand(20, 4, generator=generator, dtype=dtype).softmax(-1)
    found, false = found_objects(boxes, scores, truth, labels, iou=0.6)
    expected, wrong = found_by_loop(boxes.tolist(), scores.tolist(), truth.tolist(), labels.tolist(), 0.6)
    assert found.tolist() == pytest.approx(expected)
    assert sorted(false.tolist()) == pytest.approx(sorted(wrong))
    assert found.dtype == false.dtype == dtype
    assert 0 < (found > 0).sum() < 6 or seed > 0


def test_images_without_boxes_or_without_objects():
    none, box = torch.zeros(0, 4), torch.tensor([[0.0, 0.0, 4.0, 4.0]])
    found, false = found_objects(none, torch.zeros(0, 3), box, torch.tensor([1]))
    assert (found.tolist(), false.tolist()) == ([0.0], [])
    found, false = found_objects(box, torch.tensor([[0.5, 0.25, 0.25]]), none, torch.zeros(0, dtype=torch.int64))
    assert (found.tolist(), false.tolist()) == ([], [0.25])


def test_results_stay_on_the_device(device):
    box = torch.tensor([[0.0, 0.0, 4.0, 4.0]], device=device)
    found, false = found_objects(box, torch.tensor([[0.0, 1.0]], device=device), box, torch.tensor([1], device=device))
    assert found.device.type == false.device.type == device.type


@given(st.lists(st.floats(0, 1), max_size=30), st.integers(1, 8), st.floats(0, 3))
def test_score_is_the_smallest_with_the_allowed_rate_of_false_boxes(scores, views, rate):
    false = torch.tensor(scores, dtype=torch.float64)
    score = score_for(false, views, rate)
    assert (false > score).sum() <= rate * views
    lower = false[false < score]
    if len(lower):
        assert (false > lower.max()).sum() > rate * views - 1


def test_at_least_one_view_is_needed():
    with pytest.raises(InputError, match="views: expected at least 1, got 0"):
        score_for(torch.zeros(1), 0)


def test_an_overlap_of_one_half_is_enough_and_less_is_not():
    """An object of 4 × 2 px, and boxes that cover 4 and 3 of its 8 px²."""
    truth, label, score = torch.tensor([[0.0, 0.0, 4.0, 2.0]]), torch.tensor([1]), torch.tensor([[0.1, 0.9]])
    for box, expected in (([0.0, 0.0, 2.0, 2.0], 0.9), ([0.0, 0.0, 1.5, 2.0], 0.0)):
        found, _ = found_objects(torch.tensor([box]), score, truth, label)
        assert found.tolist() == pytest.approx([expected])


@pytest.mark.parametrize(
    ("argument", "shapes"),
    [
        ("scores", ((2, 4), (3, 3), (1, 4), (1,))),
        ("scores", ((2, 4), (2,), (1, 4), (1,))),
        ("truth", ((2, 4), (2, 3), (1, 5), (1,))),
        ("truth", ((2, 4), (2, 3), (2, 4), (1,))),
        ("truth", ((2, 4), (2, 3), (4,), (4,))),
    ],
)
def test_shapes_that_do_not_match_are_refused(argument, shapes):
    *tensors, labels = shapes
    with pytest.raises(InputError, match=f"^{argument}: expected a tensor of shape"):
        found_objects(*(torch.rand(shape) for shape in tensors), torch.ones(labels, dtype=torch.int64))


def test_one_false_box_per_view_is_allowed_by_default():
    scores = torch.tensor([0.9, 0.7, 0.5, 0.3, 0.1])
    assert score_for(scores, 1) == pytest.approx(0.7)
    assert score_for(scores, 3) == pytest.approx(0.3)
