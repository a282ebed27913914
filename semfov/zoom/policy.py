"""Policies of where to look next, and how closely: the value of a look at each window."""

from collections.abc import Callable, Mapping
from functools import reduce

import numpy as np

from semfov.zoom.belief import Cells, ZoomBelief
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window

WindowChoice = tuple[Window, float]  # a window and the value of a look at it


def best_find(
    belief: ZoomBelief, done: set[Window], foresight: float = 0.0, *, beside: Window | None = None
) -> WindowChoice | None:
    r"""Choose the window in which a look is expected to find most objects, :math:`E[n_k(w)] + \kappa \, E[n_{k+1}(w)]`.

    The second term counts only cells that were not looked at from level k yet. A window counts for the share of it that
    does not lie `beside` one which is being looked at: an estimate of the best one afterwards.
    """
    lattice = belief.lattice
    best: WindowChoice | None = None
    for level in range(1, lattice.levels):
        best = _better(best, belief.value(level, foresight), level, lattice, done, beside)
    return best


def best_hit(
    belief: ZoomBelief, done: set[Window], *, closest: bool = False, beside: Window | None = None
) -> WindowChoice | None:
    """Choose the window that most probably shows the target, or of closer ones that do, divided by `patience`."""
    lattice, patience = belief.lattice, belief.evidence.patience
    chances = {level: belief.chances(level) for level in range(1, lattice.levels)}
    best: WindowChoice | None = None
    for level, values in chances.items():
        last = level == lattice.levels - 1
        if closest and not last:
            values = np.zeros_like(values)
        if not last:
            values = np.maximum(values, _sums(belief, chances, level) / np.float32(patience))
        best = _better(best, values, level, lattice, done, beside)
    return best


def _sums(belief: ZoomBelief, chances: Mapping[int, Cells], level: int) -> Cells:
    """Sum the chances of closer windows, side by side, in each window of a level; → `(down, across)`."""
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
    best: WindowChoice | None, values: Cells, level: int, lattice: Lattice, done: set[Window], beside: Window | None
) -> WindowChoice | None:
    """The better of a choice and the best window of a level that was not looked at."""
    if beside is not None:
        (x1, y1, x2, y2), span = beside.cells, lattice.span(level)
        shares = [
            (np.minimum(np.arange(n) + span, end) - np.maximum(np.arange(n), first)).clip(0) / span
            for n, first, end in zip(values.shape, (y1, x1), (y2, x2), strict=True)
        ]
        values = values * (1 - np.outer(*shares)).astype(np.float32)
    flat, across = values.ravel(), values.shape[1]
    for _ in range(len(done) + 1):
        place = int(flat.argmax())
        value = float(flat[place])
        if not value > (0.0 if best is None else best[1]):
            return best
        window = Window.on(lattice, (level, place % across, place // across))
        if window not in done:
            return window, value
        flat = flat.copy()
        flat[place] = -np.inf
    return best


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
