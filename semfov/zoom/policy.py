"""Where to look next, and how close: what a pass is worth."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.glances import Window, on_lattice
from semfov.zoom.lattice import Lattice

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
        values = belief.finds(level)
        if foresight and level + 1 < lattice.levels:
            values = values + foresight * _deeper(belief, level)
        best = _better(best, values, level, lattice, done)
    return best


def _deeper(belief: ZoomBelief, level: int) -> Tensor:
    """What looks one octave closer would find in each window of a level."""
    span = belief.lattice.span(level)
    image = (belief.expected(level + 1) * (belief.source < level))[None, None]
    wide, high = (max(span - n, 0) for n in (belief.lattice.columns, belief.lattice.rows))
    line = torch.ones(1, 1, 1, span)
    return F.conv2d(F.conv2d(F.pad(image, (0, wide, 0, high)), line), line.mT)[0, 0]


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
        values = torch.zeros(lattice.places(level)[::-1])
        if last or not closest:
            values = belief.odds(level).sigmoid()
        if not last:
            deeper = _sums(belief, level)
            values = torch.maximum(values, deeper / patience)
        best = _better(best, values, level, lattice, done)
    return best


def _sums(belief: ZoomBelief, level: int) -> Tensor:
    """Sum over the closer windows, side by side, in each window of a level that was not looked at as closely yet."""
    lattice = belief.lattice
    down, across = lattice.places(level)[::-1]
    total = torch.zeros(down, across)
    for deeper in range(level + 1, lattice.levels):
        odds = belief.odds(deeper)
        span, times = lattice.span(deeper), 1 << (deeper - level)
        half = span // 2
        source = belief.source[half : half + odds.shape[0], half : half + odds.shape[1]]
        source = F.pad(source[None].float(), (0, odds.shape[1] - source.shape[1], 0, odds.shape[0] - source.shape[0]),
                       value=torch.inf)[0]  # fmt: skip
        table = odds.sigmoid() * (source < level)
        high, wide = ((times - 1) * span + n for n in (down, across))
        table = F.pad(table, (0, max(wide - table.shape[1], 0), 0, max(high - table.shape[0], 0)))
        sums = F.conv2d(table[None, None], torch.ones(1, 1, times, times), dilation=span)[0, 0]
        total = torch.maximum(total, sums[:down, :across])
    return total


def _better(best: Choice | None, values: Tensor, level: int, lattice: Lattice, done: set[Window]) -> Choice | None:
    """The better of a choice and of the windows of a level that were not looked at."""
    flat = values.flatten()
    across = values.shape[1]
    for _ in range(len(done) + 1):
        place = int(flat.argmax())
        value = float(flat[place])
        if not value > (0.0 if best is None else best[1]):
            return best
        window = on_lattice(lattice, (level, place % across, place // across))
        if window not in done:
            return window, value
        flat = flat.clone()
        flat[place] = -torch.inf
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
