"""Log odds that windows show a class, by all looks at a picture, computed anew only where something has changed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.zoom.evidence import STEPS, pool_all, pool_spans
from semfov.zoom.gist import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.sums import Cells

Box = tuple[int, int, int, int]
Presence = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]

_UNKNOWN = -4.0
"""Log odds that stand for those of an earlier look where there was none."""


@dataclass
class _Table:
    """What a look tells of the windows of a level that lie in it, row by row.

    Attributes:
        span: cells of the look along a side of a window.
        shape: `(down, across)` of the windows, N in all.
        pooled: `(N, K)`, strongest hints in each window.
        summary: `(N, 3)`, of all hints in it.
        before: `(N,)`, log odds by looks from farther off; None for an overview.
        odds: `(N,)`.
    """

    span: int
    shape: tuple[int, int]
    pooled: Tensor
    summary: Tensor
    before: Cells | None
    odds: Cells


@dataclass
class _Look:
    """A look, and what it tells.

    Attributes:
        gist: of the look.
        left: `(rows, columns)`, share of each of its cells that is left to see, when the tables were computed.
        tables: by level of the windows.
    """

    gist: Gist
    left: Cells | None = None
    tables: dict[int, _Table] = field(default_factory=dict)

    @property
    def box(self) -> Box:
        """Its cells on the lattice, `(x1, y1, x2, y2)`."""
        (x, y), scale, (rows, columns) = self.gist.first, self.gist.scale, self.gist.scores.shape[:2]
        return x, y, x + columns * scale, y + rows * scale


class WindowOdds:
    """Log odds that closer looks show a class, for the windows of all levels.

    Looks are taken from the coarsest to the closest. A closer one replaces what those before it told of its windows,
    and starts from that.

    Args:
        lattice: of the picture.
        presence: `GlimpseEvidence.presence` for the class.
    """

    def __init__(self, lattice: Lattice, presence: Presence) -> None:
        self._lattice, self._presence = lattice, presence
        self._looks: list[_Look] = []
        self._left = np.ones((lattice.rows, lattice.columns), np.float32)
        self._odds: dict[int, Cells] = {}
        self._chances: dict[int, Cells] = {}
        self._clear()

    def _clear(self) -> None:
        self._chances.clear()
        for level in range(1, self._lattice.levels):
            self._odds[level] = np.full(self._lattice.places(level)[::-1], -np.inf, np.float32)

    def odds(self, level: int) -> Cells:
        """`(down, across)`, -inf where nothing is known."""
        return self._odds[level]

    def chances(self, level: int) -> Cells:
        """Probabilities, `(down, across)`."""
        if level not in self._chances:
            self._chances[level] = torch.from_numpy(self._odds[level]).sigmoid().numpy()
        return self._chances[level]

    def update(self, gists: Sequence[Gist], left: Cells) -> None:
        """Take account of further looks, and of what is left to see.

        Args:
            gists: of all looks so far, in their order.
            left: `(rows, columns)` of the lattice.
        """
        fresh = [_Look(gist) for gist in gists[len(self._looks) :]]
        changed = [look.box for look in fresh]
        differs = left != self._left
        if differs.any():
            rows, columns = differs.any(1).nonzero()[0], differs.any(0).nonzero()[0]
            changed.append((int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1))
            self._left = left.copy()
        if not changed:
            return
        self._looks += fresh
        self._clear()
        for look in sorted(self._looks, key=lambda look: look.gist.level):
            if any(_overlap(look.box, box) for box in changed):
                self._tell(look)
            self._put(look)

    def _put(self, look: _Look) -> None:
        """Write what a look tells over what coarser ones do."""
        (x, y), scale = look.gist.first, look.gist.scale
        for level, table in look.tables.items():
            told = table.odds.reshape(table.shape)
            if scale > 1:
                # Windows between the places that a coarse look tells go by the place before them.
                told = told.repeat(scale, 0).repeat(scale, 1)
            place = self._odds[level][y : y + told.shape[0], x : x + told.shape[1]]
            place[:] = told[: place.shape[0], : place.shape[1]]

    @torch.no_grad()
    def _tell(self, look: _Look) -> None:
        """Bring what a look tells up to date: of windows in which something has changed."""
        gist, (x, y) = look.gist, look.gist.first
        left, last = self._left_of(gist), look.left
        look.left = left
        levels = range(gist.level + 1, min(gist.level + STEPS, self._lattice.levels - 1) + 1)
        scores = gist.scores
        stale: dict[int, NDArray[np.bool_]] = {}
        if last is None:
            spans = {level: span for level in levels if (span := self._lattice.span(level) // gist.scale)}
            told = pool_spans(scores * torch.from_numpy(left)[..., None], list(spans.values()))
            for (level, span), (pooled, summary) in zip(spans.items(), told, strict=True):
                shape = _places(scores, span)
                look.tables[level] = _Table(span, shape, pooled, summary, None, np.zeros(len(pooled), np.float32))
                stale[level] = np.ones(len(pooled), np.bool_)
        else:
            differs = left != last
            rows, columns = differs.any(1).nonzero()[0], differs.any(0).nonzero()[0]
            for level, table in look.tables.items():
                stale[level] = np.zeros(len(table.odds), np.bool_)
                if len(rows):
                    _pool_again(table, scores, left, _reach(rows, table, 0), _reach(columns, table, 1), stale[level])
        if gist.level > 0:
            for level, table in look.tables.items():
                # A cell of a coarse look can reach beyond the last window of a level: it goes by that one.
                rows, columns = (low + gist.scale * np.arange(n) for low, n in zip((y, x), table.shape, strict=True))
                known = self._odds[level].take(rows, 0, mode="clip").take(columns, 1, mode="clip").reshape(-1)
                before = np.where(known == -np.inf, np.float32(_UNKNOWN), known)
                if table.before is not None:
                    stale[level] |= before != table.before
                table.before = before
        self._judge(look, stale)

    def _judge(self, look: _Look, stale: dict[int, NDArray[np.bool_]]) -> None:
        """Compute the odds of windows whose inputs have changed, of all levels at once."""
        jobs = [(level, look.tables[level], rows) for level, mask in stale.items() if len(rows := mask.nonzero()[0])]
        if not jobs:
            return
        index = [torch.from_numpy(rows) for _, _, rows in jobs]
        pooled = torch.cat([table.pooled[rows] for (_, table, _), rows in zip(jobs, index, strict=True)])
        summary = torch.cat([table.summary[rows] for (_, table, _), rows in zip(jobs, index, strict=True)])
        steps = np.concatenate([np.full(len(rows), level - look.gist.level) for level, _, rows in jobs])
        before = None
        if look.gist.level > 0:
            known = [table.before[rows] for _, table, rows in jobs if table.before is not None]
            before = torch.from_numpy(np.concatenate(known))[:, None]
        odds = self._presence(pooled, summary, torch.from_numpy(steps), before).numpy()
        ends = np.cumsum([len(rows) for _, _, rows in jobs])
        for (_, table, rows), part in zip(jobs, np.split(odds, ends[:-1]), strict=True):
            table.odds[rows] = part

    def _left_of(self, gist: Gist) -> Cells:
        """What is left to see in the cells of a look, `(rows, columns)`: 0 where they were looked at closely."""
        rows, columns = gist.scores.shape[:2]
        high, wide = rows * gist.scale, columns * gist.scale
        (x, y), scale = gist.first, gist.scale
        part = self._left[y : y + high, x : x + wide]
        if part.shape != (high, wide):
            part = np.pad(part, ((0, high - part.shape[0]), (0, wide - part.shape[1])), constant_values=1)
        return part.copy() if scale == 1 else part.reshape(rows, scale, columns, scale).mean((1, 3))


def _overlap(box: Box, other: Box) -> bool:
    return box[0] < other[2] and box[1] < other[3] and box[2] > other[0] and box[3] > other[1]


def _places(scores: Tensor, span: int) -> tuple[int, int]:
    """How many windows of `span` cells a look of `(rows, columns, K)` holds down a column and along a row."""
    rows, columns = scores.shape[:2]
    return max(rows - span, 0) + 1, max(columns - span, 0) + 1


def _reach(changed: NDArray[np.intp], table: _Table, axis: int) -> slice:
    """Which windows along an axis hold a cell that has changed."""
    return slice(max(int(changed[0]) - table.span + 1, 0), min(int(changed[-1]) + 1, table.shape[axis]))


def _pool_again(
    table: _Table, scores: Tensor, left: Cells, rows: slice, columns: slice, stale: NDArray[np.bool_]
) -> None:
    """Pool hints again in some of the windows of a table, and mark them."""
    here = slice(rows.start, rows.stop + table.span - 1), slice(columns.start, columns.stop + table.span - 1)
    best, crowd = pool_all(scores[here] * torch.from_numpy(left[here])[..., None], table.span)
    shape = rows.stop - rows.start, columns.stop - columns.start, -1
    table.pooled.view(*table.shape, -1)[rows, columns] = best.view(shape)
    table.summary.view(*table.shape, -1)[rows, columns] = crowd.view(shape)
    stale.reshape(table.shape)[rows, columns] = True
