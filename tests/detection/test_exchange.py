"""Conversion of detections to and from the formats of Supervision, torchvision and COCO, tested with these packages."""

import contextlib
import io
import sys

import numpy as np
import pytest
import supervision
import torch
from hypothesis import given
from hypothesis import strategies as st
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from torchvision.ops import box_iou

from semfov import Detections, InputError
from semfov.detection.exchange import category_ids
from tests.refusals import refused

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
        torch.testing.assert_close(torch.tensor([x, y, x + width, y + height]), seen.boxes[0, row])
        assert each["category_id"] == category[int(seen.labels[0, row]) - 1]
        assert each["score"] == pytest.approx(float(seen.confidence[0, row]))


def test_category_names_may_be_spelled_differently():
    assert category_ids([{"id": 72, "name": "tv"}, {"id": 1, "name": "person"}], ["person", "TVmonitor"]) == [1, 72]


def test_inconsistent_arguments_are_refused_by_name():
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
    boxes = torch.zeros(1, 4)
    for labels, scores, message in (([0], [0.5], "labels"), ([4], [0.5], "labels"), ([1], [1.5], "scores"),
                                 ([1], [float("nan")], "scores"), ([1], [0.5, 0.5], "scores"),
                                 ([1, 1], [0.5, 0.5], "boxes")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            Detections.from_torchvision({"boxes": boxes, "labels": torch.tensor(labels),
                                         "scores": torch.tensor(scores)}, 3)  # fmt: skip


def test_to_supervision_without_the_package_names_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "supervision", None)
    refused("pip install supervision", some().to_supervision)
