import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchvision.ops import batched_nms, nms

from semfov.detection import Candidates, Selection, letterbox
from semfov.detection.selection import select, suppress
from tests.refusals import refused
from tests.small import Fixed, iou


def brute_force(boxes, confidence, labels, selection) -> list[int]:
    kept: list[int] = []
    for i in sorted(range(len(boxes)), key=lambda i: -confidence[i]):
        if boxes[i][2] <= boxes[i][0] or boxes[i][3] <= boxes[i][1]:
            continue
        rivals = [j for j in kept if not selection.per_class or labels[i] == labels[j]]
        if all(iou(boxes[i], boxes[j]) <= selection.iou for j in rivals):
            kept.append(i)
    return kept[: selection.limit]


@given(st.integers(0, 2**32), st.integers(0, 40), st.booleans(), st.sampled_from([0.3, 0.5, 0.7]), st.integers(1, 15))
def test_suppression_equals_brute_force(dtype, seed, count, per_class, iou, limit):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator, dtype=dtype) * 10
    boxes = torch.cat([corner, corner + torch.rand(count, 2, generator=generator, dtype=dtype) * 12 - 1], -1)
    confidence = torch.rand(count, generator=generator, dtype=dtype)
    labels = torch.randint(3, (count,), generator=generator)
    selection = Selection(iou=iou, limit=limit, per_class=per_class)
    keep = suppress(boxes, confidence, labels, selection)
    assert keep.tolist() == brute_force(boxes.tolist(), confidence.tolist(), labels.tolist(), selection)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("per_class", [False, True])
def test_half_precision_boxes_are_suppressed_in_single_precision(dtype, per_class):
    candidates = make(40, batch=1, dtype=torch.float32)
    boxes, confidence = candidates.boxes[0].to(dtype), candidates.confidence[0].to(dtype)
    labels, selection = candidates.classes[0].argmax(-1), Selection(iou=0.02, per_class=per_class)
    keep = suppress(boxes, confidence, labels, selection)
    assert torch.equal(keep, suppress(boxes.float(), confidence.float(), labels, selection))
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
        kept = brute_force(rows.boxes.tolist(), rows.confidence.tolist(), [0] * len(confident), selection)
        assert found.count[image] == len(kept)
        own = found[image : image + 1]
        assert {tuple(box) for box in own.boxes[own.mask].tolist()} == {tuple(rows.boxes[i].tolist()) for i in kept}
    assert bool((found.confidence[:, :-1] >= found.confidence[:, 1:]).all())
    torch.testing.assert_close(found.scores.sum(-1), found.mask.double())


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


@given(st.integers(0, 2**32), st.integers(100, 500), st.booleans(), st.integers(1, 400))
def test_suppression_of_many_boxes_equals_torchvision(seed, count, per_class, limit):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 60
    boxes = torch.cat([corner, corner + 1 + torch.rand(count, 2, generator=generator) * 20], -1)
    confidence = torch.randperm(count, generator=generator) / count  # without ties
    labels = torch.randint(3, (count,), generator=generator)
    expected = batched_nms(boxes, confidence, labels, 0.5) if per_class else nms(boxes, confidence, 0.5)
    selection = Selection(limit=limit, per_class=per_class)
    assert torch.equal(suppress(boxes, confidence, labels, selection), expected[:limit])


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
