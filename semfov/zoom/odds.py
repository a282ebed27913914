"""Log odds that windows show a class, from all looks at a picture, computed anew only where something has changed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.zoom.evidence import GlimpseEvidence, pool_spans
from semfov.zoom.gist import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import STEPS
from semfov.zoom.sums import Box, Cells, extent

Place = tuple[slice, slice]
"""Rows and columns of an array."""

_UNKNOWN = -4.0
"""Log odds that are used where no earlier look gave any."""


@dataclass
class _Table:
    """The windows of a level that lie in a look.

    Attributes:
        span: number of cells of the gist along a side of a window.
        shape: `(down, across)`, number of windows.
        rows: their rows in the arrays of the look.
        places: `(down * across,)`, index of each in an array of all windows of the level.
    """

    span: int
    shape: tuple[int, int]
    rows: slice
    places: NDArray[np.intp]

    def of(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """View of the rows of an array of the look that belong to these windows, `(down, across, ...)`."""
        return values[self.rows].reshape(*self.shape, *values.shape[1:])

    def holding(self, changed: Box) -> Place:
        """Windows that hold one of the changed cells of the gist."""
        (x1, y1, x2, y2), reach = changed, self.span - 1
        return slice(max(y1 - reach, 0), min(y2, self.shape[0])), slice(max(x1 - reach, 0), min(x2, self.shape[1]))


class _Look:
    """A look and its predictions for N windows: those of up to three closer levels that lie in it.

    Args:
        gist: gist of the look.
        lattice: lattice of the picture.

    Attributes:
        fresh: whether nothing was predicted from it yet.
        hinted: `(rows, columns)`, whether a cell has hints.
        scores: `(rows, columns, K)`, those of the gist.
        left: `(rows, columns)`, share of each cell that is left to see.
        shown: `(rows, columns, K)`, scores of the hints times that share.
        tables: the windows of each level.
        facts: `(N, 6)`, `GlimpseEvidence.hint_facts`.
        before: `(N,)`, log odds from coarser looks.
        odds: `(N,)`, log odds from this look.
        stale: `(N,)`, whether the log odds are to be computed anew.
    """

    def __init__(self, gist: Gist, lattice: Lattice) -> None:
        self.gist = gist
        self.fresh = True
        self.hinted = gist.best.numpy() > 0
        self.left = np.ones(self.hinted.shape, np.float32)
        self.shown = self.scores = gist.scores.numpy()
        self.tables: dict[int, _Table] = {}
        count = 0
        for level in range(gist.level + 1, min(gist.level + STEPS, lattice.levels - 1) + 1):
            if span := lattice.span(level) // gist.scale:
                down, across = (max(n - span, 0) + 1 for n in self.hinted.shape)
                # A cell of a coarse look can reach beyond the last window of a level: it goes by that one.
                ends = lattice.places(level)
                x, y = (
                    np.minimum(low + gist.scale * np.arange(n), end - 1)
                    for low, n, end in zip(gist.first, (across, down), ends, strict=True)
                )
                places = (y[:, None] * ends[0] + x).ravel()
                self.tables[level] = _Table(span, (down, across), slice(count, count + len(places)), places)
                count += len(places)
        self.facts = np.zeros((count, 6), np.float32)
        self.before, self.odds = np.full(count, np.nan, np.float32), np.zeros(count, np.float32)
        self.stale = np.ones(count, np.bool_)

    def cover(self, left: Cells) -> Box | None:
        """Take over the share of each cell that is left to see; return the box about hints that this changes."""
        differs = self.hinted & (left != self.left)
        self.left = left
        if not differs.any():
            return None
        x1, y1, x2, y2 = changed = extent(differs)
        if self.shown is self.scores:
            self.shown = self.scores.copy()
        here = slice(y1, y2), slice(x1, x2)
        np.multiply(self.scores[here], left[here][..., None], out=self.shown[here])
        return changed

    @property
    def box(self) -> Box:
        """The cells of the lattice that it shows, `(x1, y1, x2, y2)`."""
        (x, y), scale, (rows, columns) = self.gist.first, self.gist.scale, self.hinted.shape
        return x, y, x + columns * scale, y + rows * scale


@dataclass
class _Pooled:
    """Pooled hints of N windows of a look: their level, their place in its table, and the results of `pool_all`."""

    look: _Look
    level: int
    place: Place
    scores: Tensor
    summary: Tensor


class WindowOdds:
    """Log odds that a look at a window shows a class, for the windows of all levels.

    Looks contribute from the coarsest to the closest. A closer look replaces the predictions of coarser ones for the
    windows inside it, and takes them as an input.

    Args:
        lattice: lattice of the picture.
        evidence: learned evidence.
        target: class 1..K.
    """

    def __init__(self, lattice: Lattice, evidence: GlimpseEvidence, target: int) -> None:
        self._lattice, self._evidence, self._target = lattice, evidence, target
        self._looks: list[_Look] = []
        self._left = np.ones((lattice.rows, lattice.columns), np.float32)
        self._odds: dict[int, Cells] = {
            level: np.full(lattice.places(level)[::-1], -np.inf, np.float32) for level in range(1, lattice.levels)
        }
        self._chances: dict[int, Cells] = {}

    def odds(self, level: int) -> Cells:
        """Log odds of the windows of a level, `(down, across)`; -inf where nothing is known."""
        return self._odds[level]

    def chances(self, level: int) -> Cells:
        """Probabilities of the windows of a level, `(down, across)`."""
        if level not in self._chances:
            self._chances[level] = torch.from_numpy(self._odds[level]).sigmoid().numpy()
        return self._chances[level]

    @torch.no_grad()
    def update(self, gists: Sequence[Gist], left: Cells) -> None:
        """Update the log odds after further looks.

        Args:
            gists: gists of all looks so far, in their order.
            left: `(rows, columns)` of the lattice, share of each cell that is left to see.
        """
        fresh = [_Look(gist, self._lattice) for gist in gists[len(self._looks) :]]
        # A look changes what closer ones start from, and a change in what is left to see concerns looks of all levels.
        changed = [(look.box, look.gist.level) for look in fresh]
        differs = left != self._left
        if differs.any():
            changed.append((extent(differs), -1))
            self._left = left.copy()
        if not changed:
            return
        self._looks = sorted(self._looks + fresh, key=lambda look: look.gist.level)
        affected = [
            look.fresh or any(level < look.gist.level and _overlap(look.box, box) for box, level in changed)
            for look in self._looks
        ]
        first = affected.index(True)
        if not all(look.fresh for look in self._looks[first:]):
            first = 0
            self._chances.clear()
            for odds in self._odds.values():
                odds.fill(-np.inf)
        self._read([look for look, concerned in zip(self._looks, affected, strict=True) if concerned])
        for look, concerned in zip(self._looks[first:], affected[first:], strict=True):
            if concerned:
                self._judge(look)
            self._write(look)

    def _write(self, look: _Look) -> None:
        """Write the predictions of a look over those of coarser ones."""
        (x, y), scale = look.gist.first, look.gist.scale
        for level, table in look.tables.items():
            odds = table.of(look.odds)
            if scale > 1:
                # A gist of large cells has no windows that start inside a cell: they get the odds of the one before.
                odds = odds.repeat(scale, 0).repeat(scale, 1)
            place = self._odds[level][y : y + odds.shape[0], x : x + odds.shape[1]]
            place[:] = odds[: place.shape[0], : place.shape[1]]
            self._chances.pop(level, None)

    def _read(self, looks: Sequence[_Look]) -> None:
        """Compute the facts of the windows whose hints have changed, of all looks in one call of the network."""
        parts = [part for look in looks for part in self._pool(look)]
        if not parts:
            return
        counts = [len(part.scores) for part in parts]
        scores, summary = torch.cat([part.scores for part in parts]), torch.cat([part.summary for part in parts])
        steps = torch.from_numpy(np.repeat([part.level - part.look.gist.level for part in parts], counts))
        facts = self._evidence.hint_facts(scores, summary, steps, self._target)[:, 0]
        told, start = facts.numpy(), 0
        for part, count in zip(parts, counts, strict=True):
            table = part.look.tables[part.level]
            place = table.of(part.look.facts)[part.place]
            place[:] = told[start : start + count].reshape(place.shape)
            table.of(part.look.stale)[part.place] = True
            start += count

    def _pool(self, look: _Look) -> list[_Pooled]:
        """Pool the hints that are left to see in a look, in the windows where they have changed."""
        changed = look.cover(self._left_of(look.gist))
        if look.fresh:
            rows, columns = look.hinted.shape
            changed, look.fresh = (0, 0, columns, rows), False
        if changed is None:
            return []
        places = {level: table.holding(changed) for level, table in look.tables.items()}
        # The largest windows, which come first, reach over the cells of all others.
        first = look.gist.level + 1
        (below, beside), reach = places[first], look.tables[first].span - 1
        shown = look.shown[below.start : below.stop + reach, beside.start : beside.stop + reach]
        pools = pool_spans(torch.from_numpy(shown), [table.span for table in look.tables.values()])
        parts = []
        for (level, (down, across)), maps in zip(places.items(), pools, strict=True):
            at = _shifted(down, below.start), _shifted(across, beside.start)
            parts.append(_Pooled(look, level, (down, across), *(values[at].flatten(0, 1) for values in maps)))
        return parts

    def _judge(self, look: _Look) -> None:
        """Compute the log odds of the windows of a look for which the facts or the log odds before have changed."""
        coarsest = look.gist.level == 0
        for level, table in () if coarsest else look.tables.items():
            known = self._odds[level].take(table.places)
            known[known == -np.inf] = _UNKNOWN
            look.stale[table.rows] |= known != look.before[table.rows]
            look.before[table.rows] = known
        rows = look.stale.nonzero()[0]
        if len(rows):
            before = None if coarsest else torch.from_numpy(look.before[rows])
            look.odds[rows] = self._evidence.odds(torch.from_numpy(look.facts[rows]), before).numpy()
            look.stale[:] = False

    def _left_of(self, gist: Gist) -> Cells:
        """Share of each cell of a gist that is left to see, `(rows, columns)`."""
        rows, columns = gist.scores.shape[:2]
        high, wide = rows * gist.scale, columns * gist.scale
        (x, y), scale = gist.first, gist.scale
        part = self._left[y : y + high, x : x + wide]
        if part.shape != (high, wide):
            part = np.pad(part, ((0, high - part.shape[0]), (0, wide - part.shape[1])), constant_values=1)
        return part.copy() if scale == 1 else part.reshape(rows, scale, columns, scale).mean((1, 3))


def _overlap(box: Box, other: Box) -> bool:
    return box[0] < other[2] and box[1] < other[3] and box[2] > other[0] and box[3] > other[1]


def _shifted(part: slice, start: int) -> slice:
    """A part of an array, in an array that begins at `start`."""
    return slice(part.start - start, part.stop - start)
