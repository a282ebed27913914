"""Policies of where to look next, and how closely: the value of a look at each window."""

from collections.abc import Callable, Mapping, Sequence
from functools import reduce

import numpy as np
import torch

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.glances import Window, on_lattice
from semfov.zoom.lattice import Lattice
from semfov.zoom.sums import Cells

WindowChoice = tuple[Window, float]
"""A window and the value of a look at it."""


def best_find(belief: ZoomBelief, done: set[Window], foresight: float = 0.0) -> WindowChoice | None:
    r"""Choose the window in which a look is expected to find most objects that were not found yet.

    .. math:: v(w) = E[n_k(w)] + \kappa \, E[n_{k+1}(w)]

    for windows w of all levels k but the first. The second term counts only cells that were not looked at from level k
    yet: a look at the other cells gives no new information about where to look more closely.
    """
    lattice = belief.lattice
    best: WindowChoice | None = None
    for level in range(1, lattice.levels):
        best = _better(best, belief.value(level, foresight), level, lattice, done)
    return best


def best_hit(belief: ZoomBelief, done: set[Window], *, closest: bool = False) -> WindowChoice | None:
    """Choose the window that most probably shows the target, or one after which the target is soon found.

    The value of a window is the probability that it shows the target. For windows that can be looked at more closely it
    is the sum of these probabilities over the closer windows in it, divided by `patience`, if that is larger.
    """
    lattice, patience = belief.lattice, belief.evidence.patience
    chances = {level: belief.chances(level) for level in range(1, lattice.levels)}
    best: WindowChoice | None = None
    for level, values in chances.items():
        last = level == lattice.levels - 1
        if closest and not last:
            values = np.zeros_like(values)
        if not last:
            values = np.maximum(values, _sums(belief, chances, level) / np.float32(patience))
        best = _better(best, values, level, lattice, done)
    return best


def _sums(belief: ZoomBelief, chances: Mapping[int, Cells], level: int) -> Cells:
    """Sum the chances of closer windows, side by side, in each window of a level; → `(down, across)`.

    Shapes: → `(down, across)`.
    """
    lattice, source = belief.lattice, belief.source.numpy()
    down, across = lattice.places(level)[::-1]
    total = np.zeros((down, across), np.float32)
    for deeper in range(level + 1, lattice.levels):
        closer = chances[deeper]
        span, times = lattice.span(deeper), 1 << (deeper - level)
        half = span // 2
        middle = source[half : half + closer.shape[0], half : half + closer.shape[1]]
        rows, columns = middle.shape
        # Windows of the level can reach beyond the picture, where there are no closer windows: zeros.
        table = np.zeros([max((times - 1) * span + n, m) for n, m in ((down, rows), (across, columns))], np.float32)
        np.multiply(closer[:rows, :columns], middle < level, out=table[:rows, :columns])
        lines = reduce(np.add, (table[span * n : span * n + down] for n in range(times)))
        total = np.maximum(total, reduce(np.add, (lines[:, span * n : span * n + across] for n in range(times))))
    return total


def _better(
    best: WindowChoice | None, values: Cells, level: int, lattice: Lattice, done: set[Window]
) -> WindowChoice | None:
    """The better of a choice and the best window of a level that was not looked at."""
    flat, across = values.ravel(), values.shape[1]
    for _ in range(len(done) + 1):
        place = int(flat.argmax())
        value = float(flat[place])
        if not value > (0.0 if best is None else best[1]):
            return best
        window = on_lattice(lattice, (level, place % across, place // across))
        if window not in done:
            return window, value
        flat = flat.copy()
        flat[place] = -np.inf
    return best


def best_slice(belief: ZoomBelief, slices: Sequence[Window], done: set[Window]) -> WindowChoice | None:
    """As `best_hit`, but only given slices can confirm the target; coarser windows are those of the lattice."""
    odds = {window: belief.odds_of(window) for window in slices if window not in done}
    if not odds:
        return None
    chances = {window: float(torch.tensor(value).sigmoid()) for window, value in odds.items()}
    window = max(chances, key=chances.__getitem__)
    best: WindowChoice = window, chances[window]
    lattice = belief.lattice
    finest = min(window.level for window in slices)
    for level in range(1, finest):
        half, (across, down) = max(1, lattice.span(level) // 4), lattice.places(level)
        for row in sorted({*range(0, down, half), down - 1}):
            for column in sorted({*range(0, across, half), across - 1}):
                coarse = on_lattice(lattice, (level, column, row))
                if coarse in done:
                    continue
                inside = [p for w, p in chances.items() if _inside(w, coarse) and _coarser(belief, w, level)]
                value = sum(inside) / belief.evidence.patience
                if value > best[1]:
                    best = coarse, value
    return best


def _inside(window: Window, other: Window) -> bool:
    a, b = window.cells, other.cells
    return a[0] >= b[0] and a[1] >= b[1] and a[2] <= b[2] and a[3] <= b[3]


def _coarser(belief: ZoomBelief, window: Window, level: int) -> bool:
    """Tell whether the middle of a window was only looked at from coarser levels than a given one."""
    x1, y1, x2, y2 = window.cells
    row = min(max((y1 + y2) // 2, 0), belief.lattice.rows - 1)
    column = min(max((x1 + x2) // 2, 0), belief.lattice.columns - 1)
    return int(belief.source[row, column]) < level


def jointly(
    choose: Callable[[set[Window]], WindowChoice | None], belief: ZoomBelief, done: set[Window], count: int
) -> list[WindowChoice]:
    """Choose several windows to look at together, each as if the windows before it had been looked at."""
    if count == 1:
        choice = choose(done)
        return [] if choice is None else [choice]
    left, visited, chosen = belief.left.clone(), set(done), []
    for _ in range(count):
        choice = choose(visited)
        if choice is None:
            break
        chosen.append(choice)
        visited.add(choice[0])
        belief.discount(choice[0])
    belief.restore(left)
    return chosen
