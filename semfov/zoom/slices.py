"""Slices of a picture, ordered by the overview's raw scores: a choice of windows without fitted models."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.zoom.episode import Order
from semfov.zoom.hints import Gist, Hints
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.policy import WindowChoice

_OVERLAP = 0.2  # share of a slice that the next one repeats


def slices(lattice: Lattice, side: int, step: int) -> list[Window]:
    """List square slices of a picture row by row; the last ones are moved inside the picture, as SAHI cuts them.

    Args:
        lattice: windows of the picture.
        side: of a slice in pixels.
        step: pixels from one slice to the next.

    Returns:
        The slices.
    """
    width, height = lattice.size
    windows = []
    for y in _starts(height, side, step):
        for x in _starts(width, side, step):
            box = float(x), float(y), float(min(x + side, width)), float(min(y + side, height))
            windows.append(Window.around(lattice, box))
    return windows


def _starts(length: int, side: int, step: int) -> list[int]:
    """List the first pixels of slices along a side of a picture; the last one ends with it."""
    last = max(length - side, 0)
    return sorted({*range(0, last, step), last})


def usual_slices(lattice: Lattice, blank: Tensor | None = None) -> list[Window]:
    """List slices with the usual overlap, a fifth of their side.

    Args:
        lattice: windows of the picture.
        blank: `(rows, columns)`, cells where there is nothing to see; None for none.

    Returns:
        The slices, without those of blank cells alone; all of them if none other is left.
    """
    if lattice.levels == 1:
        side = max(1, round(0.6 * max(lattice.size)))
    else:
        # Of pictures with many levels the slices are reduced by half an octave: they are fewer.
        enlargement = 1.5 if lattice.levels > 2 else 1.0
        side = round(enlargement * min(lattice.canvas) / lattice.magnifications[-1])
    windows = slices(lattice, side, max(1, int(side * (1 - _OVERLAP))))
    if blank is None:
        return windows
    visible = []
    for window in windows:
        x1, y1, x2, y2 = window.cells
        if not blank[y1:y2, x1:x2].all():
            visible.append(window)
    return visible or windows


def ranked(windows: Sequence[Window], targets: Sequence[int] = (), *, most: bool = False) -> Order:
    """Order windows by the overview's raw scores in them, the highest first.

    Args:
        windows: the windows.
        targets: classes whose scores count; none for all.
        most: whether a window counts for its highest score, and not for their sum.

    Returns:
        The order of an episode; it is made anew where the overview is.
    """
    ranking: list[WindowChoice] = []
    ranked_by: WindowLook | None = None

    def order(looks: Sequence[WindowLook], done: set[Window]) -> list[WindowChoice]:
        nonlocal ranked_by
        overview = looks[0]
        if overview is not ranked_by:
            ranked_by = overview
            values = torch.tensor([raw(overview, window, targets, most=most) for window in windows])
            places = values.argsort(descending=True, stable=True).tolist()
            ranking[:] = [(windows[place], float(values[place])) for place in places]
        for choice in ranking:
            if choice[0] not in done:
                return [choice]
        return []

    return order


def raw(look: WindowLook, window: Window, targets: Sequence[int] = (), *, most: bool = False) -> float:
    """Value a window by the raw scores of a coarser look: their sum, or the highest, over its cells.

    Args:
        look: the coarser look.
        window: the window.
        targets: classes whose scores count; none for all.
        most: whether the highest score counts, and not the sum.

    Returns:
        The value.
    """
    if look.hints is not None:
        scores = _hints_inside(look.hints, window)
    else:
        assert look.gist is not None
        scores = _cells_inside(look.gist, window)
    if len(targets):
        scores = scores[..., [target - 1 for target in targets]]
    best = scores.amax(-1)
    if not best.numel():
        return 0.0
    return float(best.max() if most else best.sum())


def _hints_inside(hints: Hints, window: Window) -> Tensor:
    """Select the scores `(n, K)` of hints whose centre lies in a window."""
    boxes = hints.boxes
    # Hints are kept in photographs alone, whose one window of the lattice shows all.
    region = boxes.new_tensor(window.within or (0.0, 0.0, 1e9, 1e9))
    centre = (boxes[:, :2] + boxes[:, 2:]) / 2
    is_inside = ((region[:2] <= centre) & (centre < region[2:])).all(-1)
    return hints.scores[is_inside]


def _cells_inside(gist: Gist, window: Window) -> Tensor:
    """Select the scores `(rows, columns, K)` of the cells of a gist that a window shows in part at least."""
    x1, y1, x2, y2 = window.cells
    first_column, first_row = gist.first
    columns = _covered(x1 - first_column, x2 - first_column, gist.scale)
    rows = _covered(y1 - first_row, y2 - first_row, gist.scale)
    return gist.scores[rows, columns]


def _covered(start: int, stop: int, scale: int) -> slice:
    """Find the squares of `scale` cells that cells from `start` to `stop` touch."""
    return slice(max(int(start / scale), 0), max(-int(-(stop / scale) // 1), 0))
