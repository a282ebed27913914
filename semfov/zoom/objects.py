"""Objects of a picture, merged from the detections of many glances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from semfov.detection.near_duplicates import intersection, neighbours, survivors
from semfov.zoom.glances import Glance


@dataclass(frozen=True)
class Objects:
    """Objects, most certain first.

    Attributes:
        boxes: `(M, 4)` in picture pixels.
        scores: `(M,)`, of the class.
        labels: `(M,)`, classes 1..K.
        passes: `(M,)`, number of the look that each comes from, the overview is 0.
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    passes: Tensor

    def __len__(self) -> int:
        return len(self.boxes)

    def above(self, score: float) -> "Objects":
        """Those with such a score or more."""
        return self[self.scores >= score]

    def __getitem__(self, index: Tensor) -> "Objects":
        """Some of the objects."""
        return Objects(self.boxes[index], self.scores[index], self.labels[index], self.passes[index])


def merge(
    glances: Sequence[Glance], target: int | None = None, *, score: float = 0.05, iou: float = 0.5, inside: float = 0.8
) -> Objects:
    """One box for each object that several glances show.

    Of two boxes of one class that are the same object, a box that the border of its window cuts gives way to one that
    it does not; else the one from the closer look stays, and of one look the one with the higher score. Two boxes are
    the same object when they overlap by `iou`; from two looks also when one that is cut lies in the other by `inside`
    of its area.

    Args:
        glances: of one picture.
        target: class 1..K, by its own score; None for the best class of each box.
        score: boxes with a lower one are left out.
        iou: intersection over union.
        inside: share of the area of a box that is cut.

    Returns:
        Objects, most certain first.
    """
    boxes, scores, labels, cuts, passes, scale = [], [], [], [], [], []
    for turn, glance in enumerate(glances):
        seen = glance.detections
        label = seen.labels[0] if target is None else torch.full_like(seen.labels[0], target)
        value = seen.confidence[0] if target is None else seen.scores[0, :, target]
        enough = value >= score
        boxes.append(seen.boxes[0, enough])
        scores.append(value[enough])
        labels.append(label[enough])
        cuts.append(glance.cut[enough])
        passes.append(torch.full_like(label[enough], turn))
        scale.append(torch.full_like(value[enough], glance.window.fixation[2]))
    if not boxes:
        nothing = torch.zeros(0)
        return Objects(nothing.view(0, 4), nothing, nothing.long(), nothing.long())
    box, value, label, cut, number, closer = map(torch.cat, (boxes, scores, labels, cuts, passes, scale))
    # Stable sorts, the last key first.
    order = value.argsort(descending=True, stable=True)
    order = order[closer[order].argsort(descending=True, stable=True)]
    order = order[cut[order].int().argsort(stable=True)]
    box, value, label, cut, number = box[order], value[order], label[order], cut[order], number[order]
    kept = _unlike(box, label, cut, number, iou, inside)
    kept = kept[value[kept].argsort(descending=True, stable=True)]
    return Objects(box[kept], value[kept], label[kept], number[kept])


def _unlike(box: Tensor, label: Tensor, cut: Tensor, number: Tensor, iou: float, inside: float) -> Tensor:
    """Which boxes stay when each, in order, drops those after it that are the same object."""
    corners, labels, looks = box.numpy(), label.numpy().astype(np.float64), number.numpy()
    # Classes are moved apart, so that neighbours along x are of one class.
    shift = labels * (2 * np.abs(corners).max(initial=0) + 1)
    start, end = corners[:, 0] + shift, corners[:, 2] + shift
    order = start.argsort(kind="stable")
    one, other = neighbours(start[order], end[order])
    one, other = order[one], order[other]
    first, second = np.minimum(one, other), np.maximum(one, other)
    x1, y1, x2, y2 = np.ascontiguousarray(corners.T)
    shared, area = intersection(x1, y1, x2, y2, first, second), (x2 - x1) * (y2 - y1)
    union = area[first] + area[second] - shared
    same = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0) >= np.float32(iou)
    part = shared / np.maximum(area, 1e-6)[second]
    same |= (part >= np.float32(inside)) & cut.numpy()[second] & (looks[first] != looks[second])
    return torch.from_numpy(survivors(len(box), first[same], second[same]))
