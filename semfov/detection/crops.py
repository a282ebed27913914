"""Detections in several crops of a picture around one point, merged into one set.

The crops of a fixation lie within each other, the finest first. A box that a finer crop shows in full is left out of
the wider ones, which are less sharp there. Others are merged as in windows (`semfov.detection.objects`).
"""

from dataclasses import replace

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.objects import unlike

_BORDER = 2.0  # boxes that come this near to a border of their crop, in the detector's pixels, are cut by it


def merge_crops(
    detections: Detections,
    windows: Tensor,
    crops: int,
    side: int,
    size: tuple[int, int],
    limit: int,
) -> Detections:
    """Merge the detections in the crops of each fixation.

    Args:
        detections: the detections in each crop, in picture pixels, of F fixations with L crops each.
        windows: `(F·L, 4)`, the crops as boxes `(x1, y1, x2, y2)` in picture pixels.
        crops: number L of crops of a fixation.
        side: side of the detector's input in pixels.
        size: `(width, height)` of the picture.
        limit: largest number of detections of a fixation.

    Returns:
        The detections of each fixation.
    """
    merged = []
    for first in range(0, len(detections.mask), crops):
        fixation = slice(first, first + crops)
        merged.append(_merge_fixation(detections[fixation], windows[fixation], side, size, limit))
    return merged[0] if len(merged) == 1 else Detections.stack(merged)


def _merge_fixation(
    detections: Detections, windows: Tensor, side: int, size: tuple[int, int], limit: int
) -> Detections:
    """Merge the detections in the crops of one fixation.

    Args:
        detections: the detections in each of L crops, the finest first, in picture pixels.
        windows: the crops, `(L, 4)` in picture pixels.
        side: side of the detector's input in pixels.
        size: `(width, height)` of the picture.
        limit: largest number of detections.

    Returns:
        One image of detections.
    """
    crop, row = detections.mask.nonzero(as_tuple=True)
    rows = detections[crop, row]
    picture = rows.boxes.new_tensor([*size, *size], dtype=rows.boxes.dtype)
    rows = replace(rows, boxes=torch.minimum(rows.boxes.clamp(min=0), picture))
    boxes = rows.boxes.detach()

    # A box stays unless a finer crop shows it in full, or it has no area inside the picture.
    in_full = _shown_in_full(boxes, windows, picture[:2], side)
    is_finer = torch.arange(len(windows), device=crop.device) < crop[:, None]
    sharper_elsewhere = (in_full & is_finer).any(-1)
    has_area = (boxes[:, 2:] > boxes[:, :2]).all(-1)
    index = (has_area & ~sharper_elsewhere).nonzero()[:, 0]

    crop = crop[index]
    score, label = rows.scores[index, 1:].detach().max(-1)
    is_cut = ~in_full[index, crop]
    # The finest crop is the first, and the sharpest.
    distinct = unlike(
        boxes[index].cpu(), score.cpu(), label.cpu(), looks=crop.cpu(), cut=is_cut.cpu(), sharpness=-crop.cpu()
    )
    objects = index[distinct[:limit].to(index)]
    found = rows.take(objects)[None]
    return replace(found, highest=detections.highest.amax(0, keepdim=True))


def _shown_in_full(boxes: Tensor, windows: Tensor, picture: Tensor, side: int) -> Tensor:
    """Tell which boxes `(N, 4)` lie in which crops `(L, 4)` without being cut by their borders, `(N, L)`.

    The borders of the picture `(2,)` cut no box.
    """
    lower = windows[:, :2]
    upper = windows[:, 2:]
    border = _BORDER * (upper - lower) / side
    lowest = torch.where(lower > 0, lower + border, -torch.inf)
    highest = torch.where(upper < picture, upper - border, torch.inf)
    begins_inside = boxes[:, None, :2] > lowest
    ends_inside = boxes[:, None, 2:] < highest
    return (begins_inside & ends_inside).all(-1)
