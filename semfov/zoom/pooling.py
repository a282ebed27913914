"""Pooling of the hints of a look over windows of cells."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

_CLEAR = 0.02  # score above which a hint counts as clear


def pool(scores: Tensor, box: tuple[int, int, int, int]) -> tuple[Tensor, Tensor]:
    """Pool the hints in a window of cells.

    Args:
        scores: `(rows, columns, K)`, strongest hint of each class in each cell.
        box: cells `(x1, y1, x2, y2)` of the window, which may reach beyond them.

    Returns:
        Strongest hint of each class, `(K,)`; and `(3,)`, over the strongest hints of the cells their sum, the share of
        cells with a hint, and the number of cells with a clear one.
    """
    x1, y1, x2, y2 = box
    cells = scores[max(y1, 0) : y2, max(x1, 0) : x2].flatten(0, 1)
    best = cells.amax(-1)
    share_with_hint = (best > 0).to(best).mean()
    clear_hints = (best > _CLEAR).to(best).sum()
    summary = torch.stack([best.sum(), share_with_hint, clear_hints])
    return cells.amax(0), summary


def pool_spans(scores: Tensor, spans: Sequence[int]) -> list[tuple[Tensor, Tensor]]:
    """Pool the hints in all windows of several sizes, as `pool` does for one.

    Args:
        scores: `(rows, columns, K)`, strongest hint of each class in each cell.
        spans: sides of the windows in cells.

    Returns:
        For each size the strongest hints `(down, across, K)` and the summaries `(down, across, 3)` of its windows.
    """
    rows, columns = scores.shape[:2]
    best = scores.amax(-1)
    maps = torch.stack([best, (best > 0).to(best), (best > _CLEAR).to(best)])
    by_span: dict[int, tuple[Tensor, Tensor]] = {}
    top = scores
    height = 1  # of the windows that `top` is pooled over
    width = 1
    for span in sorted(spans):
        # The peaks of each size are taken over those of the next smaller one.
        top = _slide(top, 0, min(span, rows), height)
        top = _slide(top, 1, min(span, columns), width)
        height = min(span, rows)
        width = min(span, columns)
        # A product of matrices would be faster, but not right after a pass of the detector.
        means = F.avg_pool2d(F.avg_pool2d(maps, (height, 1), 1), (1, width), 1)
        total, hinted, clear = (means * (height * width)).unbind()
        by_span[span] = top, torch.stack([total, hinted / (height * width), clear], -1)
    return [by_span[span] for span in spans]


def _slide(values: Tensor, axis: int, width: int, pooled: int = 1) -> Tensor:
    """Take the largest of every `width` neighbours along an axis, given those of every `pooled`, by doubling."""
    while pooled < width:
        step = min(pooled, width - pooled)
        length = values.shape[axis] - step
        values = torch.maximum(values.narrow(axis, 0, length), values.narrow(axis, step, length))
        pooled += step
    return values
