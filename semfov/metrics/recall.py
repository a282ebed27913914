"""How many of the objects in view a detector finds, at a price in false boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from semfov.errors import check, check_shape
from semfov.observation.matching import match


def found_objects(
    boxes: Tensor, scores: Tensor, truth: Tensor, labels: Tensor, *, iou: float = 0.5
) -> tuple[Tensor, Tensor]:
    """With what score each object of a view is found and named right, and the scores of the boxes that find none.

    A box has the class of its largest score, background aside, and that score. The boxes of a class choose in
    descending order of score among the objects of this class (`semfov.observation.match`), each object once.

    Args:
        boxes: `(L, 4)`, detections.
        scores: `(L, K+1)`, their score vectors or posteriors, background first.
        truth: `(M, 4)`, boxes of the objects.
        labels: `(M,)`, their classes, 1..K.
        iou: least overlap.

    Returns:
        `(M,)`, scores, 0 for objects that are not found, and `(F,)`, of the other boxes.

    >>> boxes, scores = torch.tensor([[0.0, 0, 9, 9], [0, 0, 8, 8]]), torch.tensor([[0.1, 0.7, 0.2], [0.2, 0.6, 0.2]])
    >>> found_objects(boxes, scores, torch.tensor([[0.0, 0, 9, 9]]), torch.tensor([1]))
    (tensor([0.7000]), tensor([0.6000]))
    """
    check_shape(scores, "scores", len(boxes), None)
    check_shape(truth, "truth", len(labels), 4)
    confidence, named = scores[:, 1:].max(-1)
    order = confidence.argsort(descending=True, stable=True)
    found, false = scores.new_zeros(len(labels)), torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    for label in (named + 1).unique().tolist():
        mine, objects = order[named[order] + 1 == label], (labels == label).nonzero()[:, 0]
        # An object's own number takes the place of its class.
        number = match(boxes[mine], truth[objects], torch.arange(1, len(objects) + 1, device=boxes.device), iou=iou)
        found[objects[number[number > 0] - 1]] = confidence[mine[number > 0]]
        false[mine[number > 0]] = False
    return found, confidence[false]


def score_for(false: Tensor, views: int, rate: float = 1.0) -> float:
    """The least score above which `views` views have at most `rate` false boxes each, on average.

    What is found above it is a point of the free-response curve (Bunch, Hamilton, Sanderson and Simmons 1978), on which
    detectors whose scores mean different things can be compared.

    Args:
        false: `(F,)`, scores of the false boxes of all views.
        views: how many there are.
        rate: false boxes in a view.

    >>> score_for(torch.tensor([0.9, 0.5, 0.4, 0.1]), views=2)
    0.4...
    """
    check(views >= 1, "views", "at least 1", views)
    check(rate >= 0, "rate", "0 or more", rate)
    allowed = int(rate * views)
    return float(false.sort(descending=True).values[allowed]) if allowed < len(false) else 0.0
