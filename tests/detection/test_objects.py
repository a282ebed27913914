"""Merging of boxes that were computed anywhere, and suppression by pairs of boxes, against plain loops."""

import numpy as np
import pytest
import torch

from semfov import Objects, merge_boxes
from semfov.detection.objects import _survivors, merge_looks
from tests.refusals import refused
from tests.small import area, shared

SIZE = (1000, 800)


def plain(rows, turn=None):
    """Indices of the boxes that stay; rows are (cut, -sharpness, -score, index, look, label, box)."""
    shifts = (0,) if turn is None else (-turn, 0, turn)
    kept = []
    for cut, _, score, index, look, label, box in sorted(rows):
        for _, _, other_look, other_label, other in kept:
            moved = ([box[0] + by, box[1], box[2] + by, box[3]] for by in shifts)
            most = max(shared(each, other) for each in moved)
            same = most >= 0.5 * (area(box) + area(other) - most)
            same = same or (cut and look != other_look and most >= 0.8 * area(box))
            if same and label == other_label:
                break
        else:
            kept.append((score, index, look, label, box))
    return sorted(kept, key=lambda row: row[0])


def scattered(seed):
    """Boxes of two classes in windows of three sizes, and these windows; a third of the boxes reach a border."""
    generator = np.random.default_rng(seed)
    boxes, windows = [], []
    for side in (1000, 500, 250):
        for left in range(0, 1000, side):
            for top in range(0, 800, side):
                window = [left, top, min(left + side, 1000), min(top + side, 800)]
                for _ in range(12):
                    x, y = generator.uniform(window[0], window[2] - 20), generator.uniform(window[1], window[3] - 20)
                    w, h = generator.uniform(20, 0.4 * side, 2)
                    boxes.append([x, y, min(x + w, window[2]), min(y + h, window[3])])
                    windows.append(window)
    boxes, windows = np.array(boxes), np.array(windows, float)
    return boxes, generator.uniform(0, 1, len(boxes)), generator.integers(1, 3, len(boxes)), windows


@pytest.mark.parametrize("seed", range(3))
def test_merging_with_windows_equals_a_plain_loop(seed):
    boxes, scores, labels, windows = scattered(seed)
    looks = {tuple(window): number for number, window in reversed(list(enumerate(dict.fromkeys(map(tuple, windows)))))}
    rows, broken = [], 0
    for index, (box, score, label, window) in enumerate(zip(boxes, scores, labels, windows, strict=True)):
        if score < 0.05:
            continue
        side = max(window[2] - window[0], window[3] - window[1])
        margin = side * 2 / 416
        borders = [window[0] if window[0] > 0 else -np.inf, window[1] if window[1] > 0 else -np.inf]
        borders += [window[2] if window[2] < SIZE[0] else np.inf, window[3] if window[3] < SIZE[1] else np.inf]
        cut = bool(np.any(np.abs(box - np.array(borders)) <= margin))
        broken += cut
        rows.append((cut, side, -score, index, looks[tuple(window)], int(label), box.tolist()))
    expected = plain(rows)
    merged = merge_boxes(boxes, scores, labels, windows, size=SIZE)
    assert isinstance(merged, Objects)
    assert 50 < broken < len(rows) - 50
    assert 20 < len(expected) < len(rows) - 20
    assert merged.passes.tolist() == [look for _, _, look, _, _ in expected]
    assert merged.labels.tolist() == [label for *_, label, _ in expected]
    torch.testing.assert_close(merged.boxes, torch.tensor([box for *_, box in expected], dtype=torch.float64))
    # The windows cover the picture, so its size need not be given.
    assert torch.equal(merge_boxes(boxes, scores, labels, windows).boxes, merged.boxes)
    order = torch.randperm(len(boxes), generator=torch.Generator().manual_seed(seed))
    shuffled = merge_boxes(boxes[order], scores[order], labels[order], windows[order])
    assert torch.equal(shuffled.boxes, merged.boxes)


def test_boxes_meet_across_the_seam_of_a_panorama():
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(150, 2, generator=generator) * torch.tensor([200.0, 60])
    boxes = torch.cat([corner, corner + 10 + torch.rand(150, 2, generator=generator) * 40], -1)
    scores, sharpness = torch.rand(2, 150, generator=generator)
    labels, looks = torch.randint(1, 3, (2, 150), generator=generator)
    cut = torch.rand(150, generator=generator) < 0.3
    parts = (cut, -sharpness, -scores, torch.arange(150), looks, labels, boxes)
    rows = [row for row in zip(*(part.tolist() for part in parts), strict=True) if row[2] <= -0.05]
    found = {}
    for turn in (None, 200.0):
        merged = merge_looks(boxes, scores, labels, looks, cut, sharpness, around=turn)
        expected = plain(rows, turn)
        torch.testing.assert_close(merged.boxes, torch.tensor([box for *_, box in expected]))
        found[turn] = len(merged)
    assert found[200.0] < found[None]


def test_without_windows_it_is_suppression_by_class():
    boxes = [[0, 0, 10, 10], [1, 0, 11, 10], [1, 0, 11, 10]]
    merged = merge_boxes(boxes, [0.5, 0.9, 0.7], [1, 1, 2])
    assert merged.boxes.tolist() == [[1, 0, 11, 10], [1, 0, 11, 10]]
    assert merged.labels.tolist() == [1, 2]
    assert len(merge_boxes([], [], [])) == 0
    assert len(merge_boxes(boxes, [0.5, 0.9, 0.7], [1, 1, 2], score=0.8)) == 1


def test_wrong_arguments_are_refused_by_name():
    box, window = [[0.0, 0, 10, 10]], [[0.0, 0, 20, 20]]
    for arguments, options, message in (
        (([[0.0, 0, 10]], [0.5], [1]), {}, "boxes: expected a tensor of shape"),
        ((box, [0.5, 0.4], [1]), {}, "scores: expected a tensor of shape"),
        ((box, [1.5], [1]), {}, "scores: expected numbers from 0 to 1"),
        ((box, [float("nan")], [1]), {}, "scores: expected finite numbers"),
        ((box, [0.5], [1, 2]), {}, "labels: expected a tensor of shape"),
        ((box, [0.5], [1], window * 2), {}, "windows: expected a tensor of shape"),
        ((box, [0.5], [1], [[0.0, 0, 0, 0]]), {}, "windows: expected boxes"),
        ((box, [0.5], [1]), {"iou": 2}, "iou"),
        (("many", [0.5], [1]), {}, "boxes: expected numbers"),
    ):
        refused(message, merge_boxes, *arguments, **options)


@pytest.mark.parametrize("count", [1, 2, 12, 60])
def test_survivors_are_those_of_removing_one_box_after_the_other(count):
    lengths = set()
    for seed in range(20):
        generator = np.random.default_rng(seed)
        pairs = generator.integers(count, size=(2 * count, 2))
        pairs = pairs[pairs[:, 0] != pairs[:, 1]]
        better, worse = pairs.min(1), pairs.max(1)
        stays: list[int] = []
        for box in range(count):
            if not any(one in stays and other == box for one, other in zip(better, worse, strict=True)):
                stays.append(box)
        assert _survivors(count, better, worse).tolist() == stays
        lengths.add(len(stays))
    assert (len(lengths) > 1) == (count > 1)


def test_labels_that_are_no_numbers_of_classes_and_boxes_that_overflow_are_refused():
    boxes, scores = [[0, 0, 9, 9], [1, 1, 9, 9]], [0.9, 0.8]
    assert len(merge_boxes(boxes, scores, np.array([1, 1], np.uint8))) == 1
    for given, labels, said in (
        (boxes, [1.7, 1.2], "labels: expected whole numbers of classes"),
        (boxes, ["cup", "cup"], "labels: expected numbers"),
        ([[0, 0, 1e30, 1e30], [0, 0, 1e30, 1e30]], [1, 1], r"boxes: expected edges up to 1e\+09 pixels, got 1e\+30"),
    ):
        refused(said, merge_boxes, given, scores, labels)
