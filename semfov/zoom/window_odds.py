r"""The log odds that a look at each window shows a class, kept up to date as looks are added and cells are explored.

Each look predicts for the windows inside it that are up to three levels closer; the closest look at a place counts:

    level 0   ┌───────────────────┐
              │   ┌─────────┐     │    The overview predicts windows of levels 1 to 3 in the whole picture.
    level 1   │   │   ┌───┐ │     │    A look of level 1 predicts windows of levels 2 to 4 inside it, from its own
    level 2   │   │   └───┘ │     │    hints and from what the overview predicted for them. There its odds stand.
              │   └─────────┘     │
              └───────────────────┘

The odds of a look are computed in two steps, and what they are computed from is kept with them:

    cells to explore ──► visible hints ──pool──► facts ──┐
                                                         ├──► odds ──► coarser odds of closer looks
                         odds of the coarser looks ──────┘

A change runs along the arrows. Exploring a cell changes the facts of the windows that hold it. A new look changes the
coarser odds of all closer looks that meet it. `_LookPredictions.outdated` marks the windows whose odds must be computed
again for either reason; all others keep theirs.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.scene import boxes_meet
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.pooling import pool_spans
from semfov.zoom.survey import STEPS
from semfov.zoom.window_sums import CellBox, Cells, Place, enclosing, extent

_NO_COARSER_ODDS = -4.0  # log odds of a window for which no coarser look predicted any


class _LevelWindows(NamedTuple):
    """The windows of one level that lie in a look, row by row.

    Attributes:
        span: side of a window, in cells of the gist.
        shape: number of windows, `(down, across)`.
        rows: the part of the look's arrays that holds them.
        places: `(down * across,)`, their indices among all windows of the level.
    """

    span: int
    shape: tuple[int, int]
    rows: slice
    places: NDArray[np.intp]

    @classmethod
    def in_gist(cls, gist: Gist, lattice: Lattice, level: int, start: int) -> "_LevelWindows | None":
        """List the windows of a level in a look, whose arrays hold them from `start` on; None if cells are larger."""
        span = lattice.span(level) // gist.scale
        if span == 0:
            return None
        rows, columns = gist.scores.shape[:2]
        down = max(rows - span, 0) + 1
        across = max(columns - span, 0) + 1
        x, y = gist.first
        last_column, last_row = (count - 1 for count in lattice.places(level))
        # A cell of a coarse look can reach beyond the last window of a level: it goes by that one.
        column = np.minimum(x + gist.scale * np.arange(across), last_column)
        row = np.minimum(y + gist.scale * np.arange(down), last_row)
        places = (row[:, None] * (last_column + 1) + column).ravel()
        return cls(span, (down, across), slice(start, start + len(places)), places)

    def of(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """View the part of an array of the look that belongs to these windows, as `(down, across, ...)`."""
        return values[self.rows].reshape(*self.shape, *values.shape[1:])

    def holding(self, box: CellBox) -> Place:
        """Find the rows and columns of the windows that hold a cell of a box."""
        x1, y1, x2, y2 = box
        down, across = self.shape
        rows = slice(max(y1 - self.span + 1, 0), min(y2, down))
        columns = slice(max(x1 - self.span + 1, 0), min(x2, across))
        return rows, columns


class _PooledWindows(NamedTuple):
    """The pooled hints of n windows of one level, and where the facts that follow from them are kept.

    Attributes:
        octaves: octaves from the look to a closer look at the windows.
        scores: `(n, K)`, strongest hint of each class.
        summary: `(n, 3)`, summary of all hints.
        facts: `(down, across, 6)`, a view of the facts of the look.
        outdated: `(down, across)`, a view of its marks.
    """

    octaves: int
    scores: Tensor
    summary: Tensor
    facts: NDArray[np.generic]
    outdated: NDArray[np.generic]


class _LookPredictions:
    """A look, and its predictions for the N windows inside it, of up to three closer levels.

    Invariant: where `outdated` is false, `odds` are the evidence's answer to `facts` and `coarser_odds`, and `facts`
    are those of `visible_scores`, which are the scores of the gist times `unexplored`.

    Attributes:
        gist: the hints of the look by cell.
        box: cells of the lattice that the gist covers; its last squares may reach beyond the picture.
        windows: the windows inside it, by level.
        is_new: whether nothing was pooled yet.
        unexplored: share of each cell of the gist that was left to explore when hints were last pooled.
        visible_scores: `(rows, columns, K)`; the gist's own array until a cell is explored.
        facts: `(N, 6)`, what the evidence reads from the hints (`GlimpseEvidence.hint_facts`).
        coarser_odds: `(N,)`, log odds by coarser looks from which `odds` were computed; NaN, which differs from every
            number, before the first time.
        odds: `(N,)`, log odds that a look at the window shows the class.
        outdated: `(N,)`, whether the facts or the coarser odds have changed since the odds were computed.
    """

    def __init__(self, gist: Gist, lattice: Lattice) -> None:
        self.gist = gist
        x, y = gist.first
        rows, columns = gist.scores.shape[:2]
        self.box: CellBox = (x, y, x + columns * gist.scale, y + rows * gist.scale)
        self.is_new = True
        self.unexplored = np.ones((rows, columns), np.float32)
        self._scores = gist.scores.numpy()
        self.visible_scores = self._scores
        self.windows: dict[int, _LevelWindows] = {}
        count = 0
        for level in range(gist.level + 1, min(gist.level + STEPS, lattice.levels - 1) + 1):
            windows = _LevelWindows.in_gist(gist, lattice, level, count)
            if windows is not None:
                self.windows[level] = windows
                count = windows.rows.stop
        self.facts = np.zeros((count, 6), np.float32)
        self.coarser_odds = np.full(count, np.nan, np.float32)
        self.odds = np.zeros(count, np.float32)
        self.outdated = np.ones(count, np.bool_)

    def explore(self, unexplored: Cells) -> CellBox | None:
        """Let the scores of the gist count by the share of their cells that is left to explore.

        Args:
            unexplored: `(rows, columns)` of the lattice, the present shares.

        Returns:
            Cells of the gist whose hints count otherwise than when they were last pooled, all of them at first; None
            for none.
        """
        before = self.unexplored
        self.unexplored = self._mean_by_square(unexplored)
        differs = self.unexplored != before
        if not self.is_new:
            differs &= self.gist.best.numpy() > 0  # cells without a hint change nothing
        changed = extent(differs) if differs.any() else None
        if changed is not None:
            self._hide_explored(changed)
        if self.is_new:
            self.is_new = False
            rows, columns = before.shape
            return 0, 0, columns, rows
        return changed

    def _mean_by_square(self, unexplored: Cells) -> Cells:
        """Average shares of cells of the lattice over the squares of cells of the gist."""
        x1, y1, x2, y2 = self.box
        cells = unexplored[y1:y2, x1:x2]
        beyond = (y2 - y1 - cells.shape[0], x2 - x1 - cells.shape[1])
        if beyond != (0, 0):
            # What lies beyond the picture is never explored.
            cells = np.pad(cells, ((0, beyond[0]), (0, beyond[1])), constant_values=1)
        scale = self.gist.scale
        if scale == 1:
            return cells.copy()
        rows, columns = self.unexplored.shape
        return cells.reshape(rows, scale, columns, scale).mean((1, 3))

    def _hide_explored(self, box: CellBox) -> None:
        """Renew `visible_scores` in a box of cells of the gist."""
        if self.visible_scores is self._scores:
            self.visible_scores = self._scores.copy()
        x1, y1, x2, y2 = box
        place = slice(y1, y2), slice(x1, x2)
        np.multiply(self._scores[place], self.unexplored[place][..., None], out=self.visible_scores[place])

    def pool(self, changed: CellBox) -> Iterator[_PooledWindows]:
        """Pool the visible hints of all windows that hold a changed cell of the gist, level by level."""
        if not self.windows:
            return
        places = [windows.holding(changed) for windows in self.windows.values()]
        # The largest windows, which come first, reach over the cells of all others.
        largest = next(iter(self.windows.values()))
        reach = largest.span - 1
        down, across = places[0]
        cells = self.visible_scores[down.start : down.stop + reach, across.start : across.stop + reach]
        spans = [windows.span for windows in self.windows.values()]
        pooled = pool_spans(torch.from_numpy(cells), spans)
        for (level, windows), place, (top, summary) in zip(self.windows.items(), places, pooled, strict=True):
            part = _counted_from(place, places[0])
            yield _PooledWindows(
                octaves=level - self.gist.level,
                scores=top[part].flatten(0, 1),
                summary=summary[part].flatten(0, 1),
                facts=windows.of(self.facts)[place],
                outdated=windows.of(self.outdated)[place],
            )

    def take_coarser_odds(self, odds: Mapping[int, Cells]) -> None:
        """Take the log odds by coarser looks, and mark the windows for which they have changed.

        Args:
            odds: by level, the log odds of all windows by the coarser looks, `(down, across)`; -inf where unknown.
        """
        for level, windows in self.windows.items():
            coarser = odds[level].take(windows.places)
            coarser[coarser == -np.inf] = _NO_COARSER_ODDS
            self.outdated[windows.rows] |= coarser != self.coarser_odds[windows.rows]
            self.coarser_odds[windows.rows] = coarser

    def write_odds(self, odds: Mapping[int, Cells]) -> None:
        """Write the odds of the windows over those of coarser looks.

        Args:
            odds: by level, the log odds of all windows, `(down, across)`; changed in place.
        """
        x, y = self.gist.first
        scale = self.gist.scale
        for level, windows in self.windows.items():
            values = windows.of(self.odds)
            if scale > 1:
                # A gist of large cells has no windows that start inside a cell: they get the odds before.
                values = values.repeat(scale, 0).repeat(scale, 1)
            place = odds[level][y : y + values.shape[0], x : x + values.shape[1]]
            place[:] = values[: place.shape[0], : place.shape[1]]


def _counted_from(place: Place, origin: Place) -> Place:
    """Count rows and columns from the first ones of another place."""
    rows, columns = place
    top = origin[0].start
    left = origin[1].start
    return slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)


class WindowOdds:
    r"""Log odds :math:`o_i(w) = f(u s_i, w, o_{i-1}(w))` that a look at each window shows a class.

    They are computed from the coarsest look on: :math:`s_i` are the hints of look i, u the share of each cell that is
    left to explore, and :math:`o_{i-1}` the odds by the looks that are coarser.

    Invariant: after `update` the odds are those of all gists and of the present shares. Between two calls, `changed`
    has the cells whose share may have changed, and gists beyond the first `len(_looks)` are not read yet.
    """

    def __init__(
        self, lattice: Lattice, evidence: GlimpseEvidence, target: int, gists: Sequence[Gist], unexplored: Cells
    ) -> None:
        """Prepare the odds.

        Args:
            lattice: the windows.
            evidence: the learned evidence.
            target: the class, from 1.
            gists: the looks; the owner appends later ones.
            unexplored: `(rows, columns)`, share of each cell that is left to explore; the owner changes it, and tells
                `mark` where.
        """
        self._lattice = lattice
        self._evidence = evidence
        self._target = target
        self._gists = gists
        self._unexplored = unexplored
        self._looks: list[_LookPredictions] = []  # by level, the coarsest first
        self._odds: dict[int, Cells] = {
            level: np.full(lattice.places(level)[::-1], -np.inf, np.float32) for level in range(1, lattice.levels)
        }
        self.changed: CellBox | None = None

    def mark(self, box: CellBox) -> None:
        """Note that the shares of the cells in a box may have changed.

        Args:
            box: the cells.
        """
        self.changed = enclosing(self.changed, box)

    @torch.no_grad()
    def update(self) -> Mapping[int, Cells]:
        """Compute the odds that have changed.

        Returns:
            By level, the log odds of all windows, `(down, across)`; -inf where unknown. The next call changes them.
        """
        new_looks = [_LookPredictions(gist, self._lattice) for gist in self._gists[len(self._looks) :]]
        # A look changes what closer ones start from, and a change in the shares concerns looks of all levels.
        changes = [(look.box, look.gist.level) for look in new_looks]
        if self.changed is not None:
            changes.append((self.changed, -1))
            self.changed = None
        if not changes:
            return self._odds
        # Coarse looks first: closer ones start from their odds, and write over them.
        self._looks = sorted(self._looks + new_looks, key=lambda look: look.gist.level)
        affected = [look for look in self._looks if look.is_new or _meets_coarser(look, changes)]
        self._renew_facts(affected)
        for odds in self._odds.values():
            odds.fill(-np.inf)
        for look in self._looks:
            if look in affected:
                self._renew_odds(look)
            look.write_odds(self._odds)
        return self._odds

    def _renew_facts(self, looks: Sequence[_LookPredictions]) -> None:
        """Compute the facts of the windows whose hints have changed, of all looks in one call of the network."""
        pooled: list[_PooledWindows] = []
        for look in looks:
            changed = look.explore(self._unexplored)
            if changed is not None:
                pooled += look.pool(changed)
        if not pooled:
            return
        counts = [len(windows.scores) for windows in pooled]
        scores = torch.cat([windows.scores for windows in pooled])
        summaries = torch.cat([windows.summary for windows in pooled])
        octaves = torch.from_numpy(np.repeat([windows.octaves for windows in pooled], counts))
        facts = self._evidence.hint_facts(scores, summaries, octaves, self._target)[:, 0].numpy()
        facts_by_look = np.split(facts, np.cumsum(counts)[:-1])
        for windows, values in zip(pooled, facts_by_look, strict=True):
            windows.facts[:] = values.reshape(windows.facts.shape)
            windows.outdated[:] = True

    def _renew_odds(self, look: _LookPredictions) -> None:
        """Compute the odds of a look's windows that are outdated; those of coarser looks are written already."""
        is_coarsest = look.gist.level == 0
        if not is_coarsest:
            look.take_coarser_odds(self._odds)
        rows = np.flatnonzero(look.outdated)
        if len(rows) == 0:
            return
        coarser_odds = None if is_coarsest else torch.from_numpy(look.coarser_odds[rows])
        look.odds[rows] = self._evidence.odds(torch.from_numpy(look.facts[rows]), coarser_odds).numpy()
        look.outdated[:] = False


def _meets_coarser(look: _LookPredictions, changes: Sequence[tuple[CellBox, int]]) -> bool:
    """Tell whether a look meets a change of a coarser level; changes have a box and a level each."""
    return any(level < look.gist.level and boxes_meet(look.box, box) for box, level in changes)
