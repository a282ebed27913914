"""Belief about a large picture: what looks at it predict for closer looks."""

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.zoom.evidence import GlimpseEvidence, pool
from semfov.zoom.gist import Gist
from semfov.zoom.glances import Glance, Window
from semfov.zoom.lattice import Lattice
from semfov.zoom.networks import STEPS
from semfov.zoom.odds import WindowOdds
from semfov.zoom.sums import Box, Cells, WindowSums, extent


class Rates(Protocol):
    """Predicts how many objects closer looks find: `GlimpseEvidence`, `Survey` or `ObservedRates`."""

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


class ZoomBelief:
    """What looks at any window of a picture are expected to show, for one class.

    Each cell is predicted from the closest look at it. The belief keeps six numbers for a cell: the level of that look,
    the share of the cell that is left to see, the number of objects centred in the cell that looks one, two and three
    octaves closer are expected to find, and the level that these are from: they are predicted when they are asked for.
    With two zeros for levels without a prediction these are 33 bytes.
    Hints of all classes are kept for the windows that were looked at, at most 32 × 32 cells of each. A picture of
    20,000 × 15,000 px has 49,152 cells: 1.6 MB, and for 80 classes at most 0.41 MB for each look. Searches also keep
    the hints of each look that are left to see and what they predict for its windows, at most 0.41 MB.

    Args:
        lattice: lattice of the picture.
        evidence: learned evidence. An explorer that looks for all objects needs its rates alone.
        target: class 1..K, or 0 for any.

    Attributes:
        source: `(rows, columns)`, level of the closest look at each cell that has closer ones; -1 for none.
        left: `(rows, columns)`, share of each cell that is left to see, 0 or 1.
        gists: gists of the looks so far.
    """

    def __init__(self, lattice: Lattice, evidence: Rates, target: int) -> None:
        self.lattice, self.target = lattice, target
        self._evidence = evidence
        self._rates: Rates = evidence.survey if target == 0 and isinstance(evidence, GlimpseEvidence) else evidence
        self._targets = torch.tensor([target])
        shape = lattice.rows, lattice.columns
        # Rates of cells that a level is not one to three octaves closer to are 0: the first plane and the last one.
        self._planes = np.zeros((STEPS + 2, *shape), np.float32)
        # The level that the rates of a cell are from. Searches for one object ask for none.
        self._rated = np.full(shape, -1, np.int8)
        self._predicted = 0
        self.source = torch.full(shape, -1)
        self.left = torch.ones(shape)
        self.gists: list[Gist] = []
        self._changes: list[Box] = [(0, 0, lattice.columns, lattice.rows)]
        self._summed: dict[tuple[int, int], int] = {}
        self._expected: dict[int, Cells] = {}
        self._sums: dict[tuple[int, int], WindowSums] = {}
        self._odds: WindowOdds | None = None
        self._judged = 0
        self._told: dict[Window, float] = {}

    @property
    def evidence(self) -> GlimpseEvidence:
        """The learned evidence; only searches ask for it."""
        assert isinstance(self._evidence, GlimpseEvidence), "searches go by learned evidence"
        return self._evidence

    @property
    def foresight(self) -> float:
        """Share of what still closer looks would find in a window that counts towards its value."""
        return self._rates.foresight

    def restore(self, left: Tensor) -> None:
        """Set back what is left to see, to undo `discount`.

        Args:
            left: `(rows, columns)`, a copy of `left` from before.
        """
        before, now = left.numpy(), self.left.numpy()
        differs = before != now
        if differs.any():
            np.copyto(now, before)
            box = extent(differs)
            self._renew(box)
            self._changes.append(box)

    def add(self, glance: Glance) -> None:
        """Update the belief with the result of a look."""
        if glance.gist is None:
            self.discount(glance.window)
            return
        look, source = glance.gist, self.source.numpy()
        self.gists.append(look)
        self._told.clear()
        x1, y1, x2, y2 = box = self._box(look)
        np.maximum(source[y1:y2, x1:x2], look.level, out=source[y1:y2, x1:x2])
        self._changes.append(box)

    def discount(self, window: Window) -> None:
        """Expect nothing more inside a window, because it was looked at as closely as possible, or is about to be.

        This includes the cells at its borders. Objects that a border cuts are centred in the next window as often as in
        this one, and looking at borders again finds less than looking elsewhere.
        """
        x1, y1, x2, y2 = window.cells
        x1, y1, x2, y2 = max(x1, 0), max(y1, 0), min(x2, self.lattice.columns), min(y2, self.lattice.rows)
        if x1 < x2 and y1 < y2:
            for cells in (self.left.numpy(), *self._expected.values()):
                cells[y1:y2, x1:x2] = 0
            self._changes.append((x1, y1, x2, y2))

    @property
    def rate(self) -> Tensor:
        """Expected objects centred in each cell, for looks one to three octaves closer, `(3, rows, columns)`."""
        self._predict()
        return torch.from_numpy(self._planes[1:-1])

    def _box(self, look: Gist) -> Box:
        """The cells that a look shows."""
        (x, y), (rows, columns) = look.first, look.scores.shape[:2]
        return x, y, min(x + columns * look.scale, self.lattice.columns), min(y + rows * look.scale, self.lattice.rows)

    @torch.no_grad()
    def _predict(self) -> None:
        """Write the rates of new looks to the cells that were not looked at as closely before."""
        new, self._predicted = self.gists[self._predicted :], len(self.gists)
        for look in new:
            x1, y1, x2, y2 = box = self._box(look)
            at = slice(y1, y2), slice(x1, x2)
            rate, rated = self._planes[1:-1, *at], self._rated[at]
            before = before_of(rate, rated, look)[None] if look.level > 0 else None
            cells = self._rates.rates(look, self._targets, before)[0].exp().numpy()
            if look.scale > 1:
                cells = cells.repeat(look.scale, -1).repeat(look.scale, -2)[:, : y2 - y1, : x2 - x1] / look.scale**2
            newer = rated < look.level
            np.copyto(rate, cells, where=newer)
            rated[newer] = look.level
            self._renew(box)

    def expected(self, level: int) -> Tensor:
        """Number of objects that looks of a level are expected to find in each cell, `(rows, columns)`."""
        return torch.from_numpy(self._expect(level).copy())

    def _expect(self, level: int) -> Cells:
        """`expected`, not to be written to."""
        self._predict()
        if level not in self._expected:
            self._expected[level] = self._compute(level, (slice(None), slice(None)))
        return self._expected[level]

    def _compute(self, level: int, at: tuple[slice, slice]) -> Cells:
        """`expected` in some rows and columns."""
        told: Cells = np.choose(level - self._rated[at], self._planes[:, *at], mode="clip")
        return told * self.left.numpy()[at]

    def _renew(self, changed: Box) -> None:
        """Compute what is expected anew in cells that have changed."""
        x1, y1, x2, y2 = changed
        at = slice(y1, y2), slice(x1, x2)
        for level, cells in self._expected.items():
            cells[at] = self._compute(level, at)

    def finds(self, level: int) -> Tensor:
        """Number of objects that a look at each window of a level is expected to find, `(down, across)`."""
        return torch.from_numpy(self._sum(level, 1).copy())

    def value(self, level: int, foresight: float) -> Cells:
        """Value of each window of a level for finding objects (`semfov.zoom.policy.best_find`).

        Args:
            level: level of the windows.
            foresight: κ.

        Returns:
            `(down, across)`, not to be written to.
        """
        values = self._sum(level, 1)
        if not foresight or level + 1 >= self.lattice.levels:
            return values
        return values + np.float32(foresight) * self._sum(level, 2)

    def unseen(self, level: int) -> Cells:
        """Share of each window of a level that no look has shown at that level or closer, `(down, across)`."""
        span = self.lattice.span(level)
        whole = min(span, self.lattice.rows) * min(span, self.lattice.columns)
        return self._sum(level, 0) / np.float32(whole)

    def _sum(self, level: int, octaves: int) -> Cells:
        """Sums over the windows of a level.

        Args:
            level: the level.
            octaves: 0 for the cells that no look has shown at that level or closer; 1 for `finds`; 2 for the finds of
                looks one octave closer, in cells not looked at from the level yet.

        Returns:
            `(down, across)`, not to be written to.
        """
        if (level, octaves) not in self._sums:
            span = self.lattice.span(level)
            weight = self._rates.taper(span).detach().numpy() if octaves == 1 else np.ones(span, np.float32)
            self._sums[level, octaves] = WindowSums(weight, (self.lattice.rows, self.lattice.columns))
        sums, changes = self._sums[level, octaves], self._changes[self._summed.get((level, octaves), 0) :]
        if not changes:
            return sums.sums
        self._summed[level, octaves] = len(self._changes)
        x1, y1, x2, y2 = zip(*changes, strict=True)
        changed = min(x1), min(y1), max(x2), max(y2)
        if octaves == 1:
            return sums.update(self._expect(level), changed)
        cells = self.left.numpy() if octaves == 0 else self._expect(level + 1)
        return sums.update(cells * (self.source.numpy() < level), changed)

    def odds(self, level: int) -> Tensor:
        """Log odds that a look at each window of a level shows the class, `(down, across)`; -inf where unknown."""
        return torch.from_numpy(self._shown().odds(level).copy())

    def chances(self, level: int) -> Cells:
        r"""Probability that a look at each window of a level shows the class, and no look at the same place did.

        Looks at a part of a window, from its level or closer, have not shown the class there. If they covered all of
        the window but the share u (`unseen`), the evidence P counts only for that share, as if the object could be
        anywhere in the window:

        .. math:: p(w) = u(w) \, P(w)

        Args:
            level: level of the windows.

        Returns:
            `(down, across)`.
        """
        return self._shown().chances(level) * self.unseen(level)

    def _shown(self) -> WindowOdds:
        if self._odds is None:
            self._odds = WindowOdds(self.lattice, self.evidence, self.target)
        if self._judged < len(self._changes):
            self._odds.update(self.gists, self.left.numpy())
            self._judged = len(self._changes)
        return self._odds

    def odds_of(self, window: Window) -> float:
        """Log odds that a look at a window shows the class; the window need not lie on the lattice."""
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
                known = None if value is None or look.level == 0 else value
                value = self.evidence.presence(pooled[None], summary[None], torch.tensor([steps]), self.target, known)
        self._told[window] = float("-inf") if value is None else float(value)
        return self._told[window]


def before_of(rate: Cells, source: NDArray[np.integer[Any]], look: Gist) -> Tensor:
    """Logarithms of the rates that earlier looks gave, in the cells of a look, for looks one octave closer than it.

    Args:
        rate: `(3, rows, columns)`, rates of the lattice cells that the look shows.
        source: `(rows, columns)`, level of the look that gave the rates of each cell.
        look: the new look.

    Returns:
        `(rows, columns)` of the gist.
    """
    # NumPy, because a call of torch takes longer than the work.
    told = torch.from_numpy(np.choose(look.level - source, rate, mode="clip"))
    rows, columns = look.scores.shape[:2]
    if look.scale > 1:
        told = F.pad(told, (0, columns * look.scale - told.shape[1], 0, rows * look.scale - told.shape[0]))
        told = F.avg_pool2d(told[None], look.scale)[0] * look.scale**2
    return (told + 1e-6).log()
