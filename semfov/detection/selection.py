"""Which candidate boxes are kept: threshold, non-maximum suppression, at most so many."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.near_duplicates import LEAST, distinct
from semfov.detection.placement import Placement
from semfov.detection.scores import BackgroundPolicy, Candidates, score_vectors
from semfov.errors import check, check_finite, check_number, check_whole, values_known


@dataclass(frozen=True)
class Selection:
    """Settings of the selection.

    Attributes:
        threshold: boxes with a lower confidence (objectness times best class score) are dropped.
        iou: of two boxes that overlap more than this, the less confident is suppressed.
        limit: at most so many boxes of an image are kept.
        per_class: suppress only boxes of the same best class; False is class-agnostic.
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
    """Keep the best boxes of each image, mapped to the image and with their full score vectors.

    Gradients flow to boxes and scores of what is kept; the choice itself is not differentiable.
    """
    count = candidates.boxes.shape[0]
    found = [_select_one(candidates, image, placement, selection, policy) for image in range(count)]
    return found[0] if count == 1 else Detections.stack(found)


def _check(image: int, confidence: Tensor, boxes: Tensor) -> None:
    """Raise `InputError` where a detector returns NaN or infinity."""
    if values_known(confidence, boxes):
        check_finite(confidence.detach(), f"detector: confidence in image {image}")
        check_finite(boxes.detach(), f"detector: boxes in image {image}")


def _check_scores(image: int, kept: Candidates) -> None:
    """Raise `InputError` where a box that is kept has a score outside [0, 1]."""
    if not values_known(kept.classes):
        return
    for name, scores in (("class scores", kept.classes), ("objectness", kept.objectness)):
        inside = scores is None or bool(((scores.detach() >= 0) & (scores.detach() <= 1)).all())
        check(inside, f"detector: {name} in image {image}", "numbers in [0, 1]", "some outside")


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
    # Suppression ranks by objectness times class; the shares of a vector can rank otherwise.
    order = scores[:, 1:].detach().amax(-1).argsort(descending=True, stable=True)
    return Detections(boxes[keep[order]][None], scores[order][None], torch.ones_like(keep, dtype=torch.bool)[None])


@torch.no_grad()
def suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Indices of the boxes that survive non-maximum suppression, most confident first."""
    from torchvision.ops import batched_nms, nms

    full = ((boxes[:, 2] > boxes[:, 0]) & (boxes[:, 3] > boxes[:, 1])).nonzero()[:, 0]
    boxes, confidence, labels = boxes[full], confidence[full], labels[full]
    if boxes.dtype in (torch.float16, torch.bfloat16):  # too coarse for pixels, and not there on a CPU
        boxes, confidence = boxes.float(), confidence.float()

    strict = selection.iou >= LEAST and not selection.per_class
    strict = strict and boxes.dtype == torch.float32 and boxes.device.type == "cpu"

    def survivors(rows: Tensor) -> Tensor:
        if strict:
            return rows[torch.from_numpy(distinct(boxes[rows].detach().numpy(), selection.iou))]
        if selection.per_class:
            return rows[batched_nms(boxes[rows], confidence[rows], labels[rows], selection.iou)]
        return rows[nms(boxes[rows], confidence[rows], selection.iou)]

    # A box is suppressed by more confident ones alone, so the first survivors are those of the first boxes. Time grows
    # with the square of their number.
    order, first = confidence.argsort(descending=True, stable=True), (2 if strict else 4) * selection.limit
    keep = survivors(order[:first])
    while len(keep) < selection.limit and first < len(order):
        first *= 2
        keep = survivors(order[:first])
    return full[keep[: selection.limit]]
