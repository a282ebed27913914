"""Checks of where boxes lie, which show that the wrong head was chosen for a model."""

import torch
from torch import Tensor

from semfov.detection.onnx_cells import STRIDES, Canvas, box_counts, cells

_LARGEST_FRACTION = 2.0  # coordinates up to here, of all boxes of a canvas, are no pixels
_ALONG_CELLS = 0.8  # correlation of places with cells from which on boxes follow them
_MOST_BOXES = 100_000  # number of boxes whose places are looked at
_CROWD = 20  # number of boxes from which on all of them do not begin in the upper left corner
_MISPLACED_SHARE = 0.5  # share of the boxes of a pass that may lie elsewhere

_AXES_EXCHANGED = [1, 0, 3, 2]  # coordinates of boxes with y before x


def misplacement(boxes: Tensor, canvas: Canvas) -> str | None:
    """Describe why the boxes of one pass cannot be in their places.

    Args:
        boxes: `(B, N, 4)`, corners in canvas pixels.
        canvas: `(width, height)` in pixels.

    Returns:
        The reason in words; None for boxes that can be where they are.
    """
    rows = boxes.detach().reshape(-1, 4).double()
    rows = rows[(rows != 0).any(-1)][:_MOST_BOXES]  # a network that selects boxes itself pads them with empty rows
    if not len(rows):
        return None
    if not bool(rows.isfinite().all()):
        return "boxes that are not finite"
    return _misreading(rows, canvas)


def _misreading(rows: Tensor, canvas: Canvas) -> str | None:
    """Describe which other form boxes `(N, 4)` seem to have that were read as corners in canvas pixels."""
    lower = rows[:, :2]
    upper = rows[:, 2:]
    size = rows.new_tensor(canvas)
    middle = (lower + upper) / 2
    if float(rows.abs().max()) <= _LARGEST_FRACTION < min(canvas):
        return "fractions of the canvas instead of pixels"
    if _share((upper < lower).any(-1)) >= _MISPLACED_SHARE:
        return "boxes whose right or lower edge comes first"
    # Corners `(x1, y1, x2, y2)` read as centre and size give the corners `x1 ± x2 / 2`, of which the upper one is at
    # least three times the lower one, as x2 is at least x1.
    are_three_times = bool((upper >= 3 * lower).all())
    if are_three_times and _spread_out(middle, size):
        return "corners of boxes that were read as their centres and sizes"
    is_outside = ((middle - size / 2).abs() > size).any(-1)
    if _share(is_outside) >= _MISPLACED_SHARE:
        place = middle.median(0).values.round().long().tolist()
        return f"boxes around {place}, outside the canvas"
    return None


def _share(condition: Tensor) -> float:
    """Find the share of boxes that meet a condition, `(N,)`."""
    return float(condition.double().mean())


def axes_exchanged(boxes: Tensor, canvas: Canvas) -> bool:
    """Tell whether the boxes of one pass have y before x.

    Args:
        boxes: `(B, N, 4)`, corners in canvas pixels.
        canvas: `(width, height)` in pixels.

    Returns:
        True for boxes that lie elsewhere, and in their places with their coordinates exchanged. On a square canvas
        boxes can lie in their places in both readings; there, true if they run down where their cells run right.
    """
    if misplacement(boxes, canvas) is None:
        return _down_along_rows(boxes, canvas)
    return misplacement(boxes[..., _AXES_EXCHANGED], canvas) is None


def _spread_out(middle: Tensor, size: Tensor) -> bool:
    """Tell whether the middles `(N, 2)` of boxes are many, and lie over more than a quarter of a canvas `(2,)`."""
    if len(middle) < _CROWD:
        return False
    spread = middle.quantile(0.9, 0) - middle.quantile(0.1, 0)
    return bool((spread > size / 4).all())


def _down_along_rows(boxes: Tensor, canvas: Canvas) -> bool:
    """Tell whether the middles of boxes in the order of cells go down where the finest level's cells go right."""
    # Boxes of a network that selects them are in no order.
    if boxes.shape[1] not in box_counts(canvas):
        return False
    columns, rows = cells(canvas, STRIDES[0])
    cell = torch.arange(columns * rows)
    column = (cell % columns).double()
    row = (cell // columns).double()
    boxes_of_level = boxes[0, : columns * rows].detach().cpu()
    x, y = (boxes_of_level[:, :2] + boxes_of_level[:, 2:]).double().T  # twice the middles, which correlate alike
    correlation = torch.corrcoef(torch.stack([x, y, column, row]))
    return bool((correlation[0, 3] > _ALONG_CELLS) & (correlation[1, 2] > _ALONG_CELLS))
