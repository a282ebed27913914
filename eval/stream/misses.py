"""Why objects of a stream are not listed, and what is listed in their place."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

from torch import Tensor

from eval.stream.flights import within
from semfov.agents.window_episode import LIKELY
from semfov.observation.matching import box_iou, inside_frame
from semfov.tracking import Tracks

_SAME = 0.5  # intersection over union from which on a box fits an object
_BESIDE = 0.1  # the same from which on a box that fits none lies beside one

LISTED = "listed"
CAUSES = ("improbable", "place uncertain", "wrong place", "forgotten", "not detected", "not looked at")
"""Causes of a miss, of which the first that applies counts: a track fits the object, but probably is none, or has
probably moved on; the track that fitted it last is elsewhere, or gone; no track ever fitted it, with looks, or without.
"""

ERRORS = ("double", "beside an object", "nothing there")
"""Kinds of listed boxes that are wrong: of an object with a better box, near an object that it does not fit, others."""


class MissCounts(NamedTuple):
    """Boxes of objects by what became of them, `LISTED` or a cause, and listed boxes that are wrong by their kind."""

    objects: Counter[str]
    moving: Counter[str]
    errors: Counter[str]

    def joined(self, others: "MissCounts") -> "MissCounts":
        """Add the counts of another stream."""
        return MissCounts(*(mine + its for mine, its in zip(self, others, strict=True)))


class Misses:
    """Finds out for each object and frame of a stream whether it is listed, and why not.

    Attributes:
        counts: what became of the objects.

    Private attributes: `_looked_at` has the numbers of objects whose whole box some look has shown, and `_track_of` the
    track that last fitted each object.
    """

    def __init__(self) -> None:
        self.counts = MissCounts(Counter(), Counter(), Counter())
        self._looked_at: set[int] = set()
        self._track_of: dict[int, int] = {}

    def step(
        self,
        identities: Tensor,
        boxes: Tensor,
        tracks: Tracks,
        regions: Sequence[tuple[float, float, float, float]],
        frame: tuple[int, int],
        *,
        moving: Tensor | None = None,
        counts: bool = True,
    ) -> None:
        """Take the next frame.

        Args:
            identities: `(N,)`, numbers of the objects that are there.
            boxes: `(N, 4)`.
            tracks: what the agent knows after its looks at the frame.
            regions: what these looks show, `(x1, y1, x2, y2)`.
            frame: `(width, height)` of the frame, at whose borders boxes are cut.
            moving: `(N,)` boolean, the objects that move on their own; None for none.
            counts: whether the frame counts, or is only remembered.
        """
        overlaps = box_iou(boxes.float(), within(tracks.boxes, frame))
        inside = inside_frame(tracks.boxes, frame)
        numbers = identities.tolist()
        for region in regions:
            is_shown = (boxes[:, :2] >= boxes.new_tensor(region[:2])) & (boxes[:, 2:] <= boxes.new_tensor(region[2:]))
            self._looked_at.update(identities[is_shown.all(-1)].tolist())
        if counts:
            fits = (overlaps >= _SAME) & inside
            fates = [self._fate(number, row, tracks) for number, row in zip(numbers, fits, strict=True)]
            self.counts.objects.update(fates)
            if moving is not None:
                self.counts.moving.update(fate for fate, moves in zip(fates, moving.tolist(), strict=True) if moves)
            is_listed = (tracks.probability >= LIKELY) & inside
            self.counts.errors.update(_errors(overlaps[:, is_listed]))
        for number, row in zip(numbers, overlaps, strict=True):
            if (row >= _SAME).any():
                self._track_of[number] = int(tracks.track_ids[int(row.argmax())])

    def _fate(self, number: int, fits: Tensor, tracks: Tracks) -> str:
        """Tell what became of an object, by the tracks in the frame that fit it `(T,)`."""
        if (tracks.probability[fits] >= LIKELY).any():
            return LISTED
        if fits.any():
            return "place uncertain" if (tracks.existence[fits.numpy()] >= LIKELY).any() else "improbable"
        if number in self._track_of:
            return "wrong place" if self._track_of[number] in tracks.track_ids else "forgotten"
        return "not detected" if number in self._looked_at else "not looked at"


def _errors(overlaps: Tensor) -> list[str]:
    """Tell what is wrong with each wrong one of the listed boxes, by their overlaps with the objects `(N, L)`."""
    if not len(overlaps):
        return ["nothing there"] * overlaps.shape[1]
    best, objects = overlaps.max(0)
    # Of several boxes that fit an object, the one that fits it best is right.
    rights = Counter(objects[best >= _SAME].tolist())
    is_wrong = best < _SAME
    beside = int((is_wrong & (best >= _BESIDE)).sum())
    return [
        *["double"] * (rights.total() - len(rights)),
        *["beside an object"] * beside,
        *["nothing there"] * (int(is_wrong.sum()) - beside),
    ]


def miss_rows(counts: MissCounts) -> list[list[str]]:
    """Make the rows of a table: the share of all boxes, and of those that move, by what became of them."""
    groups = counts.objects, counts.moving
    return [[fate, *(_share(group, fate) for group in groups)] for fate in (LISTED, *CAUSES)]


def _share(group: Counter[str], fate: str) -> str:
    """Write the share of boxes that a fate has; `-` where there are none."""
    return f"{group[fate] / group.total():.3f}" if group else "-"
