"""Orders in which to look at the windows of a picture: baselines for the learned choice of windows."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from semfov.zoom.glances import Glance, Glances, Window, around, on_lattice
from semfov.zoom.lattice import Lattice


def slices(lattice: Lattice, side: int, overlap: float) -> list[Window]:
    """Square slices of a picture row by row; the last ones are moved inside the picture, as SAHI cuts them."""
    width, height = lattice.size
    step = max(1, int(side * (1 - overlap)))

    def starts(length: int) -> list[int]:
        last = max(length - side, 0)
        return sorted({*range(0, last, step), last})

    boxes = [(x, y, min(x + side, width), min(y + side, height)) for y in starts(height) for x in starts(width)]
    return [around(lattice, (float(x1), float(y1), float(x2), float(y2))) for x1, y1, x2, y2 in boxes]


def raster(glances: Glances, windows: Sequence[Window]) -> Iterator[Glance]:
    """The overview, then the windows in their order."""
    yield from glances.see([overview(glances)])
    for window in windows:
        yield from glances.see([window])


def shuffled(glances: Glances, windows: Sequence[Window], seed: Sequence[int]) -> Iterator[Glance]:
    """The overview, then the windows in random order."""
    order = np.random.Generator(np.random.PCG64(list(seed))).permutation(len(windows))
    yield from raster(glances, [windows[n] for n in order])


def ranked(glances: Glances, windows: Sequence[Window], target: int | None, *, most: bool) -> Iterator[Glance]:
    """The overview, then the windows in descending order of the overview's raw scores in them.

    Args:
        glances: the looks at the picture.
        windows: windows to look at.
        target: class 1..K; None: any class.
        most: rank a window by its highest score; false: by the sum of its scores.

    Yields:
        The looks in this order.
    """
    first = glances.see([overview(glances)])[0]
    yield first
    values = torch.tensor([raw(first, window, target, most=most) for window in windows])
    for place in values.argsort(descending=True, stable=True).tolist():
        yield from glances.see([windows[place]])


def quad_tree(glances: Glances, target: int | None, *, most: bool) -> Iterator[Glance]:
    """Best first: the overview, then repeatedly the quarter of a seen window with the highest raw score."""
    lattice = glances.lattice
    first = glances.see([overview(glances)])[0]
    yield first
    frontier = _quarters(lattice, first, target, most)
    # Quarters at the right and bottom borders are moved inside the picture, where two of them may coincide.
    known = {window for _, window in frontier}
    while frontier:
        frontier.sort(key=lambda entry: (-entry[0], entry[1].level, entry[1].cells))
        _, window = frontier.pop(0)
        glance = glances.see([window])[0]
        yield glance
        new = [entry for entry in _quarters(lattice, glance, target, most) if entry[1] not in known]
        known |= {window for _, window in new}
        frontier += new


def _quarters(lattice: Lattice, glance: Glance, target: int | None, most: bool) -> list[tuple[float, Window]]:
    level = glance.window.level + 1
    if level >= lattice.levels:
        return []
    span, (across, down) = lattice.span(level), lattice.places(level)
    left, top = glance.window.cells[:2]
    places = sorted(
        {
            (min(top + dy, down - 1), min(left + dx, across - 1))
            for dy in (0, span)
            for dx in (0, span)
            if top + dy < lattice.rows and left + dx < lattice.columns
        }
    )
    windows = [on_lattice(lattice, (level, column, row)) for row, column in places]
    return [(raw(glance, window, target, most=most), window) for window in windows]


def raw(glance: Glance, window: Window, target: int | None, *, most: bool) -> float:
    """Highest score, or sum of the scores, of a look's gist in a window."""
    look = glance.gist
    assert look is not None
    x1, y1, x2, y2 = window.cells
    left, top = look.first
    box = [(n - first) / look.scale for n, first in zip((x1, y1, x2, y2), (left, top) * 2, strict=True)]
    columns = slice(max(int(box[0]), 0), max(-int(-box[2] // 1), 0))
    rows = slice(max(int(box[1]), 0), max(-int(-box[3] // 1), 0))
    part = look.scores[rows, columns]
    scores = part.amax(-1) if target is None else part[..., target - 1]
    if not scores.numel():
        return 0.0
    return float(scores.max() if most else scores.sum())


def oracle(
    glances: Glances, windows: Sequence[Window], found: Callable[[Glance], Tensor], most: int
) -> Iterator[Glance]:
    """The overview, then repeatedly the window that shows most of the objects not seen before."""
    first = glances.see([overview(glances)])[0]
    yield first
    seen, looks = found(first), glances.see(windows)
    told = torch.stack([found(glance) for glance in looks])
    for _ in range(min(most, len(windows)) - 1):
        best = int((told & ~seen).sum(-1).argmax())
        seen = seen | told[best]
        yield looks[best]


def overview(glances: Glances) -> Window:
    """The window with the whole picture."""
    return on_lattice(glances.lattice, (0, 0, 0))
