"""Policies of where to look next, and how closely: the value of a look at each window."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window

WindowChoice = tuple[Window, float]  # a window and the value of a look at it

WindowValues = NDArray[np.float32]
"""Values of looks at the windows of a level, `(down, across)`."""


@torch.no_grad()
def best_find(
    belief: ZoomBelief,
    done: set[Window],
    foresight: float = 0.0,
    *,
    beside: Window | None = None,
    known: Callable[[int], WindowValues] | None = None,
) -> WindowChoice | None:
    r"""Choose the window in which a look is expected to find most objects, :math:`E[n_k(w)] + \kappa \, E[n_{k+1}(w)]`.

    The second term counts only cells that were not looked at from level k yet.

    Args:
        belief: the belief about the picture.
        done: windows that were looked at.
        foresight: κ.
        beside: a window that is being looked at. Other windows count for the share that does not lie in it: an estimate
            of the best one afterwards.
        known: gives by level what a look at each window brings for objects that are known, `(down, across)`.

    Returns:
        The window and its value; None if no window has a value above 0.
    """
    lattice = belief.lattice
    best: WindowChoice | None = None
    for level in range(1, lattice.levels):
        values = belief.value(level, foresight).detach().cpu().numpy()
        if known is not None:
            values = values + known(level)
        best = _better(best, values, level, lattice, done, beside)
    return best


def _better(
    best: WindowChoice | None,
    values: WindowValues,
    level: int,
    lattice: Lattice,
    done: set[Window],
    beside: Window | None,
) -> WindowChoice | None:
    """Choose the better of a choice and the best window of a level that was not looked at; values `(down, across)`."""
    if beside is not None:
        values = values * _share_outside(beside, lattice.span(level), values.shape)
    flat = values.ravel()
    across = values.shape[1]
    # At most all windows that were looked at are better than the best other one.
    for _ in range(len(done) + 1):
        place = int(flat.argmax())
        value = float(flat[place])
        if not value > (0.0 if best is None else best[1]):
            return best
        window = Window.on(lattice, (level, place % across, place // across))
        if window not in done:
            return window, value
        # The values are the array of the belief, which keeps them for the next choice.
        flat = flat.copy()
        flat[place] = -np.inf
    return best


def _share_outside(window: Window, span: int, shape: tuple[int, ...]) -> WindowValues:
    """Compute the share of each window of `span` cells that lies outside one window; → `shape`, `(down, across)`."""
    x1, y1, x2, y2 = window.cells
    down, across = shape
    inside = np.outer(_shares_inside(y1, y2, span, down), _shares_inside(x1, x2, span, across))
    return (1 - inside).astype(np.float32)


def _shares_inside(first: int, end: int, span: int, count: int) -> NDArray[np.float64]:
    """Compute the shares `(count,)` of spans, which start at 0, 1, …, that lie between two cells."""
    start = np.arange(count)
    return (np.minimum(start + span, end) - np.maximum(start, first)).clip(0) / span


def jointly(
    choose: Callable[[set[Window]], WindowChoice | None], belief: ZoomBelief, done: set[Window], count: int
) -> list[WindowChoice]:
    """Choose several windows for one batch, each as if the windows chosen before it had been looked at.

    Only `find_everything` calls it, with `batch` as the count: searches and slices choose one window at a time.

    Args:
        choose: chooses one window by the belief, given those that were looked at.
        belief: the belief; it is unchanged afterwards.
        done: windows that were looked at.
        count: largest number of windows.

    Returns:
        The windows and their values, the best first; fewer where no other promises anything.
    """
    if count == 1:
        choice = choose(done)
        return [] if choice is None else [choice]
    unexplored = belief.unexplored.clone()
    visited = set(done)
    chosen: list[WindowChoice] = []
    for _ in range(count):
        choice = choose(visited)
        if choice is None:
            break
        chosen.append(choice)
        window = choice[0]
        visited.add(window)
        belief.discount(window)
    belief.restore(unexplored)
    return chosen
