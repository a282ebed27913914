"""Where to look next, and how close: what a pass is worth."""

from collections.abc import Callable, Sequence

import numpy as np
import torch

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.glances import Window, on_lattice
from semfov.zoom.lattice import Lattice
from semfov.zoom.sums import Cells

Choice = tuple[Window, float]
"""A window, and what a look at it is worth."""


def best_find(belief: ZoomBelief, done: set[Window], foresight: float = 0.0) -> Choice | None:
    """The window in which a pass finds most objects that were not found yet; None where nothing is left.

    .. math:: v(w) = E[n_k(w)] + \\kappa \\, E[n_{k+1}(w)]

    for windows w of all levels k but the first; κ is the `foresight`. The second term counts cells alone that were not
    looked at from level k yet: a look at the others tells nothing new of where to look closer.
    """
    lattice = belief.lattice
    best: Choice | None = None
    for level in range(1, lattice.levels):
        best = _better(best, belief.value(level, foresight), level, lattice, done)
    return best


def best_hit(belief: ZoomBelief, done: set[Window], *, closest: bool = False) -> Choice | None:
    """The window that most probably shows the target, or one from which it would soon be found; None for none.

    A window is worth the probability that it shows the target. If it is not as close as it could be, it is worth the
    sum of these probabilities over the closer windows in it, divided by `patience`, where that is more.

    Args:
        belief: about the target.
        done: windows that were looked at.
        closest: whether only the closest windows can confirm the target.
    """
    lattice, patience = belief.lattice, belief.evidence.patience
    best: Choice | None = None
    for level in range(1, lattice.levels):
        last = level == lattice.levels - 1
        values = belief.chances(level)
        if closest and not last:
            values = np.zeros_like(values)
        if not last:
            values = np.maximum(values, _sums(belief, level) / np.float32(patience))
        best = _better(best, values, level, lattice, done)
    return best


def _sums(belief: ZoomBelief, level: int) -> Cells:
    """Sum over the closer windows, side by side, in each window of a level that was not looked at as closely yet."""
    lattice, source = belief.lattice, belief.source.numpy()
    down, across = lattice.places(level)[::-1]
    total = np.zeros((down, across), np.float32)
    for deeper in range(level + 1, lattice.levels):
        chances = belief.chances(deeper)
        span, times = lattice.span(deeper), 1 << (deeper - level)
        half = span // 2
        middle = source[half : half + chances.shape[0], half : half + chances.shape[1]]
        rows, columns = middle.shape
        # Where windows of the level reach beyond the picture there is nothing to sum.
        table = np.zeros([max((times - 1) * span + n, m) for n, m in ((down, rows), (across, columns))], np.float32)
        np.multiply(chances[:rows, :columns], middle < level, out=table[:rows, :columns])
        lines = sum(table[span * n : span * n + down] for n in range(times))
        total = np.maximum(total, sum(lines[:, span * n : span * n + across] for n in range(times)))
    return total


def _better(best: Choice | None, values: Cells, level: int, lattice: Lattice, done: set[Window]) -> Choice | None:
    """The better of a choice and of the windows of a level that were not looked at."""
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


def best_slice(belief: ZoomBelief, slices: Sequence[Window], done: set[Window]) -> Choice | None:
    """As `best_hit`, where only the given slices can confirm the target, and what is coarser is on the lattice."""
    odds = {window: belief.odds_of(window) for window in slices if window not in done}
    if not odds:
        return None
    chances = {window: float(torch.tensor(value).sigmoid()) for window, value in odds.items()}
    window = max(chances, key=chances.__getitem__)
    best: Choice = window, chances[window]
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
    """Whether the middle of a window was only looked at from farther off than a level."""
    x1, y1, x2, y2 = window.cells
    row = min(max((y1 + y2) // 2, 0), belief.lattice.rows - 1)
    column = min(max((x1 + x2) // 2, 0), belief.lattice.columns - 1)
    return int(belief.source[row, column]) < level


def jointly(
    choose: Callable[[set[Window]], Choice | None], belief: ZoomBelief, done: set[Window], count: int
) -> list[Choice]:
    """Several windows to look at together, none in another's place: each is chosen as if those before it were seen.

    Args:
        choose: the next window, given those that were looked at.
        belief: what it goes by; as it was, afterwards.
        done: windows that were looked at.
        count: how many, at most.
    """
    if count == 1:
        choice = choose(done)
        return [] if choice is None else [choice]
    left, taken, chosen = belief.left.clone(), set(done), []
    for _ in range(count):
        choice = choose(taken)
        if choice is None:
            break
        chosen.append(choice)
        taken.add(choice[0])
        belief.discount(choice[0])
    belief.restore(left)
    return chosen
