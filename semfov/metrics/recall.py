"""How many of the objects in view a detector finds at a given rate of false boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from semfov.errors import check, check_shape
from semfov.observation.matching import match


def found_objects(
    boxes: Tensor, scores: Tensor, truth: Tensor, labels: Tensor, *, iou: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Scores of the objects that a detector finds in one view, and scores of its false boxes.

    The class of a box is the one of its highest score, background excepted, and this score is its confidence. The boxes
    of each class are matched with the objects of that class in descending order of confidence
    (`semfov.observation.match`). Each object is matched once.

    Args:
        boxes: `(L, 4)`, detections as (x1, y1, x2, y2) in pixels.
        scores: `(L, K+1)`, their score vectors or posteriors, background first.
        truth: `(M, 4)`, boxes of the objects, in the same frame.
        labels: `(M,)`, classes of the objects, 1..K.
        iou: least intersection over union of a match.

    Returns:
        `(M,)`, the confidence at which each object is found, 0 where it is not, and `(F,)`, the confidence of the boxes
        that match no object.

    Raises:
        InputError: the shapes do not fit together.

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
        # Objects are numbered from 1 in place of a class, so that a match says which object it is.
        number = match(boxes[mine], truth[objects], torch.arange(1, len(objects) + 1, device=boxes.device), iou=iou)
        found[objects[number[number > 0] - 1]] = confidence[mine[number > 0]]
        false[mine[number > 0]] = False
    return found, confidence[false]


def score_for(false: Tensor, views: int, rate: float = 1.0) -> float:
    """The score threshold at which a detector gives a certain number of false boxes in each view, on average.

    The recall at this threshold is a point of the free-response curve (Bunch, Hamilton, Sanderson and Simmons 1978). It
    compares detectors whose scores have different meanings.

    Args:
        false: `(F,)`, scores of the false boxes of all views.
        views: number of views.
        rate: allowed false boxes in each view, on average.

    Returns:
        The threshold: at most `rate · views` false boxes score higher. 0 where there are no more false boxes than that.

    Raises:
        InputError: `views` is less than 1, or `rate` is negative.

    >>> score_for(torch.tensor([0.9, 0.5, 0.4, 0.1]), views=2)
    0.4...
    """
    check(views >= 1, "views", "at least 1", views)
    check(rate >= 0, "rate", "0 or more", rate)
    allowed = int(rate * views)
    return float(false.sort(descending=True).values[allowed]) if allowed < len(false) else 0.0
