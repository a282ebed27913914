"""Match detections to annotated objects, greedily."""

import torch
from torch import Tensor

from semfov.data.inputs import as_positions
from semfov.data.scene import Annotation
from semfov.detection.objects import Objects
from semfov.errors import check_shape

SAME_OBJECT_IOU = 0.5
"""Overlap (IoU) from which on boxes are of the same object, and share of a box in a crowd from which on it is of it."""


def box_iou(boxes: Tensor, others: Tensor) -> Tensor:
    """Compute the intersection over union of every pair of boxes.

    Args:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)`.
        others: `(N, 4)`, in the same frame.

    Returns:
        `(M, N)`; 0 for boxes without area.
    """
    check_shape(boxes, "boxes", None, 4)
    check_shape(others, "others", None, 4)
    first = as_positions(boxes)
    second = as_positions(others)
    upper_left = torch.maximum(first[:, None, :2], second[None, :, :2])  # (M, N, 2), of the shared part
    lower_right = torch.minimum(first[:, None, 2:], second[None, :, 2:])
    shared = (lower_right - upper_left).clamp(min=0).prod(-1)
    union = _area(first)[:, None] + _area(second)[None] - shared
    return torch.where(union > 0, shared / union, 0.0)


def _area(boxes: Tensor) -> Tensor:
    """Compute the areas of boxes `(N, 4)`, `(N,)`."""
    return (boxes[:, 2:] - boxes[:, :2]).clamp(min=0).prod(-1)


def match(boxes: Tensor, truth: Tensor, labels: Tensor, *, iou: float = 0.5) -> Tensor:
    """Find the true class of each detection, 0 (background) for a detection that matches no object.

    Each detection in turn, the most confident first, is matched to the object that it overlaps most among the objects
    not matched yet, if their intersection over union is at least `iou`. No object is matched twice. The detected class
    plays no part.

    This is our choice. Luzio, Bernardino and Moreno (2024, section IV-A) fit scores "according to the corresponding
    ground truth object"; they do not say how that object is found, nor which detections are background.

    Args:
        boxes: `(L, 4)`, detected boxes `(x1, y1, x2, y2)`, most confident first.
        truth: `(M, 4)`, annotated boxes in the same frame.
        labels: `(M,)`, classes of the annotated boxes, 1..K.
        iou: least intersection over union of a match.

    Returns:
        `(L,)`, class indices.

    Raises:
        InputError: a shape is wrong.

    >>> match(torch.tensor([[0.0, 0, 9, 9], [0, 0, 8, 8]]), torch.tensor([[0.0, 0, 9, 9]]), torch.tensor([7]))
    tensor([7, 0])
    """
    overlap = box_iou(boxes, truth)
    matched = labels.new_zeros(len(boxes))
    if overlap.numel() == 0:
        return matched
    for detection in range(len(boxes)):
        best, index = overlap[detection].max(0)
        if best >= iou:
            matched[detection] = labels[index]
            overlap[:, index] = -1.0  # no other detection matches this object
    return matched


def right_boxes(objects: Objects, annotation: Annotation) -> Tensor:
    """Compare objects with the annotated ones, class by class.

    Args:
        objects: N objects, in descending confidence.
        annotation: the annotated objects; one matches one object, a crowd any number.

    Returns:
        `(N,)`, 1 for right objects, 0 for wrong ones, and -1 for those in a crowd of their class.
    """
    verdicts = torch.zeros(len(objects), dtype=torch.long)
    for label in objects.labels.unique().tolist():
        numbers = (objects.labels == label).nonzero()[:, 0]
        boxes = objects.boxes[numbers]
        is_label = annotation.labels == label
        single = annotation.boxes[is_label & ~annotation.crowd]
        crowds = annotation.boxes[is_label & annotation.crowd]
        of_one_class = torch.ones(len(single)).long()
        hits = (match(boxes, single.to(boxes), of_one_class, iou=SAME_OBJECT_IOU) > 0).long()
        if len(crowds):
            in_crowd = (share_inside(boxes, crowds) >= SAME_OBJECT_IOU).any(-1)
            hits[in_crowd & (hits == 0)] = -1
        verdicts[numbers] = hits
    return verdicts


def share_inside(boxes: Tensor, others: Tensor) -> Tensor:
    """Compute the share of the area of each box that lies in each other box.

    Args:
        boxes: `(N, 4)`.
        others: `(M, 4)`, in the same frame.

    Returns:
        `(N, M)`, from 0 to 1.
    """
    low = torch.maximum(boxes[:, None, :2], others[:, :2])  # (N, M, 2)
    high = torch.minimum(boxes[:, None, 2:], others[:, 2:])
    shared = (high - low).clamp(min=0).prod(-1)
    sides = boxes[:, 2:] - boxes[:, :2]
    area = sides.prod(-1, keepdim=True).clamp(min=1e-6)
    return shared / area


def inside_frame(boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Find boxes whose centre lies inside a frame.

    Args:
        boxes: `(..., 4)`.
        size: `(width, height)` of the frame.

    Returns:
        `(...)` boolean.
    """
    centre = (boxes[..., :2] + boxes[..., 2:]) / 2
    return ((centre >= 0) & (centre < boxes.new_tensor(size))).all(-1)
