"""Detections in several crops of a picture around one point, merged into one set."""

from dataclasses import replace

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.objects import unlike

_BORDER = 2.0  # boxes that come this near to a border of their crop, in the detector's pixels, are cut by it


def merge_crops(
    detections: Detections, windows: Tensor, crops: int, side: int, size: tuple[int, int], limit: int
) -> Detections:
    """Merge the detections in the crops of each fixation; windows `(F·L, 4)`, size `(width, height)`."""
    # A box that a finer crop shows whole is left out of the wider ones, which are less sharp there. Others are merged
    # as in windows (`semfov.detection.objects`).
    merged = []
    for first in range(0, len(detections.mask), crops):
        rows = slice(first, first + crops)
        number, row = detections.mask[rows].nonzero(as_tuple=True)
        seen, window = detections[rows][number, row], windows[rows]
        limits = seen.boxes.new_tensor([*size, *size], dtype=seen.boxes.dtype)
        boxes = torch.minimum(seen.boxes.clamp(min=0), limits)
        own = boxes.detach()
        low, high = window[:, :2], window[:, 2:]
        border = _BORDER * (high - low) / side
        near = torch.where(low > 0, low + border, -torch.inf)
        far = torch.where(high < limits[:2], high - border, torch.inf)
        # Which of the boxes `(N, 4)` are whole in which of the crops `(L, 4)`, `(N, L)`.
        whole = ((own[:, None, :2] > near) & (own[:, None, 2:] < far)).all(-1)
        sharper = torch.arange(crops, device=number.device) < number[:, None]
        left = (own[:, 2:] > own[:, :2]).all(-1) & ~(whole & sharper).any(-1)
        index = left.nonzero()[:, 0]
        value, label = seen.scores[index, 1:].detach().max(-1)
        cut = ~whole[index, number[index]]
        columns = (own[index], value, label, number[index], cut, -number[index])
        chosen = index[unlike(*(column.cpu() for column in columns))[:limit].to(index)]
        merged.append(replace(seen, boxes=boxes).take(chosen)[None])
    return merged[0] if len(merged) == 1 else Detections.stack(merged)
