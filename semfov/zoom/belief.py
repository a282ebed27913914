"""The belief about a large picture: what the looks so far predict that closer looks will show."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.data.scene import boxes_meet
from semfov.zoom.evidence import STEPS, GlimpseEvidence, PhotographEvidence, pool_spans
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook

Cells = NDArray[np.float32]

_Box = tuple[int, int, int, int]  # cells `(x1, y1, x2, y2)` of a lattice
_Place = tuple[slice, slice]  # rows and columns of an array


def _extent(marked: NDArray[np.bool_]) -> _Box:
    """Find the smallest box that contains all marked cells; marked `(rows, columns)`."""
    rows, columns = np.flatnonzero(marked.any(1)), np.flatnonzero(marked.any(0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


class _Table(NamedTuple):
    """The windows of a level that lie in a look; shape `(down, across)`, places `(down * across,)`."""

    span: int
    shape: tuple[int, int]
    rows: slice
    places: NDArray[np.intp]

    def of(self, values: NDArray[np.generic]) -> NDArray[np.generic]:
        """View of the rows of an array of the look that belong to these windows, `(down, across, ...)`."""
        return values[self.rows].reshape(*self.shape, *values.shape[1:])


class _Look:
    """A look and its predictions for N windows in it, of up to three closer levels; facts `(N, 6)`, others `(N,)`."""

    def __init__(self, gist: Gist, lattice: Lattice) -> None:
        self.gist = gist
        (x, y), scale, (rows, columns) = gist.first, gist.scale, gist.scores.shape[:2]
        self.box: _Box = (x, y, x + columns * scale, y + rows * scale)
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

    def pool(self, left: Cells) -> Iterator[tuple[int, Tensor, Tensor, NDArray[np.generic], NDArray[np.generic]]]:
        """Octaves, pooled scores `(n, K)` and summary `(n, 3)` of windows that have changed, and where facts go."""
        before, scale, (x1, y1, x2, y2), (rows, columns) = self.left, self.gist.scale, self.box, self.left.shape
        part = left[y1:y2, x1:x2]
        if part.shape != (y2 - y1, x2 - x1):
            part = np.pad(part, ((0, y2 - y1 - part.shape[0]), (0, x2 - x1 - part.shape[1])), constant_values=1)
        self.left = part.copy() if scale == 1 else part.reshape(rows, scale, columns, scale).mean((1, 3))
        if self.fresh:
            changed, self.fresh = (0, 0, before.shape[1], before.shape[0]), False
            differs = self.left != before
        else:
            differs = (self.gist.best.numpy() > 0) & (self.left != before)
            if not differs.any():
                return
            changed = _extent(differs)
        if differs.any():  # then the scores count less, by the share that is left
            if self.visible is self.scores:
                self.visible = self.scores.copy()
            x1, y1, x2, y2 = _extent(differs)
            here = slice(y1, y2), slice(x1, x2)
            np.multiply(self.scores[here], self.left[here][..., None], out=self.visible[here])
        if not self.tables:
            return
        x1, y1, x2, y2 = changed
        places = [  # of the windows that hold one of the changed cells
            (slice(max(y1 - span + 1, 0), min(y2, down)), slice(max(x1 - span + 1, 0), min(x2, across)))
            for span, (down, across), *_ in self.tables.values()
        ]
        # The largest windows, which come first, reach over the cells of all others.
        (below, beside), reach = places[0], next(iter(self.tables.values())).span - 1
        cells = self.visible[below.start : below.stop + reach, beside.start : beside.stop + reach]
        pools = pool_spans(torch.from_numpy(cells), [table.span for table in self.tables.values()])
        for (level, table), (down, across), maps in zip(self.tables.items(), places, pools, strict=True):
            at = tuple(
                slice(here.start - start, here.stop - start)
                for here, start in ((down, below.start), (across, beside.start))
            )
            top, summary = (values[at].flatten(0, 1) for values in maps)
            facts, stale = (table.of(values)[down, across] for values in (self.facts, self.stale))
            yield level - self.gist.level, top, summary, facts, stale


class _WindowOdds:
    """Log odds that a look at each window shows a class, o_i(w) = f(u s_i, w, o_{i-1}(w)) from the coarsest look on."""

    def __init__(
        self, lattice: Lattice, evidence: GlimpseEvidence, target: int, gists: Sequence[Gist], left: Cells
    ) -> None:
        self._lattice, self._evidence, self._target = lattice, evidence, target
        self._gists, self._left = gists, left
        self._looks: list[_Look] = []
        self._odds: dict[int, Cells] = {
            level: np.full(lattice.places(level)[::-1], -np.inf, np.float32) for level in range(1, lattice.levels)
        }
        self.changed: _Box | None = None

    @torch.no_grad()
    def update(self) -> Mapping[int, Cells]:
        """Log odds of the windows of each level, `(down, across)`; -inf where unknown. The next call changes them."""
        fresh = [_Look(gist, self._lattice) for gist in self._gists[len(self._looks) :]]
        # A look changes what closer ones start from, and a change in what is left to see concerns looks of all levels.
        changed = [(look.box, look.gist.level) for look in fresh]
        if self.changed is not None:
            changed.append((self.changed, -1))
            self.changed = None
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
                # The predictions of a look stand over those of coarser ones.
                (x, y), scale = look.gist.first, look.gist.scale
                for level, table in look.tables.items():
                    values = table.of(look.odds)
                    if scale > 1:
                        # A gist of large cells has no windows that start inside a cell: they get the odds before.
                        values = values.repeat(scale, 0).repeat(scale, 1)
                    place = self._odds[level][y : y + values.shape[0], x : x + values.shape[1]]
                    place[:] = values[: place.shape[0], : place.shape[1]]
        return self._odds

    def _read(self, looks: Sequence[_Look]) -> None:
        """Compute the facts of the windows whose hints have changed, of all looks in one call of the network."""
        pools = [pool for look in looks for pool in look.pool(self._left)]
        if not pools:
            return
        octaves, scores, summaries, facts, stale = zip(*pools, strict=True)
        counts = [len(each) for each in scores]
        steps = torch.from_numpy(np.repeat(octaves, counts))
        found = self._evidence.hint_facts(torch.cat(scores), torch.cat(summaries), steps, self._target)[:, 0].numpy()
        for into, marks, values in zip(facts, stale, np.split(found, np.cumsum(counts)[:-1]), strict=True):
            into[:] = values.reshape(into.shape)
            marks[:] = True

    def _judge(self, look: _Look) -> None:
        """Compute the log odds of the windows of a look for which the facts or the log odds before have changed."""
        coarsest = look.gist.level == 0
        for level, table in () if coarsest else look.tables.items():
            coarser = self._odds[level].take(table.places)
            coarser[coarser == -np.inf] = -4.0  # where no earlier look gave any
            look.stale[table.rows] |= coarser != look.before[table.rows]
            look.before[table.rows] = coarser
        rows = look.stale.nonzero()[0]
        if len(rows):
            before = None if coarsest else torch.from_numpy(look.before[rows])
            look.odds[rows] = self._evidence.odds(torch.from_numpy(look.facts[rows]), before).numpy()
            look.stale[:] = False


_SLIVER = 0.25
"""Share of a window: where less is not blank, little counts as little, and the edge of a scan takes no look."""


class Rates(Protocol):
    """Predicts how many objects closer looks find, such as `GlimpseEvidence` and `Survey`."""

    foresight: float
    """Share of what still closer looks would find in a window that counts towards its value."""

    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor: ...

    def taper(self, span: int) -> Tensor: ...


class _WindowSums:
    """Weighted sums of the cells of every window, by banded matrices, renewed where cells change; weight `(span,)`."""

    def __init__(self, weight: Cells, shape: tuple[int, int], cells: Callable[[_Place], Cells]) -> None:
        self._span, self._cells = len(weight), cells
        places = np.arange(max(max(n - self._span, 0) + 1 for n in shape))
        self._band = np.zeros((len(places) + self._span - 1, len(places)), np.float32)
        self._band[places + np.arange(self._span)[:, None], places] = weight[:, None]
        self._sums = np.zeros([max(n - self._span, 0) + 1 for n in shape], np.float32)
        self.changed: _Box | None = (0, 0, shape[1], shape[0])

    def update(self) -> Cells:
        """Sum the cells of every window, `(down, across)`; the next call changes the result."""
        if self.changed is None:
            return self._sums
        (x1, y1, x2, y2), self.changed = self.changed, None
        reach = self._span - 1
        top, left = max(y1 - reach, 0), max(x1 - reach, 0)
        bottom, right = min(y2, self._sums.shape[0]), min(x2, self._sums.shape[1])
        part = self._cells((slice(top, bottom + reach), slice(left, right + reach)))
        down, across = self._band[: part.shape[0], : bottom - top], self._band[: part.shape[1], : right - left]
        # NumPy would start threads for large pictures, and they would wait at full load for the next product.
        lines = torch.from_numpy(part) @ torch.from_numpy(across)
        self._sums[top:bottom, left:right] = (torch.from_numpy(down).mT @ lines).numpy()
        return self._sums


_EVERYWHERE: _Place = (slice(None), slice(None))


class ZoomBelief:
    r"""What looks at any window are expected to show, for one class; source, left and blank `(rows, columns)`.

    A look of level k is expected to find :math:`n_k(x) = u(x) \, \lambda_{k - s(x)}(x)` objects centred in a cell, by
    the rates of the closest look at it, of level s(x). u(x) is 0 once nothing is left to see in it. What is known of
    windows is kept, and computed anew where cells have changed.
    """

    def __init__(
        self, lattice: Lattice, evidence: Rates, target: int, blank: Callable[[], Tensor | None] = lambda: None
    ) -> None:
        self.lattice, self.target, self._blank = lattice, target, blank
        self._areas: dict[int, Cells] = {}
        self._evidence = evidence
        self._rates: Rates = evidence.survey if target == 0 and isinstance(evidence, GlimpseEvidence) else evidence
        self.foresight, self._targets = self._rates.foresight, torch.tensor([target])
        self.clear()

    def clear(self) -> None:
        shape = self.lattice.rows, self.lattice.columns
        self._rate = np.zeros((self.lattice.levels, *shape), np.float32)
        # The level that the rates of a cell are from. Rates are predicted when they are asked for.
        self._rated = np.full(shape, -1, np.int8)
        self._predicted = 0
        self.source = torch.full(shape, -1)
        self.__dict__.pop("left", None)
        self.gists: list[Gist] = []
        self._sums: dict[tuple[int, int], _WindowSums] = {}
        self._odds: _WindowOdds | None = None

    @cached_property
    def there(self) -> Tensor:
        """Share of each cell where there is something to see, asked for after the overview, `(rows, columns)`."""
        blank = self._blank()
        return torch.ones(self.lattice.rows, self.lattice.columns) if blank is None else 1 - blank.float()

    @cached_property
    def left(self) -> Tensor:
        """Share of each cell that is left to see, `(rows, columns)`."""
        return self.there.clone()

    @property
    def evidence(self) -> GlimpseEvidence:
        """The learned evidence; only searches ask for it."""
        assert isinstance(self._evidence, GlimpseEvidence), "searches go by learned evidence"
        return self._evidence

    @property
    def photograph(self) -> PhotographEvidence | None:
        """The evidence for photographs, where the picture is one: nothing in it can be looked at an octave closer."""
        return self.evidence.photograph if self.lattice.levels == 1 else None

    def restore(self, left: Tensor) -> None:
        """Set back what is left to see, to undo `discount`; left `(rows, columns)`."""
        before, now = left.numpy(), self.left.numpy()
        differs = before != now
        if differs.any():
            np.copyto(now, before)
            self._mark(_extent(differs))

    def add(self, window_look: WindowLook) -> None:
        if window_look.gist is None:
            self.discount(window_look.window)
            return
        look, source = window_look.gist, self.source.numpy()
        self.gists.append(look)
        x1, y1, x2, y2 = box = self._box(look)
        np.maximum(source[y1:y2, x1:x2], look.level, out=source[y1:y2, x1:x2])
        self._mark(box, left=False)

    def discount(self, window: Window) -> None:
        """Expect nothing more inside a window and at its borders, where a second look finds less than one elsewhere."""
        x1, y1, x2, y2 = window.cells
        x1, y1, x2, y2 = max(x1, 0), max(y1, 0), min(x2, self.lattice.columns), min(y2, self.lattice.rows)
        if x1 < x2 and y1 < y2:
            part = self.left.numpy()[y1:y2, x1:x2]
            if part.any():
                part[:] = 0
                self._mark((x1, y1, x2, y2))

    def _mark(self, box: _Box, *, left: bool = True) -> None:
        """Mark stored values of windows as outdated where cells, or the share of them that is left, changed."""
        stored: list[_WindowSums | _WindowOdds] = [*self._sums.values()]
        for each in [*stored, self._odds] if left and self._odds is not None else stored:
            other = each.changed or box
            each.changed = min(box[0], other[0]), min(box[1], other[1]), max(box[2], other[2]), max(box[3], other[3])

    def _box(self, look: Gist) -> _Box:
        """The cells that a look shows."""
        (x, y), (rows, columns) = look.first, look.scores.shape[:2]
        return x, y, min(x + columns * look.scale, self.lattice.columns), min(y + rows * look.scale, self.lattice.rows)

    @torch.no_grad()
    def _predict(self) -> None:
        """Write the rates of new looks to the cells that were not looked at as closely before."""
        new, self._predicted = self.gists[self._predicted :], len(self.gists)
        for look in new:
            x1, y1, x2, y2 = self._box(look)
            at = slice(y1, y2), slice(x1, x2)
            rate, rated = self._rate[:, *at], self._rated[at]
            before = None
            if look.level > 0:
                # Rates of looks that are coarser by more than three octaves are those for three.
                level = rated + 1 + (look.level - rated).clip(0, STEPS - 1)
                before = before_of(np.choose(level, rate), look)[None]
            cells = self._rates.rates(look, self._targets, before)[0].exp().numpy()
            if look.scale > 1:
                cells = cells.repeat(look.scale, -1).repeat(look.scale, -2)[:, : y2 - y1, : x2 - x1] / look.scale**2
            newer = rated < look.level
            for level, values in enumerate(rate):
                step = level - look.level - 1
                np.copyto(values, cells[step] if 0 <= step < STEPS else 0, where=newer)
            rated[newer] = look.level

    def remaining(self) -> tuple[float, float]:
        """Number of objects that looks are still expected to find: in each cell those of the level that finds most."""
        levels = range(1, self.lattice.levels)
        if not levels:
            return 0.0, 0.0
        expected = np.maximum.reduce([self.expected(level) for level in levels])
        clear = float(expected[expected >= 0.1].sum())  # of cells that clearly promise an object
        return clear, float(expected.sum()) - clear

    def expected(self, level: int, at: _Place = _EVERYWHERE) -> Cells:
        """Number of objects that looks of a level are expected to find in each cell, in some rows and columns."""
        self._predict()
        return self._rate[level, *at] * self.left.numpy()[at]

    def value(self, level: int, foresight: float) -> Cells:
        """Value of each window of a level for finding objects (`semfov.zoom.policy.best_find`); → `(down, across)`."""
        values = self._sum(level, 1)
        if not foresight or level + 1 >= self.lattice.levels:
            return values
        return values + np.float32(foresight) * self._sum(level, 2)

    def unseen(self, level: int) -> Cells:
        """Share of each window of a level that no look has shown at that level or closer, `(down, across)`."""
        if level not in self._areas:
            there, ones = self.there.numpy(), np.ones(self.lattice.span(level), np.float32)
            whole = min(len(ones), self.lattice.rows) * min(len(ones), self.lattice.columns)
            self._areas[level] = _WindowSums(ones, there.shape, there.__getitem__).update().clip(_SLIVER * whole)
        return self._sum(level, 0) / self._areas[level]

    def _sum(self, level: int, octaves: int) -> Cells:
        """Sums over the windows of a level; → `(down, across)`."""
        if (level, octaves) not in self._sums:
            source = self.source.numpy()  # where it is below a level, no look has shown a cell at it or closer
            cells: Callable[[_Place], Cells] = (
                lambda at: self.left.numpy()[at] * (source[at] < level),
                lambda at: self.expected(level, at),
                lambda at: self.expected(level + 1, at) * (source[at] < level),
            )[octaves]
            span = self.lattice.span(level)
            weight = self._rates.taper(span).detach().numpy() if octaves == 1 else np.ones(span, np.float32)
            self._sums[level, octaves] = _WindowSums(weight, (self.lattice.rows, self.lattice.columns), cells)
        return self._sums[level, octaves].update()

    def chances(self, level: int) -> Cells:
        """Probability that a look at each window shows the class, times the share that no closer look has shown."""
        return torch.from_numpy(self._level_odds(level)).sigmoid().numpy() * self.unseen(level)

    def _level_odds(self, level: int) -> Cells:
        """Log odds that a look at each window of a level shows the class, `(down, across)`; -inf where unknown."""
        if self._odds is None:
            self._odds = _WindowOdds(self.lattice, self.evidence, self.target, self.gists, self.left.numpy())
        return self._odds.update()[level]


def before_of(rate: Cells, look: Gist) -> Tensor:
    """Logarithms of the rates `(rows, columns)` of earlier looks in a look's cells, one octave closer than the look."""
    before = torch.from_numpy(rate)
    rows, columns = look.scores.shape[:2]
    if look.scale > 1:
        before = F.pad(before, (0, columns * look.scale - before.shape[1], 0, rows * look.scale - before.shape[0]))
        before = F.avg_pool2d(before[None], look.scale)[0] * look.scale**2
    return (before + 1e-6).log()
