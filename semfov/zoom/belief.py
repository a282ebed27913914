"""The belief about a large picture: what the looks so far predict that closer looks will show."""

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.zoom.evidence import STEPS, GlimpseEvidence
from semfov.zoom.glances import Glance, Window
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.odds import WindowOdds
from semfov.zoom.photograph import PhotographEvidence
from semfov.zoom.sums import Box, Cells, Place, extent, union

_SLIVER = 0.25
"""Share of a window: where less is not blank, little counts as little, and the edge of a scan takes no look."""

_CLEAR = 0.1
"""Number of objects from which on a cell clearly promises one."""


class Rates(Protocol):
    """Predicts how many objects closer looks find, such as `GlimpseEvidence` and `Survey`."""

    foresight: float
    """Share of what still closer looks would find in a window that counts towards its value."""

    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor:
        """See `GlimpseEvidence.rates`."""
        ...

    def taper(self, span: int) -> Tensor:
        """See `GlimpseEvidence.taper`."""
        ...


class _WindowSums:
    r"""Weighted sums of the cells of every window; weight `(span,)`, shape `(rows, columns)`.

    .. math:: S_{ij} = \sum_{k,l} r_k r_l \, x_{i+k,\,j+l}

    A sum along an axis is a product with a banded matrix. Only the windows that hold a cell which has changed are
    summed again. A window that reaches beyond the cells sums those that it holds.
    """

    def __init__(self, weight: Cells, shape: tuple[int, int], cells: Callable[[Place], Cells]) -> None:
        self._span, self._cells = len(weight), cells
        places = np.arange(max(max(n - self._span, 0) + 1 for n in shape))
        self._band = np.zeros((len(places) + self._span - 1, len(places)), np.float32)
        self._band[places + np.arange(self._span)[:, None], places] = weight[:, None]
        self._sums = np.zeros([max(n - self._span, 0) + 1 for n in shape], np.float32)
        self._changed: Box | None = (0, 0, shape[1], shape[0])

    def mark(self, changed: Box) -> None:
        """Have the windows summed again that hold one of some cells."""
        self._changed = union(changed, self._changed)

    def update(self) -> Cells:
        """Sum the cells of every window, `(down, across)`; the next call changes the result."""
        if self._changed is None:
            return self._sums
        (x1, y1, x2, y2), self._changed = self._changed, None
        reach = self._span - 1
        top, left = max(y1 - reach, 0), max(x1 - reach, 0)
        bottom, right = min(y2, self._sums.shape[0]), min(x2, self._sums.shape[1])
        part = self._cells((slice(top, bottom + reach), slice(left, right + reach)))
        down, across = self._band[: part.shape[0], : bottom - top], self._band[: part.shape[1], : right - left]
        # NumPy would start threads for large pictures, and they would wait at full load for the next product.
        lines = torch.from_numpy(part) @ torch.from_numpy(across)
        self._sums[top:bottom, left:right] = (torch.from_numpy(down).mT @ lines).numpy()
        return self._sums


_EVERYWHERE: Place = (slice(None), slice(None))


class ZoomBelief:
    r"""What looks at any window of a picture are expected to show, for one class.

    Each cell x is predicted from the closest look at it, of level s(x), whose rates are :math:`\lambda_1`,
    :math:`\lambda_2` and :math:`\lambda_3` for looks one, two and three octaves closer. A look of level k is expected
    to find this number of objects centred in the cell, where u(x) is 0 once nothing is left to see in it, and 1 before:

    .. math:: n_k(x) = u(x) \, \lambda_{k - s(x)}(x), \qquad \lambda_i = 0 \text{ for other } i

    For a picture with L levels the belief keeps L + 3 numbers for a cell. Hints of all classes are kept for the windows
    that were looked at, at most 32 × 32 cells of each. A picture of 20,000 × 15,000 px has 49,152 cells and six levels:
    1.8 MB, and for 80 classes at most 0.41 MB for each look. Searches also keep the hints of each look that are left to
    see and what they predict for its windows, at most 0.41 MB.

    Sums over windows (`WindowSums`) and log odds (`WindowOdds`) are kept, and computed anew where cells have changed.

    Shapes: source, left and blank `(rows, columns)`.
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
        """Forget all looks."""
        shape = self.lattice.rows, self.lattice.columns
        self._rate = np.zeros((self.lattice.levels, *shape), np.float32)
        # The level that the rates of a cell are from. Rates are predicted when they are asked for.
        self._rated = np.full(shape, -1, np.int8)
        self._predicted = 0
        self.source = torch.full(shape, -1)
        self.__dict__.pop("left", None)
        self.gists: list[Gist] = []
        self._sums: dict[tuple[int, int], _WindowSums] = {}
        self._odds: WindowOdds | None = None

    @cached_property
    def _there(self) -> Tensor:
        """Share of each cell where there is something to see, asked for after the overview, `(rows, columns)`."""
        blank = self._blank()
        return torch.ones(self.lattice.rows, self.lattice.columns) if blank is None else 1 - blank.float()

    @cached_property
    def left(self) -> Tensor:
        """Share of each cell that is left to see, `(rows, columns)`."""
        return self._there.clone()

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
            self._mark(extent(differs))

    def add(self, glance: Glance) -> None:
        """Update the belief with the result of a look."""
        if glance.gist is None:
            self.discount(glance.window)
            return
        look, source = glance.gist, self.source.numpy()
        self.gists.append(look)
        x1, y1, x2, y2 = box = self._box(look)
        np.maximum(source[y1:y2, x1:x2], look.level, out=source[y1:y2, x1:x2])
        self._mark(box, left=False)

    def discount(self, window: Window) -> None:
        """Expect nothing more inside a window, because it was looked at as closely as possible, or is about to be.

        This includes the cells at its borders. Objects that a border cuts are centred in the next window as often as in
        this one, and looking at borders again finds less than looking elsewhere.
        """
        x1, y1, x2, y2 = window.cells
        x1, y1, x2, y2 = max(x1, 0), max(y1, 0), min(x2, self.lattice.columns), min(y2, self.lattice.rows)
        if x1 < x2 and y1 < y2:
            part = self.left.numpy()[y1:y2, x1:x2]
            if part.any():
                part[:] = 0
                self._mark((x1, y1, x2, y2))

    def _mark(self, changed: Box, *, left: bool = True) -> None:
        """Mark stored values of windows as outdated where cells, or the share of them that is left, changed."""
        for sums in self._sums.values():
            sums.mark(changed)
        if left and self._odds is not None:
            self._odds.mark(changed)

    def _box(self, look: Gist) -> Box:
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
        clear = float(expected[expected >= _CLEAR].sum())
        return clear, float(expected.sum()) - clear

    def expected(self, level: int, at: Place = _EVERYWHERE) -> Cells:
        """Number of objects that looks of a level are expected to find in each cell, in some rows and columns."""
        self._predict()
        expected: Cells = self._rate[level, *at] * self.left.numpy()[at]
        return expected

    def value(self, level: int, foresight: float) -> Cells:
        """Value of each window of a level for finding objects (`semfov.zoom.policy.best_find`); → `(down, across)`."""
        values = self._sum(level, 1)
        if not foresight or level + 1 >= self.lattice.levels:
            return values
        return values + np.float32(foresight) * self._sum(level, 2)

    def unseen(self, level: int) -> Cells:
        """Share of each window of a level that no look has shown at that level or closer, `(down, across)`."""
        if level not in self._areas:
            there, ones = self._there.numpy(), np.ones(self.lattice.span(level), np.float32)
            whole = min(len(ones), self.lattice.rows) * min(len(ones), self.lattice.columns)
            self._areas[level] = _WindowSums(ones, there.shape, there.__getitem__).update().clip(_SLIVER * whole)
        return self._sum(level, 0) / self._areas[level]

    @property
    def left_share(self) -> float:
        """Share of the picture that is left to see, of what is not blank."""
        return float(self.left.sum() / self._there.sum().clamp(1))

    def _sum(self, level: int, octaves: int) -> Cells:
        """Sums over the windows of a level; → `(down, across)`."""
        if (level, octaves) not in self._sums:
            source = self.source.numpy()  # where it is below a level, no look has shown a cell at it or closer
            cells: Callable[[Place], Cells] = (
                lambda at: self.left.numpy()[at] * (source[at] < level),
                lambda at: self.expected(level, at),
                lambda at: self.expected(level + 1, at) * (source[at] < level),
            )[octaves]
            span = self.lattice.span(level)
            weight = self._rates.taper(span).detach().numpy() if octaves == 1 else np.ones(span, np.float32)
            self._sums[level, octaves] = _WindowSums(weight, (self.lattice.rows, self.lattice.columns), cells)
        return self._sums[level, octaves].update()

    def chances(self, level: int) -> Cells:
        r"""Probability that a look at each window of a level shows the class, and no look at the same place did.

        Looks at a part of a window, from its level or closer, have not shown the class there. If they covered all of
        the window but the share u (`unseen`), the evidence P counts only for that share, as if the object could be
        anywhere in the window:

        .. math:: p(w) = u(w) \, P(w)

        Shapes: → `(down, across)`.
        """
        probability: Cells = torch.from_numpy(self._level_odds(level)).sigmoid().numpy()
        return probability * self.unseen(level)

    def _level_odds(self, level: int) -> Cells:
        """Log odds that a look at each window of a level shows the class, `(down, across)`; -inf where unknown."""
        if self._odds is None:
            self._odds = WindowOdds(self.lattice, self.evidence, self.target, self.gists, self.left.numpy())
        return self._odds.update()[level]


def before_of(rate: Cells, look: Gist) -> Tensor:
    """Logarithms of the rates that earlier looks predicted for a look's cells, one octave closer than the look.

    Shapes: rate `(rows, columns)` → `(rows, columns)`.
    """
    before = torch.from_numpy(rate)
    rows, columns = look.scores.shape[:2]
    if look.scale > 1:
        before = F.pad(before, (0, columns * look.scale - before.shape[1], 0, rows * look.scale - before.shape[0]))
        before = F.avg_pool2d(before[None], look.scale)[0] * look.scale**2
    return (before + 1e-6).log()
