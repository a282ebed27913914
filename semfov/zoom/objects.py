"""Objects of a picture, merged from the detections of many glances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.zoom.glances import Glance
from semfov.zoom.overlaps import intersection, neighbours, survivors


@dataclass(frozen=True)
class Objects:
    """Objects of a picture, most confident first.

    Attributes:
        boxes: `(M, 4)`, `(x1, y1, x2, y2)` in picture pixels.
        scores: `(M,)`, score of the class.
        labels: `(M,)`, classes 1..K.
        passes: `(M,)`, number of the look that each box comes from; the overview is 0.

    >>> objects = Objects(torch.zeros(2, 4), torch.tensor([0.9, 0.2]), torch.tensor([1, 3]), torch.tensor([0, 4]))
    >>> len(objects), len(objects.above(0.5))
    (2, 1)
    """

    boxes: Tensor
    scores: Tensor
    labels: Tensor
    passes: Tensor

    def __len__(self) -> int:
        return len(self.boxes)

    def above(self, score: float) -> "Objects":
        """Objects with at least a given score.

        Args:
            score: the lowest score.

        Returns:
            The objects.
        """
        return self[self.scores >= score]

    def __getitem__(self, index: Tensor) -> "Objects":
        """Some of the objects."""
        return Objects(self.boxes[index], self.scores[index], self.labels[index], self.passes[index])


def merge(
    glances: Sequence[Glance], target: int | None = None, *, score: float = 0.05, iou: float = 0.5, inside: float = 0.8
) -> Objects:
    """Merge the detections of several looks into one box for each object.

    Two boxes of one class are the same object when their intersection over union is at least `iou`. Boxes of two looks
    are also the same object when the border of its window cuts one of them, and at least `inside` of its area lies in
    the other. Of two boxes of the same object a whole box is kept rather than a cut one. If both or neither are cut,
    the box of the closer look is kept, and within a look the box with the higher score.

    Args:
        glances: looks at one picture.
        target: class 1..K, whose score counts for every box; None takes the best class of each box.
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.

    Returns:
        Objects, most confident first.

    >>> from semfov.detection import Detections
    >>> from semfov.zoom.glances import Glance, Window
    >>> def look(magnification, box):
    ...     found = Detections(torch.tensor([[box]]), torch.tensor([[[0.3, 0.7]]]), torch.tensor([[True]]))
    ...     window = Window((100.0, 100.0, magnification), 0, (0, 0, 8, 8))
    ...     return Glance(window, found, torch.tensor([False]), torch.zeros(1), None)
    >>> merge([look(0.2, [10.0, 10, 50, 50]), look(0.8, [11.0, 12, 51, 50])]).boxes
    tensor([[11., 12., 51., 50.]])
    """
    if not glances:
        nothing = torch.zeros(0)
        return Objects(nothing.view(0, 4), nothing, nothing.long(), nothing.long())
    looks = [glance.detections for glance in glances]
    seen = Detections(
        *(torch.cat(parts, 1) for parts in zip(*((d.boxes, d.scores, d.mask) for d in looks), strict=True))
    )
    value = seen.confidence[0] if target is None else seen.scores[0, :, target]
    label = seen.labels[0] if target is None else torch.full(value.shape, target)
    counts = torch.tensor([found.mask.shape[1] for found in looks])
    number = torch.arange(len(looks)).repeat_interleave(counts)
    closer = torch.tensor([glance.window.fixation[2] for glance in glances]).to(value)[number]
    cut = torch.cat([glance.cut for glance in glances])
    enough = (value >= score).nonzero()[:, 0]
    # Stable sorts, the last key first.
    order = enough[value[enough].argsort(descending=True, stable=True)]
    order = order[closer[order].argsort(descending=True, stable=True)]
    order = order[cut[order].int().argsort(stable=True)]
    box, value, label, cut, number = seen.boxes[0, order], value[order], label[order], cut[order], number[order]
    kept = _unlike(box, label, cut, number, iou, inside)
    kept = kept[value[kept].argsort(descending=True, stable=True)]
    return Objects(box[kept], value[kept], label[kept], number[kept])


def _unlike(box: Tensor, label: Tensor, cut: Tensor, number: Tensor, iou: float, inside: float) -> Tensor:
    """Indices of the boxes that stay when each one, in order, removes later ones that are the same object."""
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
