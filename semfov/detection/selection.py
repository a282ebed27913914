"""Selection of a detector's boxes: threshold, non-maximum suppression, and a limit on their number.

What a box counts for by its score, from the faintest on. Each threshold has its value in the room that is named:

    a box from this score on                              threshold
    ----------------------------------------------------  --------------------------------------------------------------
    is a hint of where to zoom in, and counts for         `FAINT`, `faint` of a `Detector`
    `Detections.highest`
    is a detection: beliefs of a fovea read all of them   `Selection.threshold`, option `threshold` of `load_detector`
    is a candidate for an object, or is tracked           `FAINTEST` in `semfov.detection.objects`
    marks a place for a closer look of a head             `_FAINTEST` in `semfov.head.closer`
    counts as a find of a look at a window                `DETECTION_SCORE` in `semfov.zoom.hints`
    is counted and drawn with its look                    `CONFIDENT` in `semfov.paths.look`
    is listed as an object                                `score_threshold` of a task; None: that of the detector, and
                                                          for probabilities of windows `LIKELY` in
                                                          `semfov.agents.window_episode`
    ends a search without fitted models                   `confirm` of a task; None: as in
                                                          `semfov.agents.fovea` and in `semfov.zoom.decision`

With fitted models probabilities decide a search (`semfov.decision`).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.detection.detections import Detections, greatest
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
    candidates: Candidates,
    placement: Placement | None,
    selection: Selection,
    policy: BackgroundPolicy,
    faint: float | None = None,
) -> Detections:
    """Select the best boxes of each image, map them to the image, and compute their score vectors.

    Args:
        candidates: all boxes of a head, in canvas pixels.
        placement: placement of the images on the canvas; None leaves boxes in canvas pixels.
        selection: threshold, non-maximum suppression and limit.
        policy: background policy of the score vectors.
        faint: confidence from which on candidates count for `Detections.highest`, in addition to those from the
            threshold on; None: the detections alone do.

    Returns:
        The boxes, those with the largest score of a class in their vectors first.

    Raises:
        InputError: a number of the detector is not finite, or out of range.
    """
    device = candidates.boxes.device
    count = candidates.boxes.shape[0]
    # On a GPU each step would wait for the number of boxes that the step before has left.
    if values_known(candidates.boxes):
        candidates = candidates.to(torch.device("cpu"))
    images = [_select_of_image(candidates, image, placement, selection, policy, faint) for image in range(count)]
    detections = images[0] if count == 1 else Detections.stack(images)
    return detections if detections.boxes.device == device else detections.to(device)


def check_numbers(image: int, low: float, high: float, **named: Tensor | None) -> None:
    """Check the numbers of a detector.

    Args:
        image: number of the image, for the message.
        low: the smallest number that may be.
        high: the largest one.
        **named: numbers by what they are, with `_` for a space; None is left out.

    Raises:
        InputError: some are NaN, infinite or outside the range.
    """
    for name, numbers in named.items():
        if numbers is None or _lie_within(numbers, low, high):
            continue
        where = f"detector: {name.replace('_', ' ')} in image {image}"
        check_finite(numbers, where)
        check(False, where, f"numbers in [{low:g}, {high:g}]", "numbers outside")


def _lie_within(numbers: Tensor, low: float, high: float) -> bool:
    """Tell whether all numbers are finite and in a range, or are not known yet, as in a graph that is traced."""
    if not numbers.numel() or not values_known(numbers):
        return True
    # One pass tells both, as the least and the greatest number are NaN where one number is.
    least, greatest = map(float, numbers.detach().aminmax())
    return low <= least and greatest <= high and math.isfinite(greatest - least)


def _select_of_image(
    candidates: Candidates,
    image: int,
    placement: Placement | None,
    selection: Selection,
    policy: BackgroundPolicy,
    faint: float | None,
) -> Detections:
    """Select the best boxes of one image; the arguments are those of `select`, and the image's number."""
    least = selection.threshold if faint is None else min(faint, selection.threshold)
    confidence_of_all = candidates.confidence[image]
    index = (confidence_of_all >= least).nonzero()[:, 0]
    rows = candidates.take(image, index)
    confident = (rows.confidence >= selection.threshold).nonzero()[:, 0]
    confidence = rows.confidence.index_select(0, confident)
    boxes = rows.boxes.index_select(0, confident)
    if not candidates.are_checked:
        check_numbers(image, -math.inf, math.inf, confidence=confidence_of_all, boxes=boxes)
        check_numbers(image, 0, 1, class_scores=rows.classes, objectness=rows.objectness)
    if placement is not None:
        boxes = placement.boxes_to_image(boxes)
    labels = confident  # any numbers do where they are not read
    if selection.per_class:
        labels = rows.classes.index_select(0, confident).argmax(-1)
    remaining = suppress(boxes, confidence, labels, selection)

    survivors = confident[remaining]
    if faint is None:  # as in windows, which find their hints themselves: only the vectors of survivors are read
        scores = score_vectors(candidates.take(image, index[survivors]), policy)
        highest = greatest(scores, 0)
    else:
        vectors = score_vectors(rows, policy)
        highest = greatest(vectors, 0)
        scores = vectors.index_select(0, survivors)
    # Suppression ranks by confidence; the shares of a vector can rank otherwise.
    best_score = scores[:, 1:].detach().amax(-1)
    order = best_score.argsort(descending=True, stable=True)
    boxes = boxes.index_select(0, remaining[order])
    scores = scores.index_select(0, order)
    confidence = confidence.index_select(0, remaining[order])
    mask = torch.ones_like(order, dtype=torch.bool)
    return Detections(boxes[None], scores[None], mask[None], confidence[None], highest[None])


def suppress(boxes: Tensor, confidence: Tensor, labels: Tensor, selection: Selection) -> Tensor:
    """Suppress boxes that overlap more confident ones; boxes without area are left out.

    Args:
        boxes: `(N, 4)`, `(x1, y1, x2, y2)`.
        confidence: `(N,)`.
        labels: `(N,)`, best classes; read where the selection is for each class.
        selection: overlap from which on boxes suppress each other, and largest number of boxes.

    Returns:
        Indices of the boxes that survive, most confident first.
    """
    boxes = _in_single_precision(boxes.detach())
    confidence = _in_single_precision(confidence.detach())
    if boxes.device.type == "cpu" and values_known(boxes, confidence, labels):
        return torch.from_numpy(remaining_rows(boxes.numpy(), confidence.numpy(), labels.numpy(), selection))
    from torchvision.ops import batched_nms, nms  # with it comes a compiler, which takes seconds to import

    # A box without area overlaps none, so nothing would suppress it.
    has_area = (boxes[:, 2:] > boxes[:, :2]).all(-1)
    with_area = has_area.nonzero()[:, 0]
    ranked, order = confidence[with_area].sort(descending=True, stable=True)
    order = with_area[order]
    boxes = boxes.index_select(0, order)
    labels = labels[order]
    if selection.per_class:
        remaining = batched_nms(boxes, ranked, labels, selection.iou)
    else:
        remaining = nms(boxes, ranked, selection.iou)
    return order[remaining[: selection.limit]]


def _in_single_precision(numbers: Tensor) -> Tensor:
    """Convert numbers of 16 bits, which are too coarse for pixels, and which NumPy lacks."""
    return numbers.float() if numbers.dtype in HALVES else numbers


def remaining_rows(
    boxes: NDArray[np.floating], confidence: NDArray[np.floating], labels: NDArray[np.integer], selection: Selection
) -> NDArray[np.int64]:
    """Find the boxes that survive suppression, as `suppress` does with tensors.

    Args:
        boxes: `(N, 4)`, `(x1, y1, x2, y2)`.
        confidence: `(N,)`.
        labels: `(N,)`, best classes; read where the selection is for each class.
        selection: overlap from which on boxes suppress each other, and largest number of boxes.

    Returns:
        Their indices, most confident first.
    """
    # A box without area overlaps none, so nothing would suppress it.
    x1, y1, x2, y2 = boxes.T
    with_area = ((x2 > x1) & (y2 > y1)).nonzero()[0]
    # Stable, so that of equal confidences the first stays, as it does with tensors.
    order = with_area[(-confidence[with_area]).argsort(kind="stable")]
    return order[_remaining_ranks(boxes[order], labels[order], selection)]


def _remaining_ranks(
    corners: NDArray[np.floating], classes: NDArray[np.integer], selection: Selection
) -> NDArray[np.int64]:
    """Find the boxes `(N, 4)`, most confident first, that survive suppression, block by block of them.

    A block is compared with the survivors of the blocks before it, and with itself.
    """
    ranks = np.zeros(0, np.int64)
    for start in range(0, len(corners), _BLOCK):
        block = np.arange(start, min(start + _BLOCK, len(corners)))
        rivals = np.concatenate([ranks, block])
        overlaps = _overlaps(corners[rivals], corners[block], selection.iou)  # (rivals, block)
        if selection.per_class:
            overlaps &= classes[rivals, None] == classes[block]
        by_earlier = overlaps[: len(ranks)]
        suppressed: NDArray[np.bool_] = by_earlier.any(axis=0)  # type: ignore[assignment]
        # Of the block each box overlaps itself; few overlap others after it.
        by_block = np.triu(overlaps[len(ranks) :], 1)
        for number in np.flatnonzero(by_block.any(axis=1)).tolist():
            if not suppressed[number]:
                suppressed |= by_block[number]
        ranks = np.concatenate([ranks, block[~suppressed]])
        if len(ranks) >= selection.limit:
            break
    return ranks[: selection.limit]


def _overlaps(boxes: NDArray[np.floating], others: NDArray[np.floating], iou: float) -> NDArray[np.bool_]:
    """Tell of which pairs of boxes the intersection over union is above a limit.

    Args:
        boxes: `(M, 4)`.
        others: `(N, 4)`.
        iou: the limit.

    Returns:
        `(M, N)`.
    """
    x1, y1, x2, y2 = boxes.T[:, :, None]
    left, top, right, bottom = others.T[:, None]
    width = np.minimum(x2, right) - np.maximum(x1, left)
    height = np.minimum(y2, bottom) - np.maximum(y1, top)
    intersection = width.clip(0) * height.clip(0)
    area = (x2 - x1) * (y2 - y1)
    other_area = (right - left) * (bottom - top)
    union = area + other_area - intersection
    return intersection > iou * union  # without a division, which an empty union would not allow
