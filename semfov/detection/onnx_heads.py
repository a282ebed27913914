"""Decoders of detection heads: from the output tensors of a network to all boxes with all their scores.

Boxes are `(x1, y1, x2, y2)` in canvas pixels, edges between pixels (0 is the left edge of the canvas).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.detection.scores import Candidates
from semfov.errors import check, check_shape


def cells(canvas: tuple[int, int], stride: int) -> tuple[int, int]:
    """Columns and rows of the map of a level, rounded up where the canvas is not a multiple of `stride`."""
    return -(-canvas[0] // stride), -(-canvas[1] // stride)


def cell_count(canvas: tuple[int, int], strides: Sequence[int]) -> int:
    """Total number of cells of all levels."""
    return sum(columns * rows for columns, rows in (cells(canvas, stride) for stride in strides))


def grid_points(canvas: tuple[int, int], strides: Sequence[int], offset: float, like: Tensor) -> Tensor:
    """Column plus `offset`, row plus `offset`, and stride of every cell, `(N, 3)`, level by level and row-major."""
    levels = []
    for stride in strides:
        columns, rows = cells(canvas, stride)
        column = torch.arange(columns, device=like.device, dtype=like.dtype) + offset
        row = torch.arange(rows, device=like.device, dtype=like.dtype) + offset
        x, y = torch.meshgrid(column, row, indexing="xy")
        levels.append(torch.stack([x, y, torch.full_like(x, stride)], -1).reshape(-1, 3))
    return torch.cat(levels)


def decode_yolox(raw: Tensor, canvas: tuple[int, int], strides: Sequence[int] = (8, 16, 32)) -> Candidates:
    """Decode the raw output of YOLOX (Ge et al. 2021).

    For the cell (i, j) of a level with stride s, centre and size of the box are

        c_x = (t_x + i) s,   c_y = (t_y + j) s,   w = s exp(t_w),   h = s exp(t_h)

    Args:
        raw: `(B, N, 5 + K)`: t_x, t_y, t_w, t_h, then objectness and class scores in [0, 1].
        canvas: `(width, height)` of the network's input.
        strides: canvas pixels per cell of each level.

    Returns:
        All boxes with their scores.

    >>> decode_yolox(torch.zeros(1, 1, 6), (32, 32), strides=(32,)).boxes
    tensor([[[-16., -16.,  16.,  16.]]])
    """
    check_shape(raw, "raw", None, None, None)
    grid = _grid(raw, canvas, strides, 0.0)
    centre = (raw[..., 0:2] + grid[:, :2]) * grid[:, 2:]
    size = raw[..., 2:4].exp() * grid[:, 2:]
    return Candidates(_corners(torch.cat([centre, size], -1)), raw[..., 5:], raw[..., 4])


def decode_yolov5(rows: Tensor) -> Candidates:
    """Decode YOLOv5-style rows, whose boxes the network itself has decoded.

    Args:
        rows: `(B, N, 5 + K)`: centre and size in canvas pixels, objectness, class scores.

    Returns:
        All boxes with their scores.

    >>> decode_yolov5(torch.tensor([[[8.0, 8.0, 4.0, 2.0, 0.5, 1.0]]])).boxes
    tensor([[[ 6.,  7., 10.,  9.]]])
    """
    check_shape(rows, "rows", None, None, None)
    return Candidates(_corners(rows[..., :4]), rows[..., 5:], rows[..., 4])


def decode_yolov8(columns: Tensor) -> Candidates:
    """Decode YOLOv8-style columns, whose boxes the network itself has decoded.

    Args:
        columns: `(B, 4 + K, N)`: centre and size in canvas pixels, class scores; there is no objectness.

    Returns:
        All boxes with their scores.

    >>> decode_yolov8(torch.tensor([[[8.0], [8.0], [4.0], [2.0], [1.0]]])).boxes
    tensor([[[ 6.,  7., 10.,  9.]]])
    """
    check_shape(columns, "columns", None, None, None)
    rows = columns.transpose(1, 2)
    return Candidates(_corners(rows[..., :4]), rows[..., 4:])


def decode_distances(
    classes: Tensor,
    distances: Tensor,
    canvas: tuple[int, int],
    *,
    strides: Sequence[int] = (8, 16, 32, 64),
    offset: float = 0.5,
) -> Candidates:
    r"""Decode boxes given as distributions over the distance to each side (distribution focal loss, Li et al. 2020).

    The distance from the point `p = (cell + offset) s` to the left, upper, right or lower side is
    `d = s Σ_b b softmax(t)_b`.

    Args:
        classes: class scores `(B, N, K)` in [0, 1], for the cells of all levels.
        distances: `(B, N, 4 bins)`, the logits t of each side.
        canvas: `(width, height)` of the network's input.
        strides: canvas pixels per cell of each level, s.
        offset: position of the point in its cell: 0.5 for PicoDet and NanoDet, 0 for NanoDet-Plus.

    Returns:
        All boxes with their scores.

    >>> decode_distances(torch.ones(1, 1, 2), torch.zeros(1, 1, 12), (8, 8), strides=(8,)).boxes
    tensor([[[-4., -4., 12., 12.]]])
    """
    check_shape(classes, "classes", None, None, None)
    check_shape(distances, "distances", None, classes.shape[1], None)
    bins = distances.shape[-1] // 4
    whole = bins > 0 and distances.shape[-1] == 4 * bins
    check(whole, "distances", "4 · bins channels, the same number of bins for each side", tuple(distances.shape))
    grid = _grid(distances, canvas, strides, offset)
    expected = distances.unflatten(-1, (4, bins)).softmax(-1) @ torch.arange(bins).to(distances)
    point, reach = grid[:, :2] * grid[:, 2:], expected * grid[:, 2:]
    return Candidates(torch.cat([point - reach[..., :2], point + reach[..., 2:]], -1), classes)


def decode_detr(logits: Tensor, boxes: Tensor, canvas: tuple[int, int]) -> Candidates:
    """Decode DETR (Carion et al. 2020), whose scores are a softmax over the classes and "no object".

    Args:
        logits: `(B, Q, K + 1)`; the last one, "no object", is taken as background.
        boxes: `(B, Q, 4)`, centre and size as fractions of the canvas.
        canvas: `(width, height)` of the network's input.

    Returns:
        All boxes with their scores and the background probability.

    >>> decode_detr(torch.zeros(1, 1, 4), torch.tensor([[[0.5, 0.5, 1.0, 0.5]]]), (8, 8)).background
    tensor([[0.2500]])
    """
    check_shape(logits, "logits", None, None, None)
    scores = logits.softmax(-1)
    return Candidates(_fractions(boxes, canvas), scores[..., :-1], background=scores[..., -1])


def decode_rtdetr(logits: Tensor, boxes: Tensor, canvas: tuple[int, int]) -> Candidates:
    """Decode RT-DETR and other DETRs trained with focal loss: a sigmoid for each class, without "no object".

    Args:
        logits: `(B, Q, K)`.
        boxes: `(B, Q, 4)`, centre and size as fractions of the canvas.
        canvas: `(width, height)` of the network's input.

    Returns:
        All boxes with their scores.

    >>> decode_rtdetr(torch.zeros(1, 1, 4), torch.tensor([[[0.5, 0.5, 1.0, 0.5]]]), (8, 8)).boxes
    tensor([[[0., 2., 8., 6.]]])
    """
    check_shape(logits, "logits", None, None, None)
    return Candidates(_fractions(boxes, canvas), logits.sigmoid())


def decode_rtdetr_rows(rows: Tensor, canvas: tuple[int, int]) -> Candidates:
    """Decode RT-DETR that returns one tensor.

    Args:
        rows: `(B, Q, 4 + K)`: centre and size as fractions of the canvas, then class scores in [0, 1].
        canvas: `(width, height)` of the network's input.

    Returns:
        All boxes with their scores.

    >>> decode_rtdetr_rows(torch.tensor([[[0.5, 0.5, 1.0, 0.5, 0.9]]]), (8, 8)).boxes
    tensor([[[0., 2., 8., 6.]]])
    """
    check_shape(rows, "rows", None, None, None)
    return Candidates(_fractions(rows[..., :4], canvas), rows[..., 4:])


def _grid(tensor: Tensor, canvas: tuple[int, int], strides: Sequence[int], offset: float) -> Tensor:
    expected = cell_count(canvas, strides)
    what = f"{expected} rows, one for each cell of a {canvas[0]} x {canvas[1]} canvas at strides {tuple(strides)}"
    check(tensor.shape[1] == expected, "output of the head", what, tensor.shape[1])
    return grid_points(canvas, strides, offset, tensor)


def _corners(boxes: Tensor) -> Tensor:
    centre, half = boxes[..., :2], boxes[..., 2:] / 2
    return torch.cat([centre - half, centre + half], -1)


def _fractions(boxes: Tensor, canvas: tuple[int, int]) -> Tensor:
    check_shape(boxes, "boxes", None, None, 4)
    return _corners(boxes) * boxes.new_tensor(canvas * 2)
