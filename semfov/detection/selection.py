"""Selection of a detector's boxes: threshold, non-maximum suppression, and a limit on their number."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.placement import Placement
from semfov.detection.scores import HALVES, BackgroundPolicy, Candidates, score_vectors
from semfov.errors import check, check_finite, check_number, check_whole, values_known

_BLOCK = 128  # boxes that are compared with each other at once: their table stays in the cache of the processor


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
    """Select the best boxes of each image, map them to the image, and compute their score vectors."""
    # On a GPU each step would wait for the number of boxes that the step before has left.
    device, count = candidates.boxes.device, candidates.boxes.shape[0]
    if values_known(candidates.boxes):
        candidates = candidates.to(torch.device("cpu"))
    detections = [_select_one(candidates, image, placement, selection, policy) for image in range(count)]
    chosen = detections[0] if count == 1 else Detections.stack(detections)
    return chosen if chosen.boxes.device == device else chosen.to(device)


def check_numbers(image: int, low: float, high: float, **named: Tensor | None) -> None:
    """Raise `InputError` where a detector returns NaN, infinite numbers, or numbers outside a range."""
    for name, each in named.items():
        if each is not None and each.numel() and values_known(each):
            least, most = map(float, each.detach().aminmax())  # one pass; NaN and infinite numbers are among them
            if not (low <= least and most <= high and math.isfinite(most - least)):
                where = f"detector: {name.replace('_', ' ')} in image {image}"
                check_finite(each, where)
                check(False, where, f"numbers in [{low:g}, {high:g}]", "numbers outside")


def _select_one(
    candidates: Candidates, image: int, placement: Placement | None, selection: Selection, policy: BackgroundPolicy
) -> Detections:
    confidence = candidates.confidence[image]
    index = (confidence >= selection.threshold).nonzero()[:, 0]
    boxes = candidates.boxes[image].index_select(0, index)
    check_numbers(image, -math.inf, math.inf, confidence=confidence, boxes=boxes)
    boxes = boxes if placement is None else placement.boxes_to_image(boxes)
    labels = candidates.classes[image, index].argmax(-1) if selection.per_class else index
    chosen = suppress(boxes, confidence.index_select(0, index), labels, selection)
    rows = candidates.take(image, index[chosen])
    check_numbers(image, 0, 1, class_scores=rows.classes, objectness=rows.objectness)
    scores = score_vectors(rows, policy)
    # Suppression ranks by confidence; the shares of a vector can rank otherwise.
    order = scores[:, 1:].detach().amax(-1).argsort(descending=True, stable=True)
    boxes, scores = boxes.index_select(0, chosen[order]), scores.index_select(0, order)
    every = torch.ones_like(order, dtype=torch.bool)
    return Detections(boxes[None], scores[None], every[None], rows.confidence.index_select(0, order)[None])


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
    if boxes.device.type != "cpu" or not values_known(boxes):
        from torchvision.ops import batched_nms, nms  # with it comes a compiler, which takes seconds to import

        if selection.per_class:
            return batched_nms(boxes, confidence, labels, selection.iou)[: selection.limit]
        return nms(boxes, confidence, selection.iou)[: selection.limit]
    corners, kinds, survivors = boxes.numpy(), labels.numpy(), np.zeros(0, np.int64)
    for start in range(0, len(corners), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(corners)))
        rivals = np.concatenate([survivors, block])
        over = _overlaps(corners[rivals], corners[block], selection.iou)
        if selection.per_class:
            over &= kinds[rivals, None] == kinds[block]
        beaten: NDArray[np.bool_] = over[: len(survivors)].any(axis=0)  # type: ignore[assignment]
        for number, row in enumerate(over[len(survivors) :]):
            if not beaten[number]:
                beaten[number + 1 :] |= row[number + 1 :]
        survivors = np.concatenate([survivors, block[~beaten]])
        if len(survivors) >= selection.limit:
            break
    return torch.from_numpy(survivors[: selection.limit])


def _overlaps(boxes: NDArray[np.floating[Any]], others: NDArray[np.floating[Any]], iou: float) -> NDArray[np.bool_]:
    """Whether the intersection over union of each two boxes is above a limit; boxes `(M, 4)`, others `(N, 4)`."""
    (x1, y1, x2, y2), (left, top, right, bottom) = boxes.T[:, :, None], others.T[:, None]
    shared = (np.minimum(x2, right) - np.maximum(x1, left)).clip(0)
    shared *= (np.minimum(y2, bottom) - np.maximum(y1, top)).clip(0)
    together = (x2 - x1) * (y2 - y1) + (right - left) * (bottom - top) - shared
    return shared > iou * together
