"""Selection of a detector's boxes: threshold, non-maximum suppression, and a limit on their number."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.near_duplicates import LEAST, distinct
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
    return select_several(candidates, placement, [selection], policy)[0]


def select_several(
    candidates: Candidates, placement: Placement | None, selections: Sequence[Selection], policy: BackgroundPolicy
) -> list[Detections]:
    """`select` with several settings at once, which share the ranking and the score vectors.

    Args:
        candidates: of a detector's head.
        placement: place of each image on its canvas; None leaves boxes in canvas pixels.
        selections: the settings.
        policy: background policy of the score vectors.

    Returns:
        The detections of each selection.
    """
    count = candidates.boxes.shape[0]
    found = [_select_one(candidates, image, placement, selections, policy) for image in range(count)]
    return found[0] if count == 1 else [Detections.stack([image[n] for image in found]) for n in range(len(selections))]


def check_candidates(image: int, confidence: Tensor, boxes: Tensor) -> None:
    """Raise `InputError` where a detector returns NaN or infinite values."""
    if not values_known(confidence, boxes):
        return
    for name, numbers in (("confidence", confidence.detach()), ("boxes", boxes.detach())):
        # The range of the numbers takes one pass over them. It is finite only if all of them are.
        low, high = numbers.aminmax() if numbers.numel() else (0.0, 0.0)
        if not math.isfinite(high - low):
            check_finite(numbers, f"detector: {name} in image {image}")


def check_scores(image: int, kept: Candidates) -> None:
    """Raise `InputError` where a selected box has a score outside [0, 1]."""
    if not values_known(kept.classes):
        return
    for name, scores in (("class scores", kept.classes), ("objectness", kept.objectness)):
        if scores is not None and scores.numel():
            low, high = scores.detach().aminmax()
            inside = float(low) >= 0 and float(high) <= 1
            check(inside, f"detector: {name} in image {image}", "numbers in [0, 1]", "numbers outside")


def _select_one(
    candidates: Candidates,
    image: int,
    placement: Placement | None,
    selections: Sequence[Selection],
    policy: BackgroundPolicy,
) -> list[Detections]:
    confidence = candidates.confidence[image]
    index = (confidence >= min(selection.threshold for selection in selections)).nonzero()[:, 0]
    boxes = candidates.boxes[image].index_select(0, index)
    check_candidates(image, confidence, boxes)
    boxes = boxes if placement is None else placement.boxes_to_image(boxes)
    some = any(selection.per_class for selection in selections)
    labels = candidates.classes[image, index].argmax(-1) if some else index
    kept = _suppress(boxes.detach(), confidence.detach().index_select(0, index), labels, selections)
    rows = candidates.take(image, index[kept[0] if len(kept) == 1 else torch.cat(kept)])
    check_scores(image, rows)
    scores = score_vectors(rows, policy)
    best = scores[:, 1:].detach().amax(-1)
    found, lengths = [], [*map(len, kept)]
    for keep, vectors, value in zip(kept, scores.split(lengths), best.split(lengths), strict=True):
        # Suppression ranks by objectness times class; the shares of a vector can rank otherwise.
        order = value.argsort(descending=True, stable=True)
        box, vectors = boxes.index_select(0, keep[order]), vectors.index_select(0, order)
        found.append(Detections(box[None], vectors[None], torch.ones_like(order, dtype=torch.bool)[None]))
    return found


def suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Indices of the boxes that survive non-maximum suppression, most confident first."""
    return _suppress(boxes.detach(), confidence.detach(), labels, [replace(selection, threshold=0.0)])[0]


def _suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selections: Sequence[Selection]) -> list[Tensor]:
    """Indices of the boxes that are kept by each selection, most confident first."""
    if boxes.dtype in (torch.float16, torch.bfloat16):  # too coarse for pixels, and not there on a CPU
        boxes, confidence = boxes.float(), confidence.float()
    full = (boxes[:, 2:] > boxes[:, :2]).all(-1).nonzero()[:, 0]
    ranked, order = confidence[full].sort(descending=True, stable=True)
    order = full[order]
    boxes, labels = boxes.index_select(0, order), labels[order]
    kept = []
    for selection in selections:
        count = int((ranked >= selection.threshold).sum())
        kept.append(order[_survivors(boxes[:count], ranked[:count], labels[:count], selection)])
    return kept


def _survivors(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Which boxes survive, of boxes that stand with the most confident first."""
    strict = selection.iou >= LEAST and not selection.per_class
    strict = strict and boxes.dtype == torch.float32 and boxes.device.type == "cpu"

    def first(count: int) -> Tensor:
        if strict:
            return torch.from_numpy(distinct(boxes[:count].numpy(), selection.iou))
        from torchvision.ops import batched_nms, nms

        if selection.per_class:
            return batched_nms(boxes[:count], confidence[:count], labels[:count], selection.iou)
        return nms(boxes[:count], confidence[:count], selection.iou)

    # A box is suppressed by more confident ones alone, so the first survivors are those of the first boxes. Time grows
    # with the square of their number.
    count = (2 if strict else 8) * selection.limit
    keep = first(count)
    while len(keep) < selection.limit and count < len(boxes):
        count *= 2
        keep = first(count)
    return keep[: selection.limit]
