"""Selection of a detector's boxes: threshold, non-maximum suppression, and a limit on their number."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.placement import Placement
from semfov.detection.scores import BackgroundPolicy, Candidates, score_vectors
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

    Args:
        candidates: all boxes of the head.
        placement: placement of the images on the canvas; None leaves boxes in canvas pixels.
        selection: settings of the selection.
        policy: background policy of the scores.

    Returns:
        The selected boxes.
    """
    return Detections.stack(
        [_select_one(candidates, image, placement, selection, policy) for image in range(candidates.boxes.shape[0])]
    )


def _check(image: int, confidence: Tensor, boxes: Tensor) -> None:
    """Raise `InputError` where a detector returns NaN or infinite values."""
    if values_known(confidence, boxes):
        check_finite(confidence.detach(), f"detector: confidence in image {image}")
        check_finite(boxes.detach(), f"detector: boxes in image {image}")


def _check_scores(image: int, kept: Candidates) -> None:
    """Raise `InputError` where a selected box has a score outside [0, 1]."""
    if not values_known(kept.classes):
        return
    for name, scores in (("class scores", kept.classes), ("objectness", kept.objectness)):
        inside = scores is None or bool(((scores.detach() >= 0) & (scores.detach() <= 1)).all())
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
    boxes = candidates.boxes[image, index]
    _check(image, confidence, boxes)
    boxes = boxes if placement is None else placement.boxes_to_image(boxes)
    labels = candidates.classes[image, index].argmax(-1) if selection.per_class else index
    keep = suppress(boxes, confidence[index], labels, selection)
    rows = candidates.take(image, index[keep])
    _check_scores(image, rows)
    scores = score_vectors(rows, policy)
    # Suppression ranks boxes by objectness times class score; their score vectors may rank them differently.
    order = scores[:, 1:].detach().amax(-1).argsort(descending=True, stable=True)
    return Detections(boxes[keep[order]][None], scores[order][None], torch.ones_like(keep, dtype=torch.bool)[None])


@torch.no_grad()
def suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Indices of the boxes that survive non-maximum suppression, most confident first."""
    from torchvision.ops import batched_nms, nms

    full = ((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])).nonzero()[:, 0]
    boxes, confidence, labels = boxes[full], confidence[full], labels[full]
    if boxes.dtype in (torch.float16, torch.bfloat16):  # too coarse for pixels, and not supported on a CPU
        boxes, confidence = boxes.float(), confidence.float()

    def survivors(rows: Tensor) -> Tensor:
        if selection.per_class:
            return rows[batched_nms(boxes[rows], confidence[rows], labels[rows], selection.iou)]
        return rows[nms(boxes[rows], confidence[rows], selection.iou)]

    # Only a more confident box can suppress a box, so the survivors among the first boxes are the first survivors of
    # all. A part of the boxes is tried first, because time grows with the square of their number.
    order, first = confidence.argsort(descending=True, stable=True), 2 * selection.limit
    keep = survivors(order[:first])
    while len(keep) < selection.limit and first < len(order):
        first *= 2
        keep = survivors(order[:first])
    return full[keep[: selection.limit]]
