"""Log odds that windows show a class, from all looks at a picture, computed anew only where something has changed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.zoom.evidence import pool_all, pool_spans
from semfov.zoom.gist import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import STEPS
from semfov.zoom.sums import Cells

Box = tuple[int, int, int, int]
Presence = Callable[[Tensor, Tensor, Tensor, Tensor | None], Tensor]

_UNKNOWN = -4.0
"""Log odds that are used where no earlier look gave any."""


@dataclass
class _Table:
    """Predictions of a look for the N windows of a level that lie in it, row by row.

    Attributes:
        span: number of cells of the gist along a side of a window.
        shape: `(down, across)`, number of windows.
        pooled: `(N, K)`, strongest hint of each class in each window.
        summary: `(N, 3)`, summary of all hints in each window (`pool`).
        before: `(N,)`, log odds from coarser looks; None for the overview.
        odds: `(N,)`, log odds from this look.
    """

    span: int
    shape: tuple[int, int]
    pooled: Tensor
    summary: Tensor
    before: Cells | None
    odds: Cells


@dataclass
class _Look:
    """A look and its predictions.

    Attributes:
        gist: gist of the look.
        left: `(rows, columns)`, share of each of its cells that was left to see when the tables were computed.
        tables: predictions for the windows of each level.
    """

    gist: Gist
    left: Cells | None = None
    tables: dict[int, _Table] = field(default_factory=dict)

    @property
    def box(self) -> Box:
        """The cells of the lattice that it shows, `(x1, y1, x2, y2)`."""
        (x, y), scale, (rows, columns) = self.gist.first, self.gist.scale, self.gist.scores.shape[:2]
        return x, y, x + columns * scale, y + rows * scale


class WindowOdds:
    """Log odds that a look at a window shows a class, for the windows of all levels.

    Looks contribute from the coarsest to the closest. A closer look replaces the predictions of coarser ones for the
    windows inside it, and takes them as an input.

    Args:
        lattice: lattice of the picture.
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
        """Log odds of the windows of a level, `(down, across)`; -inf where nothing is known."""
        return self._odds[level]

    def chances(self, level: int) -> Cells:
        """Probabilities of the windows of a level, `(down, across)`."""
        if level not in self._chances:
            self._chances[level] = torch.from_numpy(self._odds[level]).sigmoid().numpy()
        return self._chances[level]

    def update(self, gists: Sequence[Gist], left: Cells) -> None:
        """Update the log odds after further looks.

        Args:
            gists: gists of all looks so far, in their order.
            left: `(rows, columns)` of the lattice, share of each cell that is left to see.
        """
        fresh = [_Look(gist) for gist in gists[len(self._looks) :]]
        # A look changes what closer ones start from, and a change in what is left to see concerns looks of all levels.
        changed = [(look.box, look.gist.level) for look in fresh]
        differs = left != self._left
        if differs.any():
            rows, columns = differs.any(1).nonzero()[0], differs.any(0).nonzero()[0]
            changed.append(((int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1), -1))
            self._left = left.copy()
        if not changed:
            return
        self._looks += fresh
        self._clear()
        for look in sorted(self._looks, key=lambda look: look.gist.level):
            level = look.gist.level
            if look.left is None or any(coarser < level and _overlap(look.box, box) for box, coarser in changed):
                self._predict(look)
            self._write(look)

    def _write(self, look: _Look) -> None:
        """Write the predictions of a look over those of coarser ones."""
        (x, y), scale = look.gist.first, look.gist.scale
        for level, table in look.tables.items():
            odds = table.odds.reshape(table.shape)
            if scale > 1:
                # A gist of large cells has no windows that start inside a cell: they get the odds of the one before.
                odds = odds.repeat(scale, 0).repeat(scale, 1)
            place = self._odds[level][y : y + odds.shape[0], x : x + odds.shape[1]]
            place[:] = odds[: place.shape[0], : place.shape[1]]

    @torch.no_grad()
    def _predict(self, look: _Look) -> None:
        """Compute the predictions of a look anew for the windows in which something has changed."""
        gist, (x, y) = look.gist, look.gist.first
        stale = self._pool(look)
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

    def _pool(self, look: _Look) -> dict[int, NDArray[np.bool_]]:
        """Pool the hints that are left to see in a look; return which windows of each level were pooled."""
        gist, last = look.gist, look.left
        look.left = left = self._left_of(gist)
        stale: dict[int, NDArray[np.bool_]] = {}
        if last is None:
            levels = range(gist.level + 1, min(gist.level + STEPS, self._lattice.levels - 1) + 1)
            spans = {level: span for level in levels if (span := self._lattice.span(level) // gist.scale)}
            pools = pool_spans(gist.scores * torch.from_numpy(left)[..., None], list(spans.values()))
            for (level, span), (pooled, summary) in zip(spans.items(), pools, strict=True):
                shape = _places(gist.scores, span)
                look.tables[level] = _Table(span, shape, pooled, summary, None, np.zeros(len(pooled), np.float32))
                stale[level] = np.ones(len(pooled), np.bool_)
            return stale
        differs = left != last
        rows, columns = differs.any(1).nonzero()[0], differs.any(0).nonzero()[0]
        for level, table in look.tables.items():
            stale[level] = np.zeros(len(table.odds), np.bool_)
            if len(rows):
                some = _reach(rows, table, 0), _reach(columns, table, 1)
                _pool_some(table, gist.scores, left, some)
                stale[level].reshape(table.shape)[some] = True
        return stale

    def _judge(self, look: _Look, stale: dict[int, NDArray[np.bool_]]) -> None:
        """Compute the log odds of windows whose inputs have changed, of all levels in one call of the network."""
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


def _places(scores: Tensor, span: int) -> tuple[int, int]:
    """Number of windows of `span` cells in a gist of `(rows, columns, K)`, down a column and along a row."""
    rows, columns = scores.shape[:2]
    return max(rows - span, 0) + 1, max(columns - span, 0) + 1


def _reach(changed: NDArray[np.intp], table: _Table, axis: int) -> slice:
    """Windows of a table that hold a changed cell, along an axis."""
    return slice(max(int(changed[0]) - table.span + 1, 0), min(int(changed[-1]) + 1, table.shape[axis]))


def _pool_some(table: _Table, scores: Tensor, left: Cells, some: tuple[slice, slice]) -> None:
    """Pool the hints of some windows of a table again, given by their rows and columns."""
    rows, columns = some
    here = slice(rows.start, rows.stop + table.span - 1), slice(columns.start, columns.stop + table.span - 1)
    best, crowd = pool_all(scores[here] * torch.from_numpy(left[here])[..., None], table.span)
    shape = rows.stop - rows.start, columns.stop - columns.start, -1
    table.pooled.view(*table.shape, -1)[rows, columns] = best.view(shape)
    table.summary.view(*table.shape, -1)[rows, columns] = crowd.view(shape)
