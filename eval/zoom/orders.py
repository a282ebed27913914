"""Orders in which to look at the windows of a picture after the overview: baselines for the learned choice."""

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from semfov.zoom.episode import Order
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from semfov.zoom.policy import WindowChoice
from semfov.zoom.slices import raw, slices


def adaptive_slices(lattice: Lattice, overlap: float = 0.15) -> list[Window]:
    r"""Make square slices whose number and side follow from the size of the picture, as in ASAHI.

    A picture whose longer side exceeds :math:`512 (4 - 3 l) + 1` pixels is covered by 4 × 3 slices with an overlap l,
    another one by 3 × 2; n × m slices need the side

    .. math:: p = \max\left(\frac{W}{n - (n - 1) l}, \frac{H}{m - (m - 1) l}\right) + 1

    Zhang, H. et al. (2023), Adaptive slicing-aided hyper inference for small object detection in high-resolution remote
    sensing images, Remote Sensing 15(5):1249.
    """
    width, height = lattice.size
    is_large = max(width, height) > 512 * (4 - 3 * overlap) + 1
    columns, rows = (4, 3) if is_large else (3, 2)
    side_by_width = width / (columns - (columns - 1) * overlap)
    side_by_height = height / (rows - (rows - 1) * overlap)
    side = int(max(side_by_width, side_by_height)) + 1
    return slices(lattice, side, side - int(side * overlap))


def in_order(windows: Sequence[Window]) -> Order:
    """Return the windows in their order."""

    def order(looks: Sequence[WindowLook], done: set[Window]) -> list[WindowChoice]:
        # The first look was the overview.
        return [(windows[len(looks) - 1], 0.0)] if len(looks) <= len(windows) else []

    return order


def sparse(windows: Sequence[Window], targets: Sequence[int], least: float) -> Order:
    """Return the windows in their order, without those in which the overview shows too little: sparse slicing.

    Args:
        windows: slices, as in slicing-aided hyper inference (SAHI; Akyon, Altinuc and Temizel, 2022).
        targets: classes 1..K; none: any class.
        least: a window is looked at if the highest raw score of the overview in it is at least this.

    Returns:
        The order.
    """
    chosen: list[Window] | None = None

    def order(looks: Sequence[WindowLook], done: set[Window]) -> Sequence[WindowChoice]:
        nonlocal chosen
        if chosen is None:
            chosen = [window for window in windows if raw(looks[0], window, targets, most=True) >= least]
        return in_order(chosen)(looks, done)

    return order


def shuffled(windows: Sequence[Window], seed: Sequence[int]) -> Order:
    """Return the windows in random order."""
    order = np.random.Generator(np.random.PCG64(list(seed))).permutation(len(windows))
    return in_order([windows[n] for n in order])


def quad_tree(lattice: Lattice, target: int | None, *, most: bool) -> Order:
    """Look best first: repeatedly at the quarter of a seen window with the highest raw score.

    Args:
        lattice: lattice of the picture.
        target: class 1..K; None: any class.
        most: rank a window by its highest score; false: by the sum of its scores.

    Returns:
        The order.
    """
    frontier: list[tuple[float, Window]] = []
    # Quarters at the right and bottom borders are moved inside the picture, where two of them may coincide.
    queued = set[Window]()

    def order(looks: Sequence[WindowLook], done: set[Window]) -> list[WindowChoice]:
        for score, window in _quarters(lattice, looks[-1], target, most):
            if window not in queued:
                queued.add(window)
                frontier.append((score, window))
        if not frontier:
            return []
        # The highest score first; among equals the larger window, and the upper left one.
        frontier.sort(key=lambda entry: (-entry[0], entry[1].level, entry[1].cells))
        score, window = frontier.pop(0)
        return [(window, score)]

    return order


def _quarters(lattice: Lattice, look: WindowLook, target: int | None, most: bool) -> list[tuple[float, Window]]:
    """List the quarters of a window on the next level, with their highest or summed scores."""
    level = look.window.level + 1
    if level >= lattice.levels:
        return []
    targets = [] if target is None else [target]
    span = lattice.span(level)
    columns, rows = lattice.places(level)
    left, top = look.window.cells[:2]
    places = set()
    for row in (top, top + span):
        for column in (left, left + span):
            if row < lattice.rows and column < lattice.columns:
                # A window that would reach over the border is moved inside.
                places.add((min(row, rows - 1), min(column, columns - 1)))
    windows = [Window.on(lattice, (level, column, row)) for row, column in sorted(places)]
    return [(raw(look, window, targets, most=most), window) for window in windows]


def oracle(source: WindowLooks, windows: Sequence[Window], finds: Callable[[WindowLook], Tensor], most: int) -> Order:
    """Look repeatedly at the window that shows most of the objects not seen before.

    Args:
        source: the looks at the picture.
        windows: windows to look at.
        finds: which objects a look finds, `(M,)`.
        most: largest number of looks, the overview included.

    Returns:
        The order.
    """
    by_window = torch.stack([finds(look) for look in source.see(windows)])
    seen: list[Tensor] = []

    def order(looks: Sequence[WindowLook], done: set[Window]) -> list[WindowChoice]:
        if len(looks) >= min(most, len(windows)):
            return []
        if len(looks) == 1:
            seen.append(finds(looks[0]))
        new = (by_window & ~torch.stack(seen).any(0)).sum(-1)
        best = int(new.argmax())
        seen.append(by_window[best])
        return [(windows[best], float(new[best]))]

    return order
