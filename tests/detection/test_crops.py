"""Detections in several crops: what is left out, and what is merged."""

import pytest
import torch

from semfov.detection import Detections
from semfov.detection.crops import merge_crops

SIDE, SIZE = 16, (100, 80)
WINDOWS = torch.tensor([[42.0, 32, 58, 48], [34, 24, 66, 56], [18, 8, 82, 72]])


def merged(*found, limit=100):
    """Merge boxes of one look, given as (crop, box, class, score) of classes 1 and 2; gives (box, class, score)."""
    rows = [[each for each in found if each[0] == crop] for crop in range(len(WINDOWS))]
    most = max(map(len, rows))
    boxes, scores = torch.zeros(len(rows), most, 4), torch.zeros(len(rows), most, 3)
    mask = torch.zeros(len(rows), most, dtype=torch.bool)
    for number, row in enumerate(rows):
        for place, (_, box, label, score) in enumerate(row):
            boxes[number, place], mask[number, place] = torch.tensor(box), True
            scores[number, place, 0], scores[number, place, label] = 1 - score, score
    seen = merge_crops(Detections(boxes, scores, mask), WINDOWS, len(rows), SIDE, SIZE, limit)
    confidence = seen.confidence[0].tolist()
    return [
        (b, k, round(s, 4)) for b, k, s in zip(seen.boxes[0].tolist(), seen.labels[0].tolist(), confidence, strict=True)
    ]


INSIDE = [45.0, 36.0, 53.0, 44.0]  # well inside the finest crop
ACROSS = [50.0, 36.0, 60.0, 44.0]  # reaches beyond the finest crop
PART = [50.0, 36.0, 58.0, 44.0]  # what the finest crop shows of it


@pytest.mark.parametrize(
    ("found", "left"),
    [
        # What a finer crop shows whole is left out of wider ones, of any class, and also where the finer has no box.
        ([(0, INSIDE, 1, 0.3), (1, INSIDE, 1, 0.9), (2, INSIDE, 2, 0.8)], [(INSIDE, 1, 0.3)]),
        ([(1, INSIDE, 1, 0.9)], []),
        # A whole box is kept rather than a part of it, although the part has a higher score.
        ([(0, PART, 1, 0.9), (1, ACROSS, 1, 0.4)], [(ACROSS, 1, 0.4)]),
        # The part stays where no crop has the whole, and where the whole is of another class.
        ([(0, PART, 1, 0.9)], [(PART, 1, 0.9)]),
        ([(0, PART, 1, 0.9), (1, ACROSS, 2, 0.4)], [(PART, 1, 0.9), (ACROSS, 2, 0.4)]),
        # The second crop shows it whole, so the third need not.
        ([(1, ACROSS, 1, 0.4), (2, ACROSS, 1, 0.9)], [(ACROSS, 1, 0.4)]),
        # The most confident box comes first, and boxes end at the border of the picture.
        (
            [(2, [60.0, 60.0, 90.0, 95.0], 1, 0.2), (0, INSIDE, 2, 0.1), (2, [101.0, 0.0, 120.0, 20.0], 1, 0.9)],
            [([60.0, 60.0, 90.0, 80.0], 1, 0.2), (INSIDE, 2, 0.1)],
        ),
    ],
)
def test_what_is_left_of_the_boxes_of_crops(found, left):
    assert merged(*found) == left
    assert merged(*found, limit=1) == left[:1]


def test_the_border_of_the_picture_cuts_no_object():
    windows = torch.tensor([[-6.0, -6, 10, 10], [-14, -14, 18, 18]])
    box = torch.tensor([[[0.0, 0, 7, 7]], [[0.0, 0, 7, 7]]])
    scores = torch.tensor([[[0.6, 0.4]], [[0.1, 0.9]]])
    seen = merge_crops(Detections(box, scores, torch.ones(2, 1, dtype=torch.bool)), windows, 2, SIDE, SIZE, 9)
    assert seen.scores[0].tolist() == scores[0].tolist()


def test_gradients_reach_the_boxes_and_scores_that_are_left():
    boxes = torch.tensor([[INSIDE], [INSIDE], [[70.0, 10, 80, 20]]], requires_grad=True)
    scores = torch.full((3, 1, 3), 1 / 3, requires_grad=True)
    seen = merge_crops(Detections(boxes, scores, torch.ones(3, 1, dtype=torch.bool)), WINDOWS, 3, SIDE, SIZE, 9)
    (seen.boxes.sum() + seen.scores.sum()).backward()
    assert [bool(row.any()) for row in boxes.grad] == [True, False, True]
    assert [bool(row.any()) for row in scores.grad] == [True, False, True]
