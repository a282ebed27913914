"""Searches by the evidence that only slices, or the closest windows, can end."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.episode import WindowStep, look_by_look
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from semfov.zoom.policy import WindowChoice, best_hit
from semfov.zoom.pooling import pool
from semfov.zoom.survey import STEPS


def look_for_slice(
    source: WindowLooks, evidence: GlimpseEvidence, target: int, slices: Sequence[Window] | None, confirm: float = 0.3
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for one object of a class until a slice shows it, or a window of the largest magnification without slices.

    Args:
        source: the looks at the picture.
        evidence: predicts from a look what closer looks will find.
        target: class 1..K.
        slices: windows that can confirm the class; None for those of the largest magnification.
        confirm: least score with which a look confirms it.

    Yields:
        The looks.
    """
    belief = ZoomBelief(source.lattice, evidence, target, source.blank)
    allowed = None if slices is None else set(slices)
    known: dict[int, dict[Window, float]] = {}  # log odds of slices, by the number of looks that they follow from

    def best(looks: Sequence[WindowLook], done: set[Window]) -> Sequence[WindowChoice]:
        odds = known.setdefault(len(belief.gists), {})
        choice = best_hit(belief, done, closest=True) if slices is None else _best_slice(belief, slices, done, odds)
        return [] if choice is None else [choice]

    for step in look_by_look(source, best, belief):
        yield step
        window = step.look.window
        confirms = window.level == source.lattice.levels - 1 if allowed is None else window in allowed
        if confirms and float(step.look.show[target - 1]) >= confirm:
            return


def _best_slice(
    belief: ZoomBelief, slices: Sequence[Window], done: set[Window], log_odds: dict[Window, float]
) -> WindowChoice | None:
    """Choose as `best_hit`, but only given slices can confirm the target; coarser windows are those of the lattice."""
    remaining = [window for window in slices if window not in done]
    if not remaining:
        return None
    for window in remaining:
        if window not in log_odds:
            log_odds[window] = odds_of(belief, window)
    chances = {window: float(torch.tensor(log_odds[window]).sigmoid()) for window in remaining}
    likeliest = max(chances, key=chances.__getitem__)
    best: WindowChoice = likeliest, chances[likeliest]
    finest = min(window.level for window in slices)
    for level in range(1, finest):
        for coarse in _windows_at(belief.lattice, level):
            if coarse in done:
                continue
            # The chances of the slices that a coarser window shows, and that no look as close has shown. What it finds
            # takes further passes to confirm, for which its worth is divided.
            shown = [
                chance
                for window, chance in chances.items()
                if _inside(window, coarse) and _coarser(belief, window, level)
            ]
            worth = sum(shown) / belief.evidence.patience
            if worth > best[1]:
                best = coarse, worth
    return best


def _windows_at(lattice: Lattice, level: int) -> Iterator[Window]:
    """List the windows of a level at steps of a quarter of a window, and those at the far borders."""
    step = max(1, lattice.span(level) // 4)
    columns, rows = lattice.places(level)
    for row in sorted({*range(0, rows, step), rows - 1}):
        for column in sorted({*range(0, columns, step), columns - 1}):
            yield Window.on(lattice, (level, column, row))


def _inside(window: Window, other: Window) -> bool:
    """Tell whether a window lies in another one."""
    x1, y1, x2, y2 = window.cells
    left, top, right, bottom = other.cells
    return x1 >= left and y1 >= top and x2 <= right and y2 <= bottom


def _coarser(belief: ZoomBelief, window: Window, level: int) -> bool:
    """Tell whether the middle of a window was only looked at from coarser levels than a given one."""
    x1, y1, x2, y2 = window.cells
    row = min(max((y1 + y2) // 2, 0), belief.lattice.rows - 1)
    column = min(max((x1 + x2) // 2, 0), belief.lattice.columns - 1)
    return int(belief.closest_level[row, column]) < level


def odds_of(belief: ZoomBelief, window: Window) -> float:
    """Compute the log odds that a look at a window shows the class; the window need not lie on the lattice.

    Args:
        belief: what the looks so far have shown.
        window: the window.

    Returns:
        The log odds; minus infinity where no look predicts the window.
    """
    log_odds: Tensor | None = None
    for look in sorted(belief.gists, key=lambda gist: gist.level):
        steps = window.level - look.level
        if not 1 <= steps <= STEPS or not (look.level == 0 or _shows(look, window)):
            continue
        pooled, summary = pool(look.scores, _cells_in(look, window))
        with torch.no_grad():
            before = None if log_odds is None or look.level == 0 else log_odds
            log_odds = belief.evidence.presence(
                pooled[None], summary[None], torch.tensor([steps]), belief.target, before
            )
    return float("-inf") if log_odds is None else float(log_odds)


def _shows(look: Gist, window: Window) -> bool:
    """Tell whether a window lies in what a look shows."""
    x1, y1, x2, y2 = window.cells
    left, top = look.first
    rows, columns = look.scores.shape[:2]
    return x1 >= left and y1 >= top and x2 <= left + columns * look.scale and y2 <= top + rows * look.scale


def _cells_in(look: Gist, window: Window) -> tuple[int, int, int, int]:
    """Find the cells of a look that a window shows, at least one: first column and row, and those after the last."""
    x1, y1, x2, y2 = window.cells
    left, top = look.first
    column = (x1 - left) // look.scale
    row = (y1 - top) // look.scale
    return column, row, max(-(-(x2 - left) // look.scale), column + 1), max(-(-(y2 - top) // look.scale), row + 1)
