"""Objects of a large picture, merged from the detections of several windows."""

from collections.abc import Sequence

import torch

from semfov.detection.detections import Detections
from semfov.detection.objects import FAINTEST, Objects, merge_looks
from semfov.zoom.glances import Glance


def merge(
    glances: Sequence[Glance],
    target: int | Sequence[int] | None = None,
    *,
    score: float = FAINTEST,
    iou: float = 0.5,
    inside: float = 0.8,
) -> Objects:
    """Merge the detections of several looks at windows into one box for each object.

    The rule is that of `semfov.detection.objects.merge_looks`; the look with the higher magnification is the sharper
    one.

    Args:
        glances: looks at one picture.
        target: class 1..K, whose score counts for every box; of several classes, the best one for each box. None, or
            no class, takes the best class of each box.
        score: boxes with a lower score are left out.
        iou: intersection over union from which on two boxes are the same object.
        inside: share of the area of a cut box from which on it is the same object.

    Returns:
        Objects, most confident first.

    >>> from semfov.zoom.glances import Glance, Window
    >>> def look(magnification, box):
    ...     found = Detections(torch.tensor([[box]]), torch.tensor([[[0.3, 0.7]]]), torch.tensor([[True]]))
    ...     window = Window((100.0, 100.0, magnification), 0, (0, 0, 8, 8))
    ...     return Glance(window, found, torch.tensor([False]), torch.zeros(1), None)
    >>> merge([look(0.2, [10.0, 10, 50, 50]), look(0.8, [11.0, 12, 51, 50])]).boxes
    tensor([[11., 12., 51., 50.]])
    """
    if not glances:
        return Objects.none()
    looks = [glance.detections for glance in glances]
    seen = Detections(
        *(torch.cat(parts, 1) for parts in zip(*((d.boxes, d.scores, d.mask) for d in looks), strict=True))
    )
    value, label = seen.confidence[0], seen.labels[0]
    classes = [target] if isinstance(target, int) else list(target or ())
    if classes:
        value, best = seen.scores[0][:, classes].max(-1)
        label = torch.tensor(classes)[best]
    counts = torch.tensor([found.mask.shape[1] for found in looks])
    number = torch.arange(len(looks)).repeat_interleave(counts)
    closer = torch.tensor([glance.window.fixation[2] for glance in glances]).to(value)[number]
    cut = torch.cat([glance.cut for glance in glances])
    return merge_looks(seen.boxes[0], value, label, number, cut, closer, score=score, iou=iou, inside=inside)
