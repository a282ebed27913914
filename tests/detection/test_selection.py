"""Suppression and merging of boxes, in a pass, in several crops and in records, against plain loops and torchvision."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchvision.ops import batched_nms, nms

from semfov import Objects, merge_boxes
from semfov.detection import Candidates, Detections, Selection, letterbox, score_vectors
from semfov.detection.crops import merge_crops
from semfov.detection.objects import merge_looks, survivors
from semfov.detection.selection import select, suppress
from tests.refusals import refused
from tests.small import Fixed, area, shared


def suppressed(boxes, confidence, labels, selection):
    """Indices of the boxes that torchvision keeps, of those with an area."""
    whole = (boxes[:, 2:] > boxes[:, :2]).all(-1).nonzero()[:, 0]
    given = boxes[whole], confidence[whole], *([labels[whole]] if selection.per_class else [])
    return whole[(batched_nms if selection.per_class else nms)(*given, selection.iou)][: selection.limit]


@given(
    st.integers(0, 2**32),
    st.one_of(st.integers(0, 40), st.integers(100, 500)),
    st.booleans(),
    st.sampled_from([0.3, 0.5, 0.7]),
    st.one_of(st.integers(1, 15), st.integers(1, 400)),
)
def test_suppression_equals_torchvisions(dtype, seed, count, per_class, iou, limit):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator, dtype=dtype) * (10 if count < 100 else 60)
    boxes = torch.cat([corner, corner + torch.rand(count, 2, generator=generator, dtype=dtype) * 12 - 1], -1)
    confidence = torch.randperm(count, generator=generator).to(dtype) / count  # without ties
    labels = torch.randint(3, (count,), generator=generator)
    selection = Selection(iou=iou, limit=limit, per_class=per_class)
    expected = suppressed(boxes, confidence, labels, selection)
    assert torch.equal(suppress(boxes, confidence, labels, selection), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("per_class", [False, True])
def test_half_precision_boxes_are_suppressed_in_single_precision(dtype, per_class):
    candidates = make(40, batch=1, dtype=torch.float32)
    boxes, confidence = candidates.boxes[0].to(dtype), candidates.confidence[0].to(dtype)
    labels, selection = candidates.classes[0].argmax(-1), Selection(iou=0.02, per_class=per_class)
    keep = suppress(boxes, confidence, labels, selection)
    assert torch.equal(keep, suppress(boxes.float(), confidence.float(), labels, selection))
    assert torch.equal(keep, suppress(boxes.float(), confidence, labels, selection))  # one of both is enough
    assert torch.equal(keep, suppress(boxes, confidence.float(), labels, selection))
    assert 0 < len(keep) < 40


def make(count: int, batch: int = 2, classes: int = 3, dtype=torch.float64, seed: int = 0) -> Candidates:
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(batch, count, 2, generator=generator, dtype=dtype) * 60
    size = torch.rand(batch, count, 2, generator=generator, dtype=dtype) * 20 + 1
    return Candidates(
        torch.cat([corner, corner + size], -1),
        torch.rand(batch, count, classes, generator=generator, dtype=dtype),
        torch.rand(batch, count, generator=generator, dtype=dtype),
    )


def test_selection_applies_threshold_suppression_and_order():
    candidates = make(60)
    selection = Selection(threshold=0.3, limit=7)
    found = select(candidates, None, selection, "residual")
    for image in range(2):
        confident = (candidates.confidence[image] >= 0.3).nonzero()[:, 0]
        rows = candidates.take(image, confident)
        kept = suppressed(rows.boxes, rows.confidence, None, selection)
        assert found.count[image] == len(kept)
        own = found[image : image + 1]
        assert {tuple(box) for box in own.boxes[own.mask].tolist()} == {tuple(rows.boxes[i].tolist()) for i in kept}
        assert sorted(own.confidence[own.mask].tolist()) == sorted(rows.confidence[kept].tolist())
    best = found.scores[..., 1:].amax(-1)
    assert bool((best[:, :-1] >= best[:, 1:]).all())
    torch.testing.assert_close(found.scores.sum(-1), found.mask.double())


@pytest.mark.parametrize("faint", [0.0, 0.02, 0.3, 1.0])
def test_the_highest_scores_are_those_of_all_candidates_that_are_not_too_faint(faint):
    candidates = make(30)
    found = select(candidates, None, Selection(threshold=0.3, iou=0.1, limit=2), "residual", faint)
    vectors = score_vectors(candidates, "residual")
    for image in range(2):
        confidences = candidates.confidence[image].tolist()
        rows = [row for row, each in zip(vectors[image], confidences, strict=True) if each >= min(faint, 0.3)]
        for label in range(4):
            expected = max((float(row[label]) for row in rows), default=0.0)
            assert float(found.highest[image, label]) == pytest.approx(expected, rel=1e-12)


def test_a_detector_reads_candidates_that_are_too_faint_for_a_detection():
    boxes, classes = torch.rand(1, 3, 4).cumsum(-1) * 9, torch.tensor([[[1.0, 0.0], [0.1, 0.9], [0.8, 0.2]]])
    detector = Fixed(candidates=Candidates(boxes, classes, torch.tensor([[0.5, 0.01, 0.0001]])))
    seen = detector(torch.rand(1, 3, 8, 8))
    assert seen.count.tolist() == [1]
    torch.testing.assert_close(seen.highest[0, 1:], torch.tensor([0.5, 0.009]))


def test_boxes_outside_the_image_are_dropped():
    _, placement = letterbox(torch.zeros(1, 3, 32, 64), (64, 64))
    boxes = torch.tensor([[[10.0, 0.0, 20.0, 15.0], [10.0, 20.0, 20.0, 30.0]]])  # the first box lies in the padding
    found = select(Candidates(boxes, torch.ones(1, 2, 1)), placement, Selection(), "residual")
    torch.testing.assert_close(found.boxes, torch.tensor([[[10.0, 4.0, 20.0, 14.0]]]))


@pytest.mark.parametrize("count", [0, 5])
def test_a_selection_without_candidates_is_empty(count):
    found = select(make(count), None, Selection(threshold=1.0), "residual")
    assert found.boxes.shape == (2, 0, 4)
    assert found.scores.shape == (2, 0, 4)
    assert found.count.tolist() == [0, 0]
    candidates = make(5)
    candidates.objectness[0] = 0
    assert select(candidates, None, Selection(), "residual").count.tolist()[0] == 0


def test_gradients_reach_boxes_classes_and_objectness():
    candidates = make(20, batch=1)
    leaves = [x.requires_grad_() for x in (candidates.boxes, candidates.classes, candidates.objectness)]
    found = select(candidates, None, Selection(), "residual")
    (found.boxes.sum() + found.scores.square().sum()).backward()
    for leaf in leaves:
        rows = leaf.grad.reshape(20, -1).abs().sum(-1) > 0
        assert int(rows.sum()) == int(found.count)


def made_of(**changes):
    parts = {
        "boxes": torch.tensor([[[1.0, 1, 9, 9], [10, 10, 20, 20]]]),
        "classes": torch.tensor([[[0.9, 0.1], [0.2, 0.7]]]),
        "objectness": torch.tensor([[0.8, 0.6]]),
    }
    for name, value in changes.items():
        parts[name][0, 1] = value
    return Candidates(**parts)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"classes": torch.nan}, "confidence.*finite"),
        ({"objectness": torch.nan}, "confidence.*finite"),
        ({"boxes": torch.nan}, "boxes.*finite"),
        ({"boxes": torch.inf}, "boxes.*finite"),
        ({"classes": 1.5}, r"class scores.*\[0, 1\]"),
        ({"objectness": 2.0}, r"objectness.*\[0, 1\]"),
    ],
)
def test_invalid_scores_and_boxes_are_refused_and_are_no_image_without_detections(changes, message):
    image = torch.rand(1, 3, 32, 32)
    assert Fixed(candidates=made_of())(image).count.tolist() == [2]
    refused(message, Fixed(candidates=made_of(**changes)), image)


def test_what_is_checked_stays_so_in_parts_and_copies_and_not_with_other_numbers():
    candidates = made_of().as_checked()
    image = torch.rand(1, 3, 32, 32)
    assert candidates.take(0, torch.tensor([1])).are_checked
    assert candidates.precise().to(torch.device("cpu")).are_checked
    assert not made_of().are_checked
    changed = replace(candidates, classes=candidates.classes + 1)
    assert not changed.are_checked
    refused(r"class scores.*\[0, 1\]", Fixed(candidates=changed), image)


@pytest.mark.slow
def test_a_look_imports_no_compiler(fresh):
    """With torchvision's operators comes a compiler, which takes longer to import than torch itself."""
    code = """
import sys, torch
from semfov.detection.selection import Selection, suppress
suppress(torch.tensor([[0.0, 0, 9, 9]]), torch.ones(1), torch.zeros(1), Selection())
print([name for name in ("torch._dynamo", "torch._inductor", "sympy", "torchvision") if name in sys.modules])
"""
    assert fresh(code).strip() == "[]"


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
def testsurvivors_are_those_of_removing_one_box_after_the_other(count):
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
        assert survivors(count, better, worse).tolist() == stays
        lengths.add(len(stays))
    assert (len(lengths) > 1) == (count > 1)


def test_labels_that_are_no_numbers_of_classes_and_boxes_that_overflow_are_refused():
    boxes, scores = [[0, 0, 9, 9], [1, 1, 9, 9]], [0.9, 0.8]
    assert len(merge_boxes(boxes, scores, np.array([1, 1], np.uint8))) == 1
    for some, labels, said in (
        (boxes, [1.7, 1.2], "labels: expected whole numbers of classes"),
        (boxes, ["cup", "cup"], "labels: expected numbers"),
        ([[0, 0, 1e30, 1e30], [0, 0, 1e30, 1e30]], [1, 1], r"boxes: expected edges up to 1e\+09 pixels, got 1e\+30"),
    ):
        refused(said, merge_boxes, some, scores, labels)


SIDE, PICTURE = 16, (100, 80)
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
    seen = merge_crops(Detections(boxes, scores, mask), WINDOWS, len(rows), SIDE, PICTURE, limit)
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
    seen = merge_crops(Detections(box, scores, torch.ones(2, 1, dtype=torch.bool)), windows, 2, SIDE, PICTURE, 9)
    assert seen.scores[0].tolist() == scores[0].tolist()


def test_gradients_reach_the_boxes_and_scores_that_are_left():
    boxes = torch.tensor([[INSIDE], [INSIDE], [[70.0, 10, 80, 20]]], requires_grad=True)
    scores = torch.full((3, 1, 3), 1 / 3, requires_grad=True)
    seen = merge_crops(Detections(boxes, scores, torch.ones(3, 1, dtype=torch.bool)), WINDOWS, 3, SIDE, PICTURE, 9)
    (seen.boxes.sum() + seen.scores.sum()).backward()
    assert [bool(row.any()) for row in boxes.grad] == [True, False, True]
    assert [bool(row.any()) for row in scores.grad] == [True, False, True]
