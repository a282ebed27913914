"""Searches by the evidence that only slices, or the closest windows, can end."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.episode import WindowStep, look_by_look
from semfov.zoom.evidence import STEPS, GlimpseEvidence, pool
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from semfov.zoom.policy import WindowChoice, best_hit


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
    belief: ZoomBelief, slices: Sequence[Window], done: set[Window], known: dict[Window, float]
) -> WindowChoice | None:
    """As `best_hit`, but only given slices can confirm the target; coarser windows are those of the lattice."""
    left = [window for window in slices if window not in done]
    if not left:
        return None
    for window in left:
        if window not in known:
            known[window] = odds_of(belief, window)
    chances = {window: float(torch.tensor(known[window]).sigmoid()) for window in left}
    window = max(chances, key=chances.__getitem__)
    best: WindowChoice = window, chances[window]
    lattice = belief.lattice
    finest = min(window.level for window in slices)
    for level in range(1, finest):
        half, (across, down) = max(1, lattice.span(level) // 4), lattice.places(level)
        for row in sorted({*range(0, down, half), down - 1}):
            for column in sorted({*range(0, across, half), across - 1}):
                coarse = Window.on(lattice, (level, column, row))
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


def odds_of(belief: ZoomBelief, window: Window) -> float:
    """Log odds that a look at a window shows the class; the window need not lie on the lattice."""
    value: Tensor | None = None
    for look in sorted(belief.gists, key=lambda gist: gist.level):
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
            before = None if value is None or look.level == 0 else value
            value = belief.evidence.presence(pooled[None], summary[None], torch.tensor([steps]), belief.target, before)
    return float("-inf") if value is None else float(value)
