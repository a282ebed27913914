"""Detections: batches, score vectors, and conversion to and from Supervision's, torchvision's and COCO's formats."""

import contextlib
import io
import sys
from dataclasses import replace

import numpy as np
import pytest
import supervision
import torch
from hypothesis import given
from hypothesis import strategies as st
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torchvision.ops import box_iou

from semfov import Detections
from semfov.detection import Candidates, score_vectors
from semfov.detection.exchange import category_ids
from tests.refusals import refused


def detections(counts: list[int], classes: int = 3, seed: int = 0) -> Detections:
    generator = torch.Generator().manual_seed(seed)
    length = max(counts)
    mask = torch.arange(length) < torch.tensor(counts)[:, None]
    scores = torch.rand(len(counts), length, classes + 1, generator=generator).softmax(-1) * mask[..., None]
    boxes = torch.rand(len(counts), length, 4, generator=generator) * mask[..., None]
    return Detections(boxes, scores, mask)


def test_batches_are_stacked_indexed_and_counted_and_may_be_empty():
    parts = [detections([2, 1]), detections([4], seed=1), Detections.empty(1, 3)]
    whole = Detections.stack(parts)
    assert whole.count.tolist() == [2, 1, 4, 0]
    assert whole.boxes.shape == (4, 4, 4)
    assert not whole.boxes[~whole.mask].any()
    torch.testing.assert_close(whole.boxes[2], parts[1].boxes[0])
    torch.testing.assert_close(whole.scores[0, :2], parts[0].scores[0])
    d = detections([2, 1, 3])
    assert d[1:].count.tolist() == [1, 3]
    assert d[0].count.item() == 2
    assert d[torch.tensor([2, 0])].count.tolist() == [3, 2]
    d = Detections.empty(2, 80, like=torch.zeros(1, dtype=torch.float64))
    assert d.scores.shape == (2, 0, 81)
    assert d.boxes.dtype == torch.float64
    assert d.count.tolist() == [0, 0]
    assert d.labels.shape == (2, 0)
    refused("at least one", Detections.stack, [])
    scores = torch.tensor([[[0.5, 0.1, 0.4], [0.1, 0.6, 0.3], [0.0, 0.0, 0.0]]])
    d = Detections(torch.zeros(1, 3, 4), scores, torch.tensor([[True, True, False]]))
    assert d.count.tolist() == [2]
    torch.testing.assert_close(d.confidence, torch.tensor([[0.4, 0.6, 0.0]]))
    assert d.labels.tolist() == [[2, 1, 0]]


EXACT = {"atol": 1e-12, "rtol": 0}


def candidates(classes, objectness=None, background=None) -> Candidates:
    as_tensor = [None if x is None else torch.tensor([x], dtype=torch.float64) for x in (objectness, background)]
    return Candidates(torch.zeros(1, 1, 4), torch.tensor([[classes]], dtype=torch.float64), *as_tensor)


@pytest.mark.parametrize(
    ("policy", "classes", "objectness", "background", "expected"),
    [
        ("residual", [0.6, 0.2], [0.5], None, [0.5, 0.375, 0.125]),
        ("residual", [0.6, 0.2], None, None, [0.4, 0.45, 0.15]),
        ("residual", [0.0, 0.0], [0.5], None, [0.5, 0.25, 0.25]),
        ("normalised", [0.6, 0.2], [0.5], None, [5 / 9, 3 / 9, 1 / 9]),
        ("normalised", [0.6, 0.2], None, None, [2 / 6, 3 / 6, 1 / 6]),
        ("uniform", [0.6, 0.2], [0.5], None, [1 / 3, 1 / 2, 1 / 6]),
        ("none", [0.6, 0.2], [0.5], None, [0.0, 0.75, 0.25]),
        ("own", [0.6, 0.2], None, [0.1], [0.1, 0.675, 0.225]),
    ],
)
def test_background_policies_on_computed_examples(policy, classes, objectness, background, expected):
    scores = score_vectors(candidates(classes, objectness, background), policy)
    torch.testing.assert_close(scores, torch.tensor([[expected]], dtype=torch.float64), **EXACT)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=6),
    st.floats(0, 1),
    st.sampled_from(["residual", "normalised", "uniform", "none"]),
)
def test_score_vectors_are_points_of_the_simplex(dtype, classes, objectness, policy):
    c = Candidates(
        torch.zeros(1, 4, dtype=dtype), torch.tensor([classes], dtype=dtype), torch.tensor([objectness]).to(dtype)
    )
    scores = score_vectors(c, policy)
    assert scores.dtype == dtype
    assert bool((scores >= 0).all())
    torch.testing.assert_close(scores.sum(-1), torch.ones(1, dtype=dtype), atol=1e-6, rtol=0)
    if max(classes) > 1e-3 and (objectness > 1e-3 or policy in ("uniform", "none")):
        assert scores[0, 1:].argmax() == torch.tensor(classes, dtype=dtype).argmax()


@pytest.mark.parametrize("policy", ["residual", "normalised", "uniform", "none"])
def test_score_vectors_are_differentiable(policy):
    classes = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    objectness = torch.rand(2, dtype=torch.float64, requires_grad=True)
    boxes = torch.zeros(2, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c, o: score_vectors(Candidates(boxes, c, o), policy), (classes, objectness))


def test_compiles_to_a_single_graph():
    c = Candidates(torch.rand(5, 4), torch.rand(5, 3), torch.rand(5))
    compiled = torch.compile(score_vectors, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(c), score_vectors(c))


CLASSES = ("person", "cup", "tvmonitor")


def some(count=4, *, padding=0, seed=0, dtype=torch.float32, classes=3):
    """A batch of one, in descending order of confidence."""
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 50
    boxes = torch.cat([corner, corner + 5 + torch.rand(count, 2, generator=generator) * 40], -1)
    scores = torch.randn(count, classes + 1, generator=generator).mul(2).softmax(-1)
    order = scores[:, 1:].amax(-1).argsort(descending=True)
    mask = torch.arange(count + padding) < count
    pad = torch.nn.functional.pad
    return Detections(
        pad(boxes[order], (0, 0, 0, padding))[None].to(dtype), pad(scores[order], (0, 0, 0, padding))[None].to(dtype),
        mask[None],
    )  # fmt: skip


def same(a, b):
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("boxes", "scores", "mask"))


@pytest.mark.parametrize("count", [0, 1, 5])
def test_conversion_to_supervision_and_back_is_lossless(count, dtype):
    seen = some(count, padding=2, dtype=dtype)
    converted = seen.to_supervision(CLASSES)
    assert isinstance(converted, supervision.Detections)
    assert len(converted) == count
    np.testing.assert_array_equal(converted.class_id, seen.labels[0, :count].numpy() - 1)
    np.testing.assert_array_equal(converted.confidence, seen.confidence[0, :count].numpy())
    assert converted.data["class_name"].tolist() == [CLASSES[label - 1] for label in seen.labels[0, :count].tolist()]
    back = Detections.from_supervision(converted, len(CLASSES))
    assert same(back, some(count, dtype=dtype))


def test_supervision_can_select_merge_and_draw_them():
    """The selection, merging and drawing of Supervision accept the converted detections."""
    seen = some(5)
    out = seen.to_supervision(CLASSES)
    sure = out[out.confidence > float(seen.confidence[0, 2])]
    assert len(sure) == 2
    best = Detections(seen.boxes[:, :2], seen.scores[:, :2], seen.mask[:, :2])
    assert same(Detections.from_supervision(sure, 3), best)
    assert len(supervision.Detections.merge([out, out])) == 10
    scene = supervision.BoxAnnotator().annotate(np.zeros((100, 100, 3), np.uint8), out)
    assert scene.any()


def test_detections_of_other_models_in_supervisions_format():
    """With only a class and a confidence the rest of the probability is background; order is by confidence."""
    theirs = supervision.Detections(
        xyxy=np.array([[0, 0, 5, 5], [1, 2, 3, 4]]), confidence=np.array([0.25, 0.75]), class_id=np.array([0, 2])
    )
    seen = Detections.from_supervision(theirs, 3)
    torch.testing.assert_close(seen.boxes, torch.tensor([[[1.0, 2, 3, 4], [0, 0, 5, 5]]]))
    expected = torch.tensor([[[0.25, 0, 0, 0.75], [0.75, 0.25, 0, 0]]])
    torch.testing.assert_close(seen.scores, expected, check_dtype=False)
    sure = Detections.from_supervision(supervision.Detections(np.zeros((1, 4)), class_id=np.array([1])), 3)
    assert sure.scores.tolist() == [[[0, 0, 1, 0]]]
    assert Detections.from_supervision(supervision.Detections.empty(), 3).scores.shape == (1, 0, 4)


def test_conversion_to_torchvision_and_back():
    seen = some(5, padding=1)
    out = seen.to_torchvision()
    assert {name: tuple(value.shape) for name, value in out.items()} == {
        "boxes": (5, 4),
        "labels": (5,),
        "scores": (5,),
    }
    assert out["labels"].dtype == torch.int64
    back = Detections.from_torchvision(out, 3)
    torch.testing.assert_close(back.boxes, seen.boxes[:, :5])
    torch.testing.assert_close(back.confidence, seen.confidence[:, :5])
    assert torch.equal(back.labels, seen.labels[:, :5])
    torch.testing.assert_close(back.scores.sum(-1), torch.ones(1, 5))
    torch.testing.assert_close(box_iou(out["boxes"], back.boxes[0]).diagonal(), torch.ones(5))
    target = Detections.from_torchvision({"boxes": out["boxes"], "labels": out["labels"]}, 3)
    assert (target.confidence == 1).all()


def test_output_of_a_torchvision_detector(device):
    """The output of a torchvision detector is accepted without changes."""
    from torchvision.models.detection import ssdlite320_mobilenet_v3_large

    torch.manual_seed(0)
    model = ssdlite320_mobilenet_v3_large(weights=None, weights_backbone=None, num_classes=4).eval().to(device)
    with torch.no_grad():
        (out,) = model([torch.rand(3, 64, 64, device=device)])
    seen = Detections.from_torchvision(out, 3)
    assert seen.boxes.device.type == device.type
    assert int(seen.count) == len(out["boxes"]) > 0
    torch.testing.assert_close(seen.confidence[0], out["scores"].sort(descending=True).values)


ids = st.lists(st.integers(1, 90), min_size=3, max_size=3, unique=True)


@given(ids, st.integers(0, 6))
def test_coco_results_are_read_by_pycocotools(category, count):
    seen = some(count, padding=2, seed=count)
    records = [{"id": number, "name": name} for number, name in zip(category, ("person", "cup", "tv"), strict=True)]
    results = seen.to_coco(7, category)
    assert results == seen.to_coco(7, records[::-1], CLASSES)
    if not count:
        assert results == []
        return
    truth = COCO()
    truth.dataset = {
        "info": {},
        "images": [{"id": 7, "width": 100, "height": 100}],
        "categories": records,
        "annotations": [{**each, "id": n + 1, "area": each["bbox"][2] * each["bbox"][3], "iscrowd": 0}
                        for n, each in enumerate(results)],
    }  # fmt: skip
    with contextlib.redirect_stdout(io.StringIO()):
        truth.createIndex()
        read = truth.loadRes(results)
        judge = COCOeval(truth, read, "bbox")
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
    assert judge.stats[0] == pytest.approx(1)
    for row, each in enumerate(read.loadAnns(read.getAnnIds())):
        x, y, width, height = each["bbox"]
        torch.testing.assert_close(torch.tensor([x, y, x + width, y + height]), seen.boxes[0, row], rtol=0, atol=0.011)
        assert each["category_id"] == category[int(seen.labels[0, row]) - 1]
        assert each["score"] == pytest.approx(float(seen.confidence[0, row]), rel=1e-3)


def test_category_names_may_be_spelled_differently():
    assert category_ids([{"id": 72, "name": "tv"}, {"id": 1, "name": "person"}], ["person", "TVmonitor"]) == [1, 72]


def test_inconsistent_arguments_are_refused_by_name(monkeypatch):
    two = Detections.stack([some(), some()])
    for call in (two.to_supervision, two.to_torchvision, lambda: two.to_coco(1, [1, 2, 3])):
        refused(r"one image, such as detections\[0\], got a batch of shape \(2,\)", call)
    assert same(Detections.from_supervision(two[0].to_supervision(), 3), some())
    seen = some()
    for call, message in (
        (lambda: seen.to_supervision(["one"]), "classes: expected 3 names"),
        (lambda: seen.to_coco(1, [1, 2]), "categories: expected one id for each of 3 classes"),
        (lambda: seen.to_coco(1, [{"id": 1, "name": "person"}]), "classes: expected the names"),
        (lambda: seen.to_coco(1, [{"id": 1, "name": "person"}], CLASSES), "none for cup, tv"),
        (lambda: Detections.from_supervision(seen.to_supervision(), 4), "data\\['scores'\\]: expected shape"),
        (lambda: Detections.from_supervision(supervision.Detections(np.zeros((1, 4))), 3), "class_id"),
        (lambda: Detections.from_torchvision({"boxes": seen.boxes[0]}, 3), "'labels'"),
    ):
        refused(message, call)
    for labels, scores, message in (
        ([0], [0.5], "labels"), ([4], [0.5], "labels"), ([1], [1.5], "scores"), ([1], [torch.nan], "scores"),
        ([1], [0.5, 0.5], "scores"), ([1, 1], [0.5, 0.5], "boxes"),
    ):  # fmt: skip
        given = {"boxes": torch.zeros(1, 4), "labels": torch.tensor(labels), "scores": torch.tensor(scores)}
        refused(message, Detections.from_torchvision, given, 3)
    refused(".", Detections, torch.zeros(1, 2, 5), torch.zeros(1, 2, 3), torch.zeros(1, 2, dtype=torch.bool))
    refused(".", Detections, torch.zeros(1, 2, 4), torch.zeros(1, 3, 3), torch.zeros(1, 2, dtype=torch.bool))
    refused(".", Detections, torch.zeros(1, 2, 4), torch.zeros(1, 2, 3), torch.zeros(1, 2))
    refused("'residual'", score_vectors, candidates([0.5]), "residul")
    refused("expected a head with a score for the policy 'own'", score_vectors, candidates([0.5]), "own")
    monkeypatch.setitem(sys.modules, "supervision", None)
    refused("pip install supervision", some().to_supervision)


def test_highest_scores_are_those_of_the_detections_where_nothing_else_is_given(device):
    looks = detections([2, 5, 0, 3], classes=4).to(device)
    for look in range(4):
        for target in range(5):
            shown = [float(s[target]) for s, m in zip(looks.scores[look], looks.mask[look], strict=True) if m]
            assert float(looks.highest[look, target]) == max(shown, default=0.0)
    empty = Detections.empty(3, 4, like=torch.empty(0, dtype=torch.float64, device=device))
    assert torch.equal(empty.highest, torch.zeros(3, 5, dtype=torch.float64, device=device))


def test_highest_scores_stay_with_their_images():
    seen = torch.tensor([[0.9, 0.5, 0.6, 0.7], [0.1, 0.8, 0.3, 0.2]])
    looks = replace(detections([2, 4]), highest=seen)
    assert torch.equal(looks[1:].highest, seen[1:])
    assert torch.equal(looks[0].highest, seen[0])
    assert torch.equal(looks.take(torch.tensor([0])).highest, seen)
    assert torch.equal(Detections.stack([looks[1:], looks[:1]]).highest, seen.flip(0))
    assert looks.to("cpu").highest.equal(seen)
    # Rows of several images are no image.
    rows = looks[torch.tensor([0, 1]), torch.tensor([0, 3])]
    assert torch.equal(rows.highest, torch.maximum(looks.scores[0, 0], looks.scores[1, 3]))
    refused("highest", replace, looks, highest=seen[:1])


def test_without_a_mask_every_row_is_a_detection():
    of_rows = detections([3, 3])
    plain = Detections(of_rows.boxes, of_rows.scores)
    assert plain.count.tolist() == [3, 3]
    torch.testing.assert_close(plain.confidence, of_rows.confidence)
    torch.testing.assert_close(plain.highest, of_rows.highest)
    refused("the same leading dimensions", Detections, of_rows.boxes, of_rows.scores[:1])
