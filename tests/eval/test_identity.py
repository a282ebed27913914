"""Numbers that stay with objects: IDF1 by all pairings, ByteTrack, and pasted objects that move."""

from itertools import permutations

import numpy as np
import pytest
import torch

from eval.stream.bytetrack import ByteTrack
from eval.stream.flights import Course, flight
from eval.stream.identity import Identities
from semfov.detection.objects import Objects
from tests.eval.test_stream import FRAME, scene
from tests.small import iou


def boxes_at(*lefts):
    return torch.tensor([[left, 0.0, left + 10, 10.0] for left in lefts]).view(-1, 4)


def test_a_number_that_changes_counts_for_the_longer_part():
    """An object in ten frames, under one number in six of them and under another in four; as MOTChallenge counts."""
    identities = Identities()
    for frame in range(10):
        identities.step(torch.tensor([5]), boxes_at(0), torch.tensor([1 if frame < 6 else 2]), boxes_at(0))
    counts = identities.counts()
    assert counts[:3] == (6, 10, 10)
    assert counts.score == pytest.approx(0.6)


@pytest.mark.parametrize("seed", range(5))
def test_the_score_is_that_of_the_best_of_all_pairings(seed):
    random, identities = np.random.default_rng(seed), Identities()
    meetings = np.zeros((4, 4))
    for _ in range(30):
        there, told = random.permutation(4)[:3], random.permutation(4)[:3]
        places = random.permutation(3)
        identities.step(
            torch.from_numpy(there), boxes_at(0, 50, 100), torch.from_numpy(told), boxes_at(*(50 * places).tolist())
        )
        for number, place in zip(told, places, strict=True):
            meetings[there[place], number] += 1
    best = max(meetings[range(4), order].sum() for order in permutations(range(4)))
    assert identities.counts().score == pytest.approx(2 * best / 180)


def test_boxes_of_moving_objects_are_counted_apart():
    identities = Identities()
    moving = torch.tensor([True, False])
    identities.step(torch.tensor([1, 2]), boxes_at(0, 50), torch.tensor([7]), boxes_at(50), moving)
    identities.step(torch.tensor([1, 2]), boxes_at(0, 50), torch.tensor([7]), boxes_at(1), moving)
    assert identities.counts()[1:] == (2, 4, 2, 1, 2)


def test_bytetrack_keeps_a_number_through_a_gap_and_faint_detections():
    tracker, numbers = ByteTrack(), []
    for frame in range(30):
        score = 0.2 if 8 <= frame < 12 else 0.9
        boxes = boxes_at(*([] if 15 <= frame < 20 else [2.0 * frame]))
        count = len(boxes)
        objects = Objects(boxes, torch.full((count,), score), torch.ones(count).long(), torch.zeros(count).long())
        shown = tracker.step(objects)
        numbers.append(shown.track_ids.tolist())
    assert [number for number in numbers if number] == [[1]] * 25


def test_a_faint_detection_begins_no_track():
    tracker = ByteTrack()
    faint = Objects(boxes_at(0), torch.tensor([0.4]), torch.tensor([1]), torch.tensor([0]))
    assert [len(tracker.step(faint)) for _ in range(5)] == [0] * 5


def test_pasted_objects_move_on_their_own_and_have_their_boxes():
    """Red squares, in each frame where the boxes of the moving ones say."""
    seen = 0
    steps = {}
    for frame in flight(scene(), Course(pasted=6), FRAME, 20, 3):
        red = (frame.pixels[..., 0].astype(int) - frame.pixels[..., 1]) > 100
        for number, box in zip(frame.identities.tolist(), frame.annotation.boxes, strict=True):
            x1, y1, x2, y2 = box.round().int().tolist()
            if min(x1, y1) < 1 or x2 >= FRAME[0] or y2 >= FRAME[1] or number == 0:
                continue
            seen += 1
            ys, xs = red[y1:y2, x1:x2].nonzero()
            around = (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
            assert iou((0, 0, x2 - x1, y2 - y1), around) > 0.8
            steps.setdefault(number, []).append((box[:2] + box[2:]) / 2)
        assert frame.moving.tolist() == [number > 0 for number in frame.identities.tolist()]
    assert seen > 10
    ways = [torch.stack(places) for places in steps.values() if len(places) > 4]
    speeds = torch.cat([(way[1:] - way[:-1]).norm(dim=-1) for way in ways])
    # Places are whole pixels, and an object that bounces, or was at the border in between, moves by another way.
    assert 2 < float(speeds.median()) < 11
