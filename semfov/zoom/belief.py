r"""The belief about a large picture: how many objects further looks at smaller windows are expected to show.

Looks come in as gists, the strongest hints by cell. For each cell the belief keeps which level it was looked at from,
what is left to explore there, and how many objects smaller windows are expected to show there. Windows are valued by
sums over cells:

    gists of looks ────► rates of each cell, by level ──┐
                                                        ├──► sums over windows ──► `value`    objects that a look finds
    explored windows ──► `unexplored` ──────────────────┘    (`window_sums`)

All of it are tensors on one device. Where the evidence is trained and the belief begins with gradients, those of a
value reach the networks that predict the rates, and the weights of the border, whatever a policy asks for without
gradients in between. Such a belief serves one backward pass. Nothing is computed until it is asked for, and then only
what has changed:

- `_gists_rated` is the number of gists whose rates are written to the cells; `_predict` writes those of the others.
- `_sums` remember in which cells they have fallen behind (`mark`), and catch up in `update`. Whoever changes
  `unexplored`, `closest_level` or a gist marks the cells.
"""

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.zoom.evidence import GlimpseEvidence, PhotographEvidence
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.survey import STEPS
from semfov.zoom.window_sums import CellBox, Cells, CellSlices, WindowSums, extent, writable_tensor

# Fainter rates promise mostly where nothing is, so they are summed apart.
_CLEAR = 0.1  # expected number of objects from which on a cell clearly promises one

_EVERYWHERE: CellSlices = (slice(None), slice(None))

_CellQuantity = Callable[[int, CellSlices], Cells | None]
"""Gives a number for each cell by level, in some rows and columns; None where all are 0."""


class Rates(Protocol):
    """Model such as `GlimpseEvidence` or `Survey` that predicts how many objects smaller windows show."""

    foresight: float
    """Weight of the objects that smaller windows inside a window would show, in the value of the window."""

    def rates(self, look: Gist, targets: Tensor, before: Tensor | None = None) -> Tensor: ...

    def taper(self, span: int) -> Tensor: ...


class _Prediction(NamedTuple):
    """Rates `(octaves, rows, columns)` that a look predicts, and what they were predicted from."""

    gist: Gist
    before: Tensor | None
    rates: Cells

    def suits(self, gist: Gist, before: Tensor | None) -> bool:
        """Tell whether a look predicts the same."""
        if gist is not self.gist:
            return False
        if before is None or self.before is None:
            return before is self.before
        return torch.equal(before, self.before)


class ZoomBelief:
    r"""Belief about what looks at any window will show, for one class or for all.

    A look of level k is expected to find :math:`n_k(x) = u(x) \, \lambda_{k - s(x)}(x)` objects centred in a cell, by
    the rates of the closest look at it, of level s(x). u(x) is 0 once nothing is left to explore in it.

    Attributes:
        lattice: the cells and windows of the picture.
        target: class from 1; 0 for objects of any class.
        foresight: weight of the objects that smaller windows inside a window would show, in the value of the window.
        gists: the looks, in the order in which they were added.
        closest_level: s, level of the closest look at each cell, `(rows, columns)`; -1 where none was.

    Private attributes: `_rate` has λ of each cell `(rows, columns)` by the level of looks, where any cell has one, and
    `_rated_level` `(rows, columns)` the level of the look that this is from. `_gists_rated` counts the gists that both
    know. `_sums` has the sums over windows that were asked for, by quantity and level. `_predictions` has what looks
    predict, by the `id` of their gists: of present ones, and of those before the last `clear`. `_learns` tells whether
    rates and sums keep their graph, in whichever mode they are asked for.

    Invariant: `closest_level` knows all gists, `_rate` and `_rated_level` the first `_gists_rated`; when these are all,
    `_rated_level` equals `closest_level`. The sums are those of the cells but for windows over cells that were marked.
    """

    def __init__(
        self,
        lattice: Lattice,
        evidence: Rates,
        target: int,
        blank: Callable[[], Tensor | None] = lambda: None,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        """Begin with no look.

        Args:
            lattice: the cells and windows of the picture.
            evidence: the learned evidence; searches need all of `GlimpseEvidence`.
            target: class from 1; 0 for objects of any class.
            blank: gives the cells where there is nothing to see, `(rows, columns)`; None for none.
            device: where the gists of the looks and the evidence are.
        """
        self.lattice = lattice
        self.target = target
        self._blank = blank
        self._evidence = evidence
        self._rates: Rates = evidence.survey if target == 0 and isinstance(evidence, GlimpseEvidence) else evidence
        self.foresight = self._rates.foresight
        self._targets = torch.tensor([target], device=device)
        self._learns = torch.is_grad_enabled() and _is_trained(self._rates)
        self.gists: list[Gist] = []
        self._predictions: dict[int, _Prediction] = {}
        self.clear()

    def clear(self) -> None:
        """Forget all looks; their predictions are kept for looks that are added again before the next `clear`."""
        known = {} if self._learns else self._predictions  # a graph serves one backward pass
        self._predictions = {id(gist): known[id(gist)] for gist in self.gists if id(gist) in known}
        shape = self.lattice.rows, self.lattice.columns
        self._rate: dict[int, Cells] = {}
        self._gists_rated = 0
        self._rated_level = writable_tensor(shape, -1, torch.int8, self._targets.device)
        self.closest_level = writable_tensor(shape, -1, torch.int8, self._targets.device)
        # Made anew when it is asked for: which cells are blank is known after the overview alone.
        self.__dict__.pop("unexplored", None)
        self.gists = []
        self._sums: dict[tuple[_CellQuantity, int], WindowSums] = {}

    @cached_property
    def visible(self) -> Tensor:
        """Share of each cell that is not blank, `(rows, columns)`; known after the overview."""
        blank = self._blank()
        if blank is None:
            return torch.ones(self.lattice.rows, self.lattice.columns, device=self._targets.device)
        return 1 - blank.to(self._targets.device, torch.float32)

    @cached_property
    def unexplored(self) -> Tensor:
        """Share u of each cell that is left to explore, `(rows, columns)`."""
        with torch.inference_mode(False):  # what is made in inference mode may not be written to outside
            return self.visible.clone()

    @property
    def evidence(self) -> GlimpseEvidence:
        """The learned model of searches (`GlimpseEvidence`)."""
        assert isinstance(self._evidence, GlimpseEvidence), "searches go by learned evidence"
        return self._evidence

    @property
    def photograph(self) -> PhotographEvidence | None:
        """The model for photographs (`PhotographEvidence`), if the picture has only one level of magnification."""
        return self.evidence.photograph if self.lattice.levels == 1 else None

    def add(self, look: WindowLook) -> None:
        """Add the gist of a look; the window of a look at the last level only becomes explored.

        Args:
            look: the look.
        """
        gist = look.gist
        if gist is None:
            self.discount(look.window)
            return
        self.gists.append(gist)
        x1, y1, x2, y2 = box = self._box(gist)
        self.closest_level[y1:y2, x1:x2].clamp_(min=gist.level)
        self._mark_sums(box)

    def discount(self, window: Window) -> None:
        """Expect no more objects inside a window and at its borders, as if it had been looked at.

        Args:
            window: the window, which may reach beyond the picture.
        """
        x1, y1, x2, y2 = window.cells
        x1 = max(x1, 0)
        y1 = max(y1, 0)
        x2 = min(x2, self.lattice.columns)
        y2 = min(y2, self.lattice.rows)
        if x1 >= x2 or y1 >= y2:
            return
        unexplored = self.unexplored[y1:y2, x1:x2]
        # Windows over cells that were explored before need not be summed again.
        if unexplored.any():
            unexplored.zero_()
            self._mark_sums((x1, y1, x2, y2))

    def restore(self, unexplored: Tensor) -> None:
        """Restore the unexplored shares of cells, to undo `discount`.

        Args:
            unexplored: `(rows, columns)`, an earlier copy of the attribute.
        """
        differs = unexplored != self.unexplored
        if differs.any():
            self.unexplored.copy_(unexplored)
            self._mark_sums(extent(differs))

    def _mark_sums(self, box: CellBox) -> None:
        """Mark sums over windows as outdated in cells with a new look, or of which another share is left to explore."""
        for sums in self._sums.values():
            sums.mark(box)

    def _box(self, gist: Gist) -> CellBox:
        """Find the cells that a look shows."""
        x, y = gist.first
        rows, columns = gist.scores.shape[:2]
        right = min(x + columns * gist.scale, self.lattice.columns)
        bottom = min(y + rows * gist.scale, self.lattice.rows)
        return x, y, right, bottom

    def _predict(self) -> None:
        """Write the rates of new looks to the cells that were not looked at as closely before."""
        new = self.gists[self._gists_rated :]
        self._gists_rated = len(self.gists)
        with torch.set_grad_enabled(self._learns):
            for gist in new:
                self._write_rates(gist)

    def _write_rates(self, gist: Gist) -> None:
        """Write the rates of a look to the cells that were not looked at as closely before."""
        x1, y1, x2, y2 = self._box(gist)
        cells = slice(y1, y2), slice(x1, x2)
        rated_level = self._rated_level[cells]
        before = self._rates_before(cells, gist) if gist.level > 0 else None
        predicted = self._rates_of(gist, before)
        by_cell = _by_cell(predicted, gist.scale, rated_level.shape)
        is_closer = rated_level < gist.level
        for level in range(self.lattice.levels):
            # A look predicts the octaves above its own level; in the others it is expected to find nothing.
            octave = level - gist.level - 1
            if 0 <= octave < STEPS:
                if level not in self._rate:
                    self._rate[level] = writable_tensor(self._rated_level.shape, 0, by_cell.dtype, by_cell.device)
                rate = self._rate[level][cells]
                rate.copy_(torch.where(is_closer, by_cell[octave], rate))
            elif level in self._rate:
                self._rate[level][cells].masked_fill_(is_closer, 0)
        rated_level.masked_fill_(is_closer, gist.level)

    def _rates_before(self, cells: CellSlices, gist: Gist) -> Tensor:
        """Read what looks so far predict for the cells of a new look, as its own prediction takes it.

        Args:
            cells: rows and columns of the cells.
            gist: the look.

        Returns:
            `(1, rows, columns)` of the gist (`before_of`).
        """
        rated_level = self._rated_level[cells]
        nothing = self.unexplored.new_zeros(()).expand(rated_level.shape)
        levels = range(self.lattice.levels)
        rates = torch.stack([self._rate[level][cells] if level in self._rate else nothing for level in levels])
        # Rates of looks that are coarser by more than three octaves are those for three.
        octaves = (gist.level - rated_level).clamp(0, STEPS - 1)
        # The sum is the level one octave closer than this look: what its own prediction is about.
        level_before = rated_level + 1 + octaves
        rate = rates.gather(0, level_before.long()[None])[0]
        return before_of(rate, gist)[None]

    def _rates_of(self, gist: Gist, before: Tensor | None) -> Cells:
        """Predict the rates of a look, unless they are known: where a camera moves a little, most hints do not change.

        Args:
            gist: the look.
            before: logarithms of the rates that earlier looks gave (`before_of`); None for a look at the whole.

        Returns:
            `(octaves, rows, columns)`.
        """
        known = self._predictions.get(id(gist))
        if known is None or not known.suits(gist, before):
            rates = self._rates.rates(gist, self._targets, before)[0].exp()
            known = self._predictions[id(gist)] = _Prediction(gist, before, rates)
        return known.rates

    @torch.no_grad()
    def remaining(self) -> tuple[float, float]:
        """Sum the objects that looks are still expected to find, in each cell at its best level.

        Returns:
            Number of objects in cells that clearly promise one, and in all others.
        """
        # The overview is always the first look, so no further one is of level 0.
        levels = range(1, self.lattice.levels)
        if not levels:
            return 0.0, 0.0
        expected = torch.stack([self.expected(level) for level in levels]).amax(0)
        clear = float(expected[expected >= _CLEAR].sum())
        return clear, float(expected.sum()) - clear

    def expected(self, level: int) -> Cells:
        """Compute how many objects looks of a level are expected to find, :math:`n_k(x)`.

        Args:
            level: k.

        Returns:
            `(rows, columns)`, the number of objects in each cell.
        """
        expected = self._expected(level, _EVERYWHERE)
        return torch.zeros_like(self.unexplored) if expected is None else expected

    def _expected(self, level: int, slices: CellSlices) -> Cells | None:
        """Compute what looks of a level are expected to find in some cells; None where no look promises anything."""
        self._predict()
        if level not in self._rate:
            return None
        rate = self._rate[level][slices]
        unexplored = self.unexplored[slices]
        # Gradients need the share that is left now, which later looks write to.
        return rate * (unexplored.clone() if rate.requires_grad else unexplored)

    def _expected_closer(self, level: int, slices: CellSlices) -> Cells | None:
        """Compute what looks one level closer are expected to find, in cells that no look of this level has shown."""
        expected = self._expected(level + 1, slices)
        return None if expected is None else expected * (self.closest_level[slices] < level)

    def value(self, level: int, foresight: float) -> Cells:
        """Compute how many objects a look at each window of a level is expected to find (`best_find` uses it).

        Args:
            level: of the windows.
            foresight: weight of what looks one level closer are expected to find.

        Returns:
            `(down, across)`, in objects, differentiable in what the evidence predicts. The next call may change it.
        """
        values = self._sum_over_windows(self._expected, level, self._rates.taper)
        if not foresight or level + 1 >= self.lattice.levels:
            return values
        return values + foresight * self._sum_over_windows(self._expected_closer, level, self._equal_weight)

    def _equal_weight(self, span: int) -> Tensor:
        """Weight the cells along a side of a window alike, `(span,)`."""
        return self._rates.taper(1).detach().new_ones(span)

    def _sum_over_windows(self, quantity: _CellQuantity, level: int, weight: Callable[[int], Tensor]) -> Cells:
        """Sum a quantity of the cells over the windows of a level; → `(down, across)`."""
        with torch.set_grad_enabled(self._learns):
            if (quantity, level) not in self._sums:
                weights = weight(self.lattice.span(level))
                shape = self.lattice.rows, self.lattice.columns
                self._sums[quantity, level] = WindowSums(weights, shape, partial(quantity, level))
            sums = self._sums[quantity, level].update()
        return sums if torch.is_grad_enabled() else sums.detach()


def _is_trained(rates: Rates) -> bool:
    """Tell whether what predicts the rates has parameters that gradients are to reach."""
    return isinstance(rates, nn.Module) and any(parameter.requires_grad for parameter in rates.parameters())


def _by_cell(predicted: Cells, scale: int, shape: tuple[int, ...]) -> Cells:
    """Spread the objects of each square of `scale` cells evenly over its cells, `(octaves, rows, columns)`.

    Args:
        predicted: `(octaves, down, across)`, objects of the squares, which may reach beyond the picture.
        scale: cells along a side of a square.
        shape: rows and columns of the cells in the picture.
    """
    if scale == 1:
        return predicted
    rows, columns = shape
    # Squares of a strip reach far beyond the picture.
    row = torch.arange(rows, device=predicted.device) // scale
    column = torch.arange(columns, device=predicted.device) // scale
    return predicted[:, row[:, None], column] / scale**2


def before_of(rates: Cells, gist: Gist) -> Tensor:
    """Compute the logarithms of the rates that earlier looks predicted for the cells of a look.

    Args:
        rates: `(rows, columns)` of the lattice in the look, for looks one octave closer than it.
        gist: the look.

    Returns:
        `(rows, columns)` of the gist; in a gist of larger cells the rates of its cells are added up.
    """
    rows, columns = gist.scores.shape[:2]
    scale = gist.scale
    if scale > 1:
        rates = F.pad(rates, (0, columns * scale - rates.shape[1], 0, rows * scale - rates.shape[0]))
        # PyTorch pools means alone; times the number of cells they are sums.
        rates = F.avg_pool2d(rates[None], scale)[0] * scale**2
    return (rates + 1e-6).log()
