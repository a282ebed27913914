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
    r"""Square slices whose number and side follow from the size of the picture, as in ASAHI.

    A picture whose longer side exceeds :math:`512 (4 - 3 l) + 1` pixels is covered by 4 × 3 slices with an overlap l,
    another one by 3 × 2; n × m slices need the side

    .. math:: p = \max\left(\frac{W}{n - (n - 1) l}, \frac{H}{m - (m - 1) l}\right) + 1

    Zhang, H. et al. (2023), Adaptive slicing-aided hyper inference for small object detection in high-resolution remote
    sensing images, Remote Sensing 15(5):1249.
    """
    many = max(lattice.size) > 512 * (4 - 3 * overlap) + 1
    counts = (4, 3) if many else (3, 2)
    side = int(max(length / (n - (n - 1) * overlap) for length, n in zip(lattice.size, counts, strict=True))) + 1
    return slices(lattice, side, side - int(side * overlap))


def in_order(windows: Sequence[Window]) -> Order:
    """Return the windows in their order."""
    return lambda looks, done: [(windows[len(looks) - 1], 0.0)] if len(looks) <= len(windows) else []


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
            chosen = [each for each in windows if raw(looks[0], each, targets, most=True) >= least]
        return in_order(chosen)(looks, done)

    return order


def shuffled(windows: Sequence[Window], seed: Sequence[int]) -> Order:
    """Return the windows in random order."""
    order = np.random.Generator(np.random.PCG64(list(seed))).permutation(len(windows))
    return in_order([windows[n] for n in order])


def quad_tree(lattice: Lattice, target: int | None, *, most: bool) -> Order:
    """Best first: repeatedly the quarter of a seen window with the highest raw score.

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
        new = [entry for entry in _quarters(lattice, looks[-1], target, most) if entry[1] not in queued]
        queued.update(window for _, window in new)
        frontier.extend(new)
        frontier.sort(key=lambda entry: (-entry[0], entry[1].level, entry[1].cells))
        return [frontier.pop(0)[::-1]] if frontier else []

    return order


def _quarters(lattice: Lattice, look: WindowLook, target: int | None, most: bool) -> list[tuple[float, Window]]:
    level = look.window.level + 1
    if level >= lattice.levels:
        return []
    span, (across, down) = lattice.span(level), lattice.places(level)
    left, top = look.window.cells[:2]
    places = sorted(
        {
            (min(top + dy, down - 1), min(left + dx, across - 1))
            for dy in (0, span)
            for dx in (0, span)
            if top + dy < lattice.rows and left + dx < lattice.columns
        }
    )
    windows = [Window.on(lattice, (level, column, row)) for row, column in places]
    return [(raw(look, window, [] if target is None else [target], most=most), window) for window in windows]


def oracle(source: WindowLooks, windows: Sequence[Window], finds: Callable[[WindowLook], Tensor], most: int) -> Order:
    """Repeatedly the window that shows most of the objects not seen before.

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
