"""Matching against torchvision's IoU and a loop; how detections are matched is our choice, not the paper's."""

import pytest
import torch
from torchvision.ops import box_iou as torchvision_iou

from semfov.observation.matching import box_iou, match
from tests.refusals import refused


def some_boxes(count, seed):
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 30
    return torch.cat([corner, corner + 2 + torch.rand(count, 2, generator=generator) * 25], -1)


@pytest.mark.parametrize("scale", [1, 0.01], ids=["pixels", "smaller than a pixel"])
def test_iou_equals_torchvision(scale):
    a, b = scale * some_boxes(20, 0), scale * some_boxes(30, 1)
    torch.testing.assert_close(box_iou(a, b), torchvision_iou(a, b))


def test_match_equals_a_loop():
    for seed in range(30):
        boxes, truth = some_boxes(12, seed), some_boxes(6, seed + 100)
        labels = torch.arange(1, 7)
        expected, taken = [], set()
        for box in boxes:
            overlaps = torchvision_iou(box[None], truth)[0].tolist()
            free = [(value, -index) for index, value in enumerate(overlaps) if index not in taken and value >= 0.3]
            if free:
                index = -max(free)[1]
                taken.add(index)
                expected.append(int(labels[index]))
            else:
                expected.append(0)
        assert match(boxes, truth, labels, iou=0.3).tolist() == expected


def test_an_overlap_of_one_half_is_a_match_and_boxes_without_area_match_nothing():
    flat = torch.tensor([[3.0, 3, 3, 9]])
    assert box_iou(flat, flat).tolist() == [[0.0]]
    assert match(torch.zeros(0, 4), some_boxes(3, 0), torch.tensor([1, 2, 3])).tolist() == []
    assert match(some_boxes(2, 0), torch.zeros(0, 4), torch.zeros(0, dtype=torch.long)).tolist() == [0, 0]
    truth = torch.tensor([[0.0, 0, 3, 2], [10, 0, 14, 2]])
    boxes = torch.tensor([[0.0, 0, 2, 2], [10, 0, 12, 2], [10, 0, 11.9, 2]])
    assert match(boxes, truth, torch.tensor([4, 9])).tolist() == [4, 9, 0]
    assert match(boxes[2:], truth, torch.tensor([4, 9])).tolist() == [0]
    assert match(boxes[:1], truth, torch.tensor([4, 9]), iou=0.7).tolist() == [0]


@pytest.mark.parametrize("shape", [(4,), (3, 5), (3, 3)])
def test_boxes_of_the_wrong_shape_are_refused(shape):
    refused(r"^boxes: expected", box_iou, torch.zeros(shape), some_boxes(2, 0))
    refused(r"^others: expected", box_iou, some_boxes(2, 0), torch.zeros(shape))
