"""What looks at a picture say of where closer looks pay."""

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.zoom.context import WindowContext
from semfov.zoom.evidence import STEPS, GlimpseEvidence, pool, pool_all
from semfov.zoom.gist import Gist
from semfov.zoom.glances import Glance, Window
from semfov.zoom.lattice import Lattice


class Rates(Protocol):
    """What tells how many objects closer looks find: `GlimpseEvidence`, or `semfov.zoom.observed.ObservedRates`."""

    @property
    def foresight(self) -> float:
        """Share of what still closer looks would find in a window that counts towards its value."""
        ...

    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor:
        """See `GlimpseEvidence.rates`."""
        ...

    def taper(self, span: int) -> Tensor:
        """See `GlimpseEvidence.taper`."""
        ...


@dataclass(frozen=True)
class _Table:
    """What a look says of the windows of a level, and what that was computed from.

    Attributes:
        left: `(rows, columns)`, what was left to see in the cells of the look.
        pooled: `(N, K)`, strongest hints in each window.
        summary: `(N, 3)`, of all hints in it.
        before: `(N, 1)`, what looks from farther off said.
        odds: `(N,)`.
        changes: that were known of.
    """

    left: Tensor
    pooled: Tensor
    summary: Tensor
    before: Tensor | None
    odds: Tensor
    changes: int


class ZoomBelief:
    """What is expected of every window of a picture, for one class.

    A cell goes by the closest look at it. It keeps five numbers, 24 bytes: the level of that look, how many objects
    centred in it are expected to be found one, two and three octaves closer, and what is left to see in it. All classes
    are kept for looked-at windows alone, at most 32 × 32 cells of each. A picture of 20,000 × 15,000 px has 49,152
    cells: 1.2 MB, and for 80 classes at most 0.41 MB for each look.

    Args:
        lattice: of the picture.
        evidence: learned, by magnification. What tells rates alone is enough to look for all objects.
        target: class 1..K, or 0 for any.
        context: what is added to the odds of a class for what windows show of others; None adds nothing.
    """

    def __init__(self, lattice: Lattice, evidence: Rates, target: int, context: WindowContext | None = None) -> None:
        self.lattice, self.target, self.context = lattice, target, context
        self._rates = evidence
        shape = lattice.rows, lattice.columns
        self.rate = torch.zeros(STEPS, *shape)
        self.source = torch.full(shape, -1)
        self.left = torch.ones(shape)
        self.gists: list[Gist] = []
        self._odds: dict[int, Tensor] = {}
        self._changes: list[tuple[int, int, int, int]] = []
        self._tables: dict[tuple[int, tuple[int, int], int], _Table] = {}
        self._told: dict[Window, float] = {}

    @property
    def evidence(self) -> GlimpseEvidence:
        """Learned evidence."""
        assert isinstance(self._rates, GlimpseEvidence), "searches go by learned evidence"
        return self._rates

    def restore(self, left: Tensor) -> None:
        """Go back to what was left to see before windows were discounted."""
        rows, columns = ((left != self.left).any(axis).nonzero()[:, 0] for axis in (1, 0))
        if len(rows):
            self._touch(int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1)
        self.left = left

    def _touch(self, x1: int, y1: int, x2: int, y2: int) -> None:
        """Something has changed in these cells."""
        self._odds.clear()
        self._changes.append((x1, y1, x2, y2))

    def add(self, glance: Glance) -> None:
        """Take account of a look."""
        window, look = glance.window, glance.gist
        if look is not None:
            self._spread(look)
            self.gists.append(look)
            self._told.clear()
            self._touch(*window.cells)
        else:
            self.discount(window)

    def discount(self, window: Window) -> None:
        """Expect no more of what a window shows: it was looked at, or is about to be.

        That holds to its borders. What they cut is centred in the next window as often as in this one, and windows that
        look at borders again find less than windows where nobody looked.
        """
        x1, y1, x2, y2 = window.cells
        self.left[max(y1, 0) : max(y2, 0), max(x1, 0) : max(x2, 0)] = 0
        self._touch(x1, y1, x2, y2)

    def _spread(self, look: Gist) -> None:
        """Rates of a look on the cells that were not looked at as closely before."""
        rows = min(look.scores.shape[0] * look.scale, self.lattice.rows - look.first[1])
        columns = min(look.scores.shape[1] * look.scale, self.lattice.columns - look.first[0])
        at = (slice(look.first[1], look.first[1] + rows), slice(look.first[0], look.first[0] + columns))
        before = None
        if look.level > 0:
            before = before_of(self.rate[:, *at], self.source[at], look)
        with torch.no_grad():
            logs = self._rates.rates(look, torch.tensor([self.target]), None if before is None else before[None])[0]
        cells = logs.exp() / look.scale**2
        cells = cells.repeat_interleave(look.scale, -1).repeat_interleave(look.scale, -2)[:, :rows, :columns]
        newer = self.source[at] < look.level
        self.rate[:, *at] = torch.where(newer, cells, self.rate[:, *at])
        self.source[at] = torch.where(newer, look.level, self.source[at])

    def expected(self, level: int) -> Tensor:
        """Objects that looks of a level are expected to find, cell by cell, `(rows, columns)`."""
        steps = level - self.source
        told = self.rate.gather(0, (steps - 1).clamp(0, STEPS - 1)[None])[0]
        return told * (steps >= 1) * (steps <= STEPS) * self.left

    def finds(self, level: int) -> Tensor:
        """Objects that each window of a level is expected to find, `(down, across)`."""
        span = self.lattice.span(level)
        weight = self._rates.taper(span).detach()
        image = self.expected(level)[None, None]
        wide, high = (max(span - n, 0) for n in (self.lattice.columns, self.lattice.rows))
        image = F.pad(image, (0, wide, 0, high))
        across = F.conv2d(image, weight[None, None, None])
        return F.conv2d(across, weight[None, None, :, None])[0, 0]

    def odds(self, level: int) -> Tensor:
        """Log odds that each window of a level shows the class, `(down, across)`; -inf where nothing is known."""
        if level in self._odds:
            return self._odds[level]
        across, down = self.lattice.places(level)
        result = torch.full((down, across), -torch.inf)
        for look in sorted(self.gists, key=lambda gist: gist.level):
            steps, span = level - look.level, self.lattice.span(level) // look.scale
            if not 1 <= steps <= STEPS or span < 1:
                continue
            left, top = look.first
            shape = look.scores.shape[:2]
            high, wide = (max(n - span, 0) + 1 for n in shape)
            # Windows between the places that a coarse look tells go by the place before them.
            there = slice(top, top + high * look.scale), slice(left, left + wide * look.scale)
            kept = self._tables.get((look.level, look.first, level))
            if kept is None or self._touched(look, kept.changes):
                known = result[there][:: look.scale, :: look.scale]
                before = None if look.level == 0 else known.reshape(-1, 1).nan_to_num(neginf=-4.0)
                kept = self._tell(look, level, before, kept)
                self._tables[look.level, look.first, level] = kept
            table = kept.odds.view(high, wide)
            if look.scale > 1:
                table = table.repeat_interleave(look.scale, 0).repeat_interleave(look.scale, 1)
                table = table[: down - top, : across - left]
            result[there] = table
        self._odds[level] = result
        return result

    def _touched(self, look: Gist, since: int) -> bool:
        """Whether something has changed in the cells of a look, after so many changes."""
        left, top = look.first
        bottom, right = (n * look.scale + low for n, low in zip(look.scores.shape[:2], (top, left), strict=True))
        return any(x1 < right and y1 < bottom and x2 > left and y2 > top for x1, y1, x2, y2 in self._changes[since:])

    @torch.no_grad()
    def _tell(self, look: Gist, level: int, before: Tensor | None, kept: _Table | None) -> _Table:
        """What a look says of all windows of a level in it; anew only of those in which something changed."""
        part, span = self._left_of(look), self.lattice.span(level) // look.scale
        steps, changes = torch.tensor([level - look.level]), len(self._changes)
        if kept is None:
            pooled, summary = pool_all(look.scores * part[..., None], span)
            odds = self._presence(pooled, summary, steps.expand(len(pooled)), before)
            return _Table(part, pooled, summary, before, odds, changes)
        pooled, summary, odds = kept.pooled, kept.summary, kept.odds
        stale = torch.zeros(len(odds), dtype=torch.bool)
        changed = part != kept.left
        if bool(changed.any()):
            high, wide = (max(n - span, 0) + 1 for n in part.shape)
            rows, columns = _reach(changed.any(1), span, high), _reach(changed.any(0), span, wide)
            here = slice(rows.start, rows.stop + span - 1), slice(columns.start, columns.stop + span - 1)
            best, crowd = pool_all((look.scores * part[..., None])[here], span)
            shape = rows.stop - rows.start, columns.stop - columns.start
            for whole, new in ((pooled, best), (summary, crowd)):
                whole.view(high, wide, -1)[rows, columns] = new.reshape(*shape, -1)
            stale.view(high, wide)[rows, columns] = True
        if before is not None and kept.before is not None:
            stale |= (before != kept.before)[:, 0]
        if bool(stale.any()):
            some = None if before is None else before[stale]
            times = steps.expand(int(stale.sum()))
            odds[stale] = self._presence(pooled[stale], summary[stale], times, some)
        return _Table(part, pooled, summary, before, odds, changes)

    def _presence(self, pooled: Tensor, summary: Tensor, steps: Tensor, before: Tensor | None) -> Tensor:
        """Log odds of the evidence (`GlimpseEvidence.presence`), with those of the context."""
        odds = self.evidence.presence(pooled, summary, steps, self.target, before)
        return odds if self.context is None else odds + self.context(pooled, self.target)

    def _left_of(self, look: Gist) -> Tensor:
        """What is left to see in the cells of a look, `(rows, columns)`: 0 where they were looked at closely."""
        rows, columns = look.scores.shape[:2]
        high, wide = rows * look.scale, columns * look.scale
        part = self.left[look.first[1] : look.first[1] + high, look.first[0] : look.first[0] + wide]
        part = F.pad(part[None, None], (0, wide - part.shape[1], 0, high - part.shape[0]), value=1.0)
        return F.avg_pool2d(part, look.scale)[0, 0]

    def odds_of(self, window: Window) -> float:
        """Log odds that a window shows the class, which need not be one of the lattice."""
        if window in self._told:
            return self._told[window]
        value: Tensor | None = None
        for look in sorted(self.gists, key=lambda gist: gist.level):
            steps = window.level - look.level
            x1, y1, x2, y2 = window.cells
            left, top = look.first
            inside = x1 >= left and y1 >= top and x2 <= left + look.scores.shape[1] * look.scale
            inside = inside and y2 <= top + look.scores.shape[0] * look.scale
            if not (inside or look.level == 0) or not 1 <= steps <= STEPS:
                continue
            box = (
                (x1 - left) // look.scale,
                (y1 - top) // look.scale,
                max(-(-(x2 - left) // look.scale), (x1 - left) // look.scale + 1),
                max(-(-(y2 - top) // look.scale), (y1 - top) // look.scale + 1),
            )
            pooled, summary = pool(look.scores, box)
            with torch.no_grad():
                known = None if value is None or look.level == 0 else value.view(1, 1)
                value = self._presence(pooled[None], summary[None], torch.tensor([steps]), known)
        self._told[window] = float("-inf") if value is None else float(value)
        return self._told[window]


def _reach(changed: Tensor, span: int, most: int) -> slice:
    """Which of `most` places along a line hold a changed cell, each `span` cells wide."""
    places = changed.nonzero()[:, 0]
    return slice(max(int(places[0]) - span + 1, 0), min(int(places[-1]) + 1, most))


def before_of(rate: Tensor, source: Tensor, look: Gist) -> Tensor:
    """Logarithm of the rates that were expected of looks one octave closer than a look, in its cells.

    Args:
        rate: `(3, rows, columns)` of the lattice's cells that the look shows.
        source: `(rows, columns)`, level of the look that told each.
        look: the new look.
    """
    steps = (look.level + 1 - source).clamp(1, STEPS)
    told = rate.gather(0, (steps - 1)[None])[0]
    rows, columns = look.scores.shape[:2]
    told = F.pad(told[None, None], (0, columns * look.scale - told.shape[1], 0, rows * look.scale - told.shape[0]))
    return (F.avg_pool2d(told, look.scale)[0, 0] * look.scale**2 + 1e-6).log()
