"""Log odds that windows show a class, from all looks at a picture, computed anew only where something has changed."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.scene import boxes_meet
from semfov.zoom.evidence import STEPS, GlimpseEvidence, pool_spans
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.sums import Box, Cells, Place, extent, union

_UNKNOWN = -4.0
"""Log odds that are used where no earlier look gave any."""


class _Table(NamedTuple):
    """The windows of a level that lie in a look; shape `(down, across)`, places `(down * across,)`."""

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


class _Pooled(NamedTuple):
    """Pooled hints of windows of one level in a look; scores `(n, K)`, summary `(n, 3)`."""

    step: int
    scores: Tensor
    summary: Tensor
    facts: NDArray[np.generic]
    stale: NDArray[np.generic]


class _Look:
    """A look and its predictions for N windows: those of up to three closer levels that lie in it.

    Shapes: left `(rows, columns)`, scores `(rows, columns, K)`, visible `(rows, columns, K)`, facts `(N, 6)`, before
    `(N,)`, odds `(N,)`, stale `(N,)`.
    """

    def __init__(self, gist: Gist, lattice: Lattice) -> None:
        self.gist = gist
        (x, y), scale, (rows, columns) = gist.first, gist.scale, gist.scores.shape[:2]
        self.box: Box = (x, y, x + columns * scale, y + rows * scale)
        self.fresh = True
        self.left = np.ones((rows, columns), np.float32)
        self.visible = self.scores = gist.scores.numpy()
        self.tables: dict[int, _Table] = {}
        count = 0
        for level in range(gist.level + 1, min(gist.level + STEPS, lattice.levels - 1) + 1):
            if span := lattice.span(level) // scale:
                down, across = (max(n - span, 0) + 1 for n in (rows, columns))
                # A cell of a coarse look can reach beyond the last window of a level: it goes by that one.
                ends = lattice.places(level)
                column, row = (
                    np.minimum(low + scale * np.arange(n), end - 1)
                    for low, n, end in zip((x, y), (across, down), ends, strict=True)
                )
                places = (row[:, None] * ends[0] + column).ravel()
                self.tables[level] = _Table(span, (down, across), slice(count, count + len(places)), places)
                count += len(places)
        self.facts = np.zeros((count, 6), np.float32)
        self.before, self.odds = np.full(count, np.nan, np.float32), np.zeros(count, np.float32)
        self.stale = np.ones(count, np.bool_)

    def pool(self, left: Cells) -> Iterator[_Pooled]:
        """Pool the hints that are left to see, in the windows where they have changed."""
        before = self.left
        self.left = self._left_of(left)
        if self.fresh:
            changed, self.fresh = (0, 0, before.shape[1], before.shape[0]), False
            differs = self.left != before
        else:
            differs = (self.gist.best.numpy() > 0) & (self.left != before)
            if not differs.any():
                return
            changed = extent(differs)
        if differs.any():
            self._cover(extent(differs))
        if not self.tables:
            return
        places = [table.holding(changed) for table in self.tables.values()]
        # The largest windows, which come first, reach over the cells of all others.
        (below, beside), reach = places[0], next(iter(self.tables.values())).span - 1
        part = slice(below.start, below.stop + reach), slice(beside.start, beside.stop + reach)
        pools = pool_spans(torch.from_numpy(self.visible[part]), [table.span for table in self.tables.values()])
        for (level, table), (down, across), maps in zip(self.tables.items(), places, pools, strict=True):
            at = _shifted(down, below.start), _shifted(across, beside.start)
            top, summary = (values[at].flatten(0, 1) for values in maps)
            facts, stale = (table.of(values)[down, across] for values in (self.facts, self.stale))
            yield _Pooled(level - self.gist.level, top, summary, facts, stale)

    def _cover(self, changed: Box) -> None:
        """Multiply the scores by the share that is left to see, where it has changed."""
        if self.visible is self.scores:
            self.visible = self.scores.copy()
        x1, y1, x2, y2 = changed
        here = slice(y1, y2), slice(x1, x2)
        np.multiply(self.scores[here], self.left[here][..., None], out=self.visible[here])

    def _left_of(self, left: Cells) -> Cells:
        """Share of each cell of the gist that is left to see, `(rows, columns)`."""
        (x1, y1, x2, y2), scale = self.box, self.gist.scale
        part = left[y1:y2, x1:x2]
        if part.shape != (y2 - y1, x2 - x1):
            part = np.pad(part, ((0, y2 - y1 - part.shape[0]), (0, x2 - x1 - part.shape[1])), constant_values=1)
        rows, columns = self.left.shape
        return part.copy() if scale == 1 else part.reshape(rows, scale, columns, scale).mean((1, 3))


class WindowOdds:
    r"""Log odds that a look at a window shows a class, for the windows of all levels; left `(rows, columns)`.

    Looks contribute from the coarsest to the closest. A closer look replaces the predictions of coarser ones for the
    windows inside it, and takes them as an input (`GlimpseEvidence.presence`). With the looks that hold the window w,
    numbered in this order:

    .. math:: o_i(w) = f(u s_i, w, o_{i-1}(w))

    The hints s of each look count for the share u of their cell that is left to see.
    """

    def __init__(
        self, lattice: Lattice, evidence: GlimpseEvidence, target: int, gists: Sequence[Gist], left: Cells
    ) -> None:
        self._lattice, self._evidence, self._target = lattice, evidence, target
        self._gists, self._left = gists, left
        self._looks: list[_Look] = []
        self._odds: dict[int, Cells] = {
            level: np.full(lattice.places(level)[::-1], -np.inf, np.float32) for level in range(1, lattice.levels)
        }
        self._changed: Box | None = None

    def mark(self, changed: Box) -> None:
        """Have the log odds computed anew where less or more is left to see."""
        self._changed = union(changed, self._changed)

    @torch.no_grad()
    def update(self) -> Mapping[int, Cells]:
        """Log odds of the windows of each level, `(down, across)`; -inf where unknown. The next call changes them."""
        fresh = [_Look(gist, self._lattice) for gist in self._gists[len(self._looks) :]]
        # A look changes what closer ones start from, and a change in what is left to see concerns looks of all levels.
        changed = [(look.box, look.gist.level) for look in fresh]
        if self._changed is not None:
            changed.append((self._changed, -1))
            self._changed = None
        if changed:
            self._looks = sorted(self._looks + fresh, key=lambda look: look.gist.level)
            concerned = [
                look
                for look in self._looks
                if look.fresh or any(level < look.gist.level and boxes_meet(look.box, box) for box, level in changed)
            ]
            self._read(concerned)
            for odds in self._odds.values():
                odds.fill(-np.inf)
            for look in self._looks:
                if look in concerned:
                    self._judge(look)
                self._write(look)
        return self._odds

    def _read(self, looks: Sequence[_Look]) -> None:
        """Compute the facts of the windows whose hints have changed, of all looks in one call of the network."""
        pools = [pool for look in looks for pool in look.pool(self._left)]
        if not pools:
            return
        counts = [len(pool.scores) for pool in pools]
        scores, summary = torch.cat([pool.scores for pool in pools]), torch.cat([pool.summary for pool in pools])
        steps = torch.from_numpy(np.repeat([pool.step for pool in pools], counts))
        facts = self._evidence.hint_facts(scores, summary, steps, self._target)[:, 0].numpy()
        for pool, values in zip(pools, np.split(facts, np.cumsum(counts)[:-1]), strict=True):
            pool.facts[:] = values.reshape(pool.facts.shape)
            pool.stale[:] = True

    def _judge(self, look: _Look) -> None:
        """Compute the log odds of the windows of a look for which the facts or the log odds before have changed."""
        coarsest = look.gist.level == 0
        for level, table in () if coarsest else look.tables.items():
            coarser = self._odds[level].take(table.places)
            coarser[coarser == -np.inf] = _UNKNOWN
            look.stale[table.rows] |= coarser != look.before[table.rows]
            look.before[table.rows] = coarser
        rows = look.stale.nonzero()[0]
        if len(rows):
            before = None if coarsest else torch.from_numpy(look.before[rows])
            look.odds[rows] = self._evidence.odds(torch.from_numpy(look.facts[rows]), before).numpy()
            look.stale[:] = False

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


def _shifted(part: slice, start: int) -> slice:
    """A part of an array, in an array that begins at `start`."""
    return slice(part.start - start, part.stop - start)
