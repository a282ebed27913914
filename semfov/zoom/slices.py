"""Slices of a picture, and their order by the raw scores of the overview: a choice of windows that learns nothing."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.zoom.episode import Order
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.policy import WindowChoice


def slices(lattice: Lattice, side: int, step: int) -> list[Window]:
    """Square slices of a picture row by row; the last ones are moved inside the picture, as SAHI cuts them."""
    (width, height), lasts = lattice.size, (max(length - side, 0) for length in lattice.size)
    columns, rows = (sorted({*range(0, last, step), last}) for last in lasts)
    boxes = [(x, y, min(x + side, width), min(y + side, height)) for y in rows for x in columns]
    return [Window.around(lattice, (float(x1), float(y1), float(x2), float(y2))) for x1, y1, x2, y2 in boxes]


def usual_slices(lattice: Lattice, blank: Tensor | None = None) -> list[Window]:
    """Slices as people cut them, which overlap by a fifth, without those of `blank` cells alone."""
    if lattice.levels == 1:
        side = max(1, round(0.6 * max(lattice.size)))
    else:
        side = round((1.5 if lattice.levels > 2 else 1.0) * min(lattice.canvas) / lattice.magnifications[-1])
    windows = slices(lattice, side, max(1, int(side * (1 - 0.2))))
    if blank is None:
        return windows
    shown = [blank[y1:y2, x1:x2] for x1, y1, x2, y2 in (each.cells for each in windows)]
    return [each for each, part in zip(windows, shown, strict=True) if not part.all()] or windows


def ranked(windows: Sequence[Window], targets: Sequence[int] = (), *, most: bool = False) -> Order:
    """The windows in descending order of the overview's raw scores in them."""
    ranking: list[WindowChoice] = []
    ranked_by: WindowLook | None = None

    def order(looks: Sequence[WindowLook], done: set[Window]) -> list[WindowChoice]:
        nonlocal ranked_by
        if looks[0] is not ranked_by:
            ranked_by = looks[0]
            values = torch.tensor([raw(ranked_by, window, targets, most=most) for window in windows])
            places = values.argsort(descending=True, stable=True).tolist()
            ranking[:] = [(windows[place], float(values[place])) for place in places]
        return next(([choice] for choice in ranking if choice[0] not in done), [])

    return order


def raw(window_look: WindowLook, window: Window, targets: Sequence[int] = (), *, most: bool = False) -> float:
    """Value of a window by the raw scores of a coarser look: their sum, or the highest, over its cells."""
    if window_look.hints is not None:
        boxes, within = (
            window_look.hints.boxes,
            window_look.hints.boxes.new_tensor(window.within or (0.0, 0.0, 1e9, 1e9)),
        )
        centre = (boxes[:, :2] + boxes[:, 2:]) / 2
        part = window_look.hints.scores[((within[:2] <= centre) & (centre < within[2:])).all(-1)]
    else:
        look = window_look.gist
        assert look is not None
        x1, y1, x2, y2 = window.cells
        left, top = look.first
        box = [(n - first) / look.scale for n, first in zip((x1, y1, x2, y2), (left, top) * 2, strict=True)]
        columns = slice(max(int(box[0]), 0), max(-int(-box[2] // 1), 0))
        rows = slice(max(int(box[1]), 0), max(-int(-box[3] // 1), 0))
        part = look.scores[rows, columns]
    scores = (part[..., [target - 1 for target in targets]] if len(targets) else part).amax(-1)
    if not scores.numel():
        return 0.0
    return float(scores.max() if most else scores.sum())
