"""Hints of a look: candidates that are too weak to be detections, but show where a closer look pays."""

import torch

from semfov.detection.detections import Detections
from semfov.detection.scores import BackgroundPolicy, Candidates, score_vectors

HINT = 0.002
"""Smallest confidence of a hint."""


def hints_of(candidates: Candidates, policy: BackgroundPolicy) -> Detections:
    """Take all candidates from a confidence of 0.002 on, without suppression and without a limit.

    Several hints of an object do no harm, because the gist keeps the strongest one of a cell. A limit would: the
    overview of a mosaic has about 1,400 hints, and the strongest 300 leave most of its cells without any.

    Args:
        candidates: all boxes of the detector's head.
        policy: background policy of the score vectors.

    Returns:
        The hints of each image in the order of the candidates, boxes in canvas pixels.

    >>> boxes = torch.tensor([[[0.0, 0, 8, 8], [0, 0, 9, 8], [0, 0, 8, 9]]])
    >>> candidates = Candidates(boxes, torch.tensor([[[0.001], [0.01], [0.5]]]))
    >>> hints_of(candidates, "residual").boxes[0, :, 3]
    tensor([8., 9.])
    """
    found = []
    for image, confidence in enumerate(candidates.confidence):
        boxes = candidates.boxes[image]
        full = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        index = ((confidence >= HINT) & full).nonzero()[:, 0]
        scores = score_vectors(candidates.take(image, index), policy)
        found.append(Detections(boxes[index][None], scores[None], torch.ones_like(index, dtype=torch.bool)[None]))
    return Detections.stack(found)
