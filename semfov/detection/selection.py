"""Selection of a detector's boxes: threshold, non-maximum suppression, and a limit on their number."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.placement import Placement
from semfov.detection.scores import HALVES, BackgroundPolicy, Candidates, score_vectors
from semfov.errors import check, check_finite, check_number, check_whole, values_known


@dataclass(frozen=True)
class Selection:
    """Settings of the selection of boxes.

    Attributes:
        threshold: smallest confidence of a box (objectness times best class score), from 0 to 1.
        iou: intersection over union above which the less confident of two boxes is suppressed, from 0 to 1.
        limit: largest number of boxes of an image.
        per_class: whether a box suppresses only boxes of its own best class; False suppresses across classes.

    >>> Selection(threshold=0.05, limit=20)
    Selection(threshold=0.05, iou=0.5, limit=20, per_class=False)
    """

    threshold: float = 0.02
    iou: float = 0.5
    limit: int = 100
    per_class: bool = False

    def __post_init__(self) -> None:
        check_number(self.threshold, "threshold", 0, 1)
        check_number(self.iou, "iou", 0, 1)
        check_whole(self.limit, "limit", 0, 10**9)


def select(
    candidates: Candidates, placement: Placement | None, selection: Selection, policy: BackgroundPolicy
) -> Detections:
    """Select the best boxes of each image, map them to the image, and compute their score vectors.

    Gradients flow to the selected boxes and their scores; the selection itself is not differentiable.
    """
    count = candidates.boxes.shape[0]
    detections = [_select_one(candidates, image, placement, selection, policy) for image in range(count)]
    return detections[0] if count == 1 else Detections.stack(detections)


def check_candidates(image: int, confidence: Tensor, boxes: Tensor) -> None:
    """Raise `InputError` where a detector returns NaN or infinite values."""
    if not values_known(confidence, boxes):
        return
    for name, numbers in (("confidence", confidence.detach()), ("boxes", boxes.detach())):
        # The range of the numbers takes one pass over them. It is finite only if all of them are.
        low, high = numbers.aminmax() if numbers.numel() else (0.0, 0.0)
        if not math.isfinite(high - low):
            check_finite(numbers, f"detector: {name} in image {image}")


def check_scores(image: int, candidates: Candidates) -> None:
    """Raise `InputError` where a selected box has a score outside [0, 1]."""
    if not values_known(candidates.classes):
        return
    for name, scores in (("class scores", candidates.classes), ("objectness", candidates.objectness)):
        if scores is not None and scores.numel():
            low, high = scores.detach().aminmax()
            inside = float(low) >= 0 and float(high) <= 1
            check(inside, f"detector: {name} in image {image}", "numbers in [0, 1]", "numbers outside")


def _select_one(
    candidates: Candidates,
    image: int,
    placement: Placement | None,
    selection: Selection,
    policy: BackgroundPolicy,
) -> Detections:
    confidence = candidates.confidence[image]
    index = (confidence >= selection.threshold).nonzero()[:, 0]
    boxes = candidates.boxes[image].index_select(0, index)
    check_candidates(image, confidence, boxes)
    boxes = boxes if placement is None else placement.boxes_to_image(boxes)
    labels = candidates.classes[image, index].argmax(-1) if selection.per_class else index
    chosen = suppress(boxes, confidence.index_select(0, index), labels, selection)
    rows = candidates.take(image, index[chosen])
    check_scores(image, rows)
    scores = score_vectors(rows, policy)
    # Suppression ranks by objectness times class; the shares of a vector can rank otherwise.
    order = scores[:, 1:].detach().amax(-1).argsort(descending=True, stable=True)
    boxes, scores = boxes.index_select(0, chosen[order]), scores.index_select(0, order)
    return Detections(boxes[None], scores[None], torch.ones_like(order, dtype=torch.bool)[None])


def suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Indices of the boxes that survive non-maximum suppression, most confident first."""
    boxes, confidence = boxes.detach(), confidence.detach()
    if boxes.dtype in HALVES:  # too coarse for pixels, and not there on a CPU
        boxes, confidence = boxes.float(), confidence.float()
    full = (boxes[:, 2:] > boxes[:, :2]).all(-1).nonzero()[:, 0]
    ranked, order = confidence[full].sort(descending=True, stable=True)
    order = full[order]
    return order[_survivors(boxes.index_select(0, order), ranked, labels[order], selection)]


def _survivors(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Indices of the boxes that survive suppression, among boxes in descending order of confidence."""
    from torchvision.ops import batched_nms, nms

    def first(count: int) -> Tensor:
        if selection.per_class:
            return batched_nms(boxes[:count], confidence[:count], labels[:count], selection.iou)
        return nms(boxes[:count], confidence[:count], selection.iou)

    # A box is suppressed by more confident ones alone, so the first survivors are those of the first boxes. Time grows
    # with the square of their number.
    count = 8 * selection.limit
    keep = first(count)
    while len(keep) < selection.limit and count < len(boxes):
        count *= 2
        keep = first(count)
    return keep[: selection.limit]
