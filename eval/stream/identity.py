"""IDF1: how well the numbers of objects stay with the same objects over a stream."""

from collections import Counter
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.observation.matching import box_iou
from semfov.tracking.assignment import cheapest_pairs

_SAME = 0.5  # intersection over union from which on a box is that of an object


class IdentityCounts(NamedTuple):
    """Boxes of one or more streams, in all frames together.

    Attributes:
        kept: boxes that are told with the number of their object.
        told: boxes that are told.
        there: boxes of objects that are there.
        found_all: boxes of objects that a told box fits.
        found: those of them whose objects move on their own.
        moving: boxes of objects that move on their own.

    >>> round((IdentityCounts(3, 4, 5) + IdentityCounts(1, 2, 3)).score, 3)  # 2 · 4 / (6 + 8)
    0.571
    """

    kept: int
    told: int
    there: int
    found_all: int = 0
    found: int = 0
    moving: int = 0

    def __add__(self, other: object) -> "IdentityCounts":
        """Add the counts of other streams, whose numbers are others."""
        assert isinstance(other, IdentityCounts)
        return IdentityCounts(*(mine + its for mine, its in zip(self, other, strict=True)))

    @property
    def score(self) -> float:
        """IDF1, from 0 to 1; 1 where there is nothing and nothing is told."""
        return 2 * self.kept / (self.told + self.there) if self.told + self.there else 1.0


class Identities:
    r"""Compares numbers of objects that are told with the true ones over a stream (Ristani et al., 2016).

    Each true object is paired with at most one number, so that as many boxes as possible fit their object:

    .. math:: \mathrm{IDF1} = \frac{2 \, \mathrm{IDTP}}{2 \, \mathrm{IDTP} + \mathrm{IDFP} + \mathrm{IDFN}}
    """

    def __init__(self) -> None:
        self._meetings = Counter[tuple[int, int]]()  # frames in which the boxes of an object and of a number fit
        self._told = 0
        self._there = 0
        self._found_all = 0
        self._found = 0
        self._moving = 0

    def step(
        self,
        true_ids: Tensor,
        true_boxes: Tensor,
        ids: Tensor,
        boxes: Tensor,
        moving: Tensor | None = None,
    ) -> None:
        """Take the next frame.

        Args:
            true_ids: `(N,)`, numbers of the objects that are there.
            true_boxes: `(N, 4)`.
            ids: `(M,)`, numbers of the objects that are told.
            boxes: `(M, 4)`.
            moving: `(N,)` boolean, the objects that move on their own; None for none.
        """
        self._there += len(true_ids)
        self._told += len(ids)
        overlaps = box_iou(true_boxes.float(), boxes.float()) >= _SAME
        self._found_all += int(overlaps.any(1).sum())
        if moving is not None:
            self._found += int(overlaps[moving].any(1).sum())
            self._moving += int(moving.sum())
        fits = overlaps.nonzero()
        pairs = zip(true_ids[fits[:, 0]].tolist(), ids[fits[:, 1]].tolist(), strict=True)
        self._meetings.update(pairs)

    def counts(self) -> IdentityCounts:
        """Count the boxes that keep the number of their object, by the best pairs of objects and numbers."""
        objects = list(dict.fromkeys(one for one, _ in self._meetings))
        numbers = list(dict.fromkeys(other for _, other in self._meetings))
        table = torch.zeros(len(objects), len(numbers), dtype=torch.float64)
        for (one, other), frames in self._meetings.items():
            table[objects.index(one), numbers.index(other)] = frames
        rows, columns = torch.from_numpy(cheapest_pairs(-table.numpy())).T
        kept = int(table[rows, columns].sum())
        return IdentityCounts(kept, self._told, self._there, self._found_all, self._found, self._moving)
