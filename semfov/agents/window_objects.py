"""Objects merged from the detections in all windows, computed when the record's objects are first read."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from semfov.detection import Objects
from semfov.detection.objects import FAINTEST
from semfov.observation.matching import inside_frame
from semfov.tracking import Seen
from semfov.zoom.certainty import Certainty
from semfov.zoom.episode import KeptLook
from semfov.zoom.eye import BORDER
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import detected_boxes, merge, probable_objects, without_parts


@dataclass(frozen=True)
class MergedLooks:
    """Objects merged from looks when they are first read; in a stream most are never read.

    It holds nothing that a later look or frame changes, and merges in the modes of PyTorch in which it was made.

    Attributes:
        looks: the looks, where they lie in their frame.
        lattice: lattice of the picture or the frame.
        sought: the classes that are looked for; none stands for all.
        certainty: probability that an object is there; None without evidence.
        remaining: objects that further looks are expected to find (`ZoomBelief.remaining`).
        promised: objects that the looks so far promised.
        fades: whether later looks replace what earlier ones showed, as in a stream that forgets.
        in_frame: whether objects beyond the frame are left out, as where looks were carried along with a camera.
    """

    looks: tuple[WindowLook, ...]
    lattice: Lattice
    sought: tuple[int, ...]
    certainty: Certainty | None
    remaining: tuple[float, float]
    promised: float
    fades: bool
    in_frame: bool
    _has_gradients: bool = field(default_factory=torch.is_grad_enabled, init=False)
    _is_inference: bool = field(default_factory=torch.is_inference_mode_enabled, init=False)

    def objects(self) -> Objects:
        """Merge the objects, the most confident first."""
        return self._merged[0]

    def unseen(self) -> tuple[float, float] | None:
        """Estimate mean and variance of the number of objects not yet seen; None if it cannot be estimated."""
        return self._merged[1]

    @cached_property
    def _merged(self) -> tuple[Objects, tuple[float, float] | None]:
        """The objects, and how many more there are."""
        with torch.inference_mode(self._is_inference), torch.set_grad_enabled(self._has_gradients):
            looks = without_replaced(self.looks, self.lattice) if self.fades else self.looks
            objects, unseen = self._merge(looks)
            if self.in_frame:
                objects = objects[inside_frame(objects.boxes, self.lattice.size)]
            return objects, unseen

    def _merge(self, looks: Sequence[WindowLook]) -> tuple[Objects, tuple[float, float] | None]:
        """Merge by the scores, or by the certainty where one was fitted."""
        if self.certainty is None:
            return without_parts(merge(looks, self.sought), looks, self.sought), None
        return probable_objects(
            looks,
            self.lattice,
            self.sought,
            self.certainty,
            remaining=self.remaining,
            promised=self.promised,
            latest=self.fades,
        )


def seen_by(look: KeptLook, lattice: Lattice, sought: Sequence[int]) -> Seen:
    """Select the detections of some classes in a look, for a tracker.

    Args:
        look: the look, as it was taken at the present frame.
        lattice: lattice of the frame.
        sought: classes 1..K; none stands for all.

    Returns:
        The boxes, each with its best class.
    """
    detected = detected_boxes([look.original], sought, shares=False)
    # No track can begin at a box that is not finite.
    detected = detected.of((detected.scores >= FAINTEST) & detected.boxes.isfinite().all(-1))
    window = look.original.window
    magnification = window.fixation[2]
    boxes = detected.boxes.double()
    margin = BORDER / magnification
    at_left_or_top = boxes[:, :2] <= margin
    at_right_or_bottom = boxes[:, 2:] >= boxes.new_tensor(lattice.size) - margin
    return Seen(
        boxes=boxes.numpy(),
        scores=detected.scores.double().numpy(),
        labels=detected.labels.numpy(),
        cut=detected.cut.numpy(),
        region=window.region(lattice),
        magnification=magnification,
        number=look.number,
        entering=(at_left_or_top | at_right_or_bottom).any(-1).numpy(),
    )


def without_replaced(looks: Sequence[WindowLook], lattice: Lattice) -> list[WindowLook]:
    """Drop detections whose surroundings a later look showed at the same or a higher magnification.

    Args:
        looks: the looks at a stream, in their order.
        lattice: lattice of the frames.

    Returns:
        The looks with the detections that remain.
    """
    if not looks:
        return []
    # All boxes are in one table, so that each look is compared with those of all before it at once.
    counts = [look.detections.boxes.shape[1] for look in looks]
    ends = np.cumsum(counts)
    boxes = torch.cat([look.detections.boxes[0] for look in looks])
    # Only well inside: on a still picture people near the border of a later window were dropped.
    low, high = _surroundings(boxes, lattice.size)
    is_kept = torch.cat([look.detections.mask[0] for look in looks]).numpy()
    magnifications = np.array([look.window.fixation[2] for look in looks])
    magnification_of_box = np.repeat(magnifications, counts)
    for number in range(1, len(looks)):
        earlier = slice(ends[number - 1])
        region = np.array(looks[number].window.region(lattice), dtype=low.dtype)
        is_shown = _lie_inside(low[:, earlier], high[:, earlier], region)
        is_as_close = magnifications[number] >= magnification_of_box[earlier]
        is_kept[earlier] &= ~(is_shown & is_as_close)
    masks = torch.from_numpy(is_kept).split(counts)
    return [_taken(look, mask) for look, mask in zip(looks, masks, strict=True)]


def _lie_inside(low: np.ndarray, high: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Tell which boxes, with low and high corners `(2, M)`, lie inside a region `(x1, y1, x2, y2)`, `(M,)`."""
    x1, y1, x2, y2 = region
    return (low[0] >= x1) & (low[1] >= y1) & (high[0] <= x2) & (high[1] <= y2)


def _surroundings(boxes: Tensor, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Enlarge boxes `(M, 4)` by half a side on each side, within a frame of a size; low and high corners `(2, M)`."""
    low, high = boxes.split(2, -1)
    margin = (high - low) / 2
    low = (low - margin).clamp(min=0)
    high = (high + margin).minimum(low.new_tensor(size))
    return low.T.contiguous().numpy(), high.T.contiguous().numpy()


def _taken(look: WindowLook, remain: Tensor) -> WindowLook:
    """Take the detections of a look that remain, `(L,)` boolean."""
    if bool(remain.all()):
        return look
    return replace(look, detections=look.detections.take(remain), cut=look.cut[remain])
