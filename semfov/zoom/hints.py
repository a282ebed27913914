"""Hints: a detector's candidates in a look, also those below the detection threshold; they show where to zoom in."""

from dataclasses import dataclass

from torch import Tensor

from semfov.detection.detector import FAINT
from semfov.detection.scores import BackgroundPolicy, Candidates, shares
from semfov.detection.selection import check_candidates, check_scores


@dataclass(frozen=True)
class Hints:
    """The hints of one look: boxes with class scores, in no order; several may be of one object.

    Attributes:
        boxes: `(N, 4)`, `(x1, y1, x2, y2)`.
        scores: `(N, K)`, score of each class, without background.
    """

    boxes: Tensor
    scores: Tensor


def hints_of(candidates: Candidates, image: int, policy: BackgroundPolicy, faint: float = FAINT) -> Hints:
    """Take the hints from all boxes of a detector's head.

    Args:
        candidates: the boxes, in canvas pixels.
        image: index of the image in the batch.
        policy: background policy of the scores.
        faint: confidence from which on a candidate is a hint.

    Returns:
        The hints, in canvas pixels, without gradients.

    Raises:
        InputError: the detector returned numbers that are not finite, or scores outside [0, 1].

    >>> import torch
    >>> found = Candidates(torch.rand(1, 3, 4), torch.tensor([[[0.001], [0.01], [0.9]]]))
    >>> hints_of(found, 0, "residual").scores
    tensor([[0.0100],
            [0.9000]])
    """
    confidence = candidates.confidence[image].detach()
    index = (confidence >= faint).nonzero()[:, 0]
    selected = candidates.take(image, index)
    boxes = selected.boxes.detach()
    check_candidates(image, confidence, boxes)
    check_scores(image, selected)
    return Hints(boxes, shares(selected, policy)[1].detach())
