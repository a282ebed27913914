"""Objects of a picture, merged from the detections of many glances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from semfov.observation.matching import box_iou
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
    if not len(box):
        return torch.zeros(0, dtype=torch.long)
    low, high = torch.maximum(box[:, None, :2], box[None, :, :2]), torch.minimum(box[:, None, 2:], box[None, :, 2:])
    area = (box[:, 2:] - box[:, :2]).prod(-1).clamp(min=1e-6)
    part = (high - low).clamp(min=0).prod(-1) / area[None]
    same = (box_iou(box, box) >= iou) | ((part >= inside) & cut[None] & (number[:, None] != number[None]))
    same &= label[:, None] == label[None]
    later = same.triu(1).numpy()
    alive = np.ones(len(box), dtype=bool)
    for first in range(len(box)):
        if alive[first]:
            alive &= ~later[first]
    return torch.from_numpy(alive).nonzero()[:, 0]
