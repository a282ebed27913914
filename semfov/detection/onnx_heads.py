"""Decoders of detection heads: from the tensors that a network gives to every candidate box with all its scores.

Boxes are `(x1, y1, x2, y2)` in canvas pixels, edges between pixels (0 is the left edge of the canvas).
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.detection.scores import Candidates
from semfov.errors import check, check_shape


def cells(canvas: tuple[int, int], stride: int) -> tuple[int, int]:
    """Columns and rows of the map of a level; a canvas that is no multiple of `stride` has one cell more."""
    return -(-canvas[0] // stride), -(-canvas[1] // stride)


def cell_count(canvas: tuple[int, int], strides: Sequence[int]) -> int:
    """Cells of all levels together."""
    return sum(columns * rows for columns, rows in (cells(canvas, stride) for stride in strides))


def grid_points(canvas: tuple[int, int], strides: Sequence[int], offset: float, like: Tensor) -> Tensor:
    """Column and row of every cell plus `offset`, with the stride of its level: `(N, 3)`, row-major, level by level."""
    levels = []
    for stride in strides:
        columns, rows = cells(canvas, stride)
        column = torch.arange(columns, device=like.device, dtype=like.dtype) + offset
        row = torch.arange(rows, device=like.device, dtype=like.dtype) + offset
        x, y = torch.meshgrid(column, row, indexing="xy")
        levels.append(torch.stack([x, y, torch.full_like(x, stride)], -1).reshape(-1, 3))
    return torch.cat(levels)


def decode_yolox(raw: Tensor, canvas: tuple[int, int], strides: Sequence[int] = (8, 16, 32)) -> Candidates:
    """YOLOX (Ge et al. 2021) without its own decoding: for the cell (i, j) of a level with stride s

        c_x = (t_x + i) s,   c_y = (t_y + j) s,   w = s exp(t_w),   h = s exp(t_h)

    Args:
        raw: `(B, N, 5 + K)`: t_x, t_y, t_w, t_h, objectness and classes, the scores in [0, 1].
        canvas: `(width, height)` of the network's input.
        strides: canvas pixels per cell of each level.

    >>> decode_yolox(torch.zeros(1, 1, 6), (32, 32), strides=(32,)).boxes
    tensor([[[-16., -16.,  16.,  16.]]])
    """
    check_shape(raw, "raw", None, None, None)
    grid = _grid(raw, canvas, strides, 0.0)
    centre = (raw[..., 0:2] + grid[:, :2]) * grid[:, 2:]
    size = raw[..., 2:4].exp() * grid[:, 2:]
    return Candidates(_corners(torch.cat([centre, size], -1)), raw[..., 5:], raw[..., 4])


def decode_yolov5(rows: Tensor) -> Candidates:
    """YOLOv5-style rows, boxes decoded by the network: centre, size (canvas pixels), objectness, classes.

    Args:
        rows: `(B, N, 5 + K)`.

    >>> decode_yolov5(torch.tensor([[[8.0, 8.0, 4.0, 2.0, 0.5, 1.0]]])).boxes
    tensor([[[ 6.,  7., 10.,  9.]]])
    """
    check_shape(rows, "rows", None, None, None)
    return Candidates(_corners(rows[..., :4]), rows[..., 5:], rows[..., 4])


def decode_yolov8(columns: Tensor) -> Candidates:
    """YOLOv8-style columns, boxes decoded by the network: centre, size (canvas pixels), classes; no objectness.

    Args:
        columns: `(B, 4 + K, N)`.

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
    r"""Boxes as distributions over the distance to each side (distribution focal loss, Li et al. 2020).

    From the point `p = (cell + offset) s` to the left, upper, right and lower side: `d = s Σ_b b softmax(t)_b`.

    Args:
        classes: `(B, N, K)` in [0, 1], the cells of all levels.
        distances: `(B, N, 4 bins)`.
        canvas: `(width, height)` of the network's input.
        strides: canvas pixels per cell of each level.
        offset: where in its cell a point lies; PicoDet and NanoDet 0.5, NanoDet-Plus 0.

    >>> decode_distances(torch.ones(1, 1, 2), torch.zeros(1, 1, 12), (8, 8), strides=(8,)).boxes
    tensor([[[-4., -4., 12., 12.]]])
    """
    check_shape(classes, "classes", None, None, None)
    check_shape(distances, "distances", None, classes.shape[1], None)
    bins = distances.shape[-1] // 4
    check(bins > 0 and distances.shape[-1] == 4 * bins, "distances", "4 · bins channels", tuple(distances.shape))
    grid = _grid(distances, canvas, strides, offset)
    expected = distances.unflatten(-1, (4, bins)).softmax(-1) @ torch.arange(bins).to(distances)
    point, reach = grid[:, :2] * grid[:, 2:], expected * grid[:, 2:]
    return Candidates(torch.cat([point - reach[..., :2], point + reach[..., 2:]], -1), classes)


def decode_detr(logits: Tensor, boxes: Tensor, canvas: tuple[int, int]) -> Candidates:
    """DETR (Carion et al. 2020): a softmax over the classes and "no object", which comes last and is background.

    Args:
        logits: `(B, Q, K + 1)`.
        boxes: `(B, Q, 4)`, centre and size as fractions of the canvas.
        canvas: `(width, height)` of the network's input.

    >>> decode_detr(torch.zeros(1, 1, 4), torch.tensor([[[0.5, 0.5, 1.0, 0.5]]]), (8, 8)).background
    tensor([[0.2500]])
    """
    check_shape(logits, "logits", None, None, None)
    scores = logits.softmax(-1)
    return Candidates(_fractions(boxes, canvas), scores[..., :-1], background=scores[..., -1])


def decode_rtdetr(logits: Tensor, boxes: Tensor, canvas: tuple[int, int]) -> Candidates:
    """RT-DETR and the other DETRs trained with focal loss: a sigmoid for each class, no "no object".

    Args:
        logits: `(B, Q, K)`.
        boxes: `(B, Q, 4)`, centre and size as fractions of the canvas.
        canvas: `(width, height)` of the network's input.

    >>> decode_rtdetr(torch.zeros(1, 1, 4), torch.tensor([[[0.5, 0.5, 1.0, 0.5]]]), (8, 8)).boxes
    tensor([[[0., 2., 8., 6.]]])
    """
    check_shape(logits, "logits", None, None, None)
    return Candidates(_fractions(boxes, canvas), logits.sigmoid())


def decode_rtdetr_rows(rows: Tensor, canvas: tuple[int, int]) -> Candidates:
    """RT-DETR in one tensor: centre and size as fractions of the canvas, then class scores in [0, 1].

    Args:
        rows: `(B, Q, 4 + K)`.
        canvas: `(width, height)` of the network's input.

    >>> decode_rtdetr_rows(torch.tensor([[[0.5, 0.5, 1.0, 0.5, 0.9]]]), (8, 8)).boxes
    tensor([[[0., 2., 8., 6.]]])
    """
    check_shape(rows, "rows", None, None, None)
    return Candidates(_fractions(rows[..., :4], canvas), rows[..., 4:])


def _grid(tensor: Tensor, canvas: tuple[int, int], strides: Sequence[int], offset: float) -> Tensor:
    expected = cell_count(canvas, strides)
    what = f"{expected} rows, the cells of a {canvas[0]} x {canvas[1]} canvas at strides {tuple(strides)}"
    check(tensor.shape[1] == expected, "output of the head", what, tensor.shape[1])
    return grid_points(canvas, strides, offset, tensor)


def _corners(boxes: Tensor) -> Tensor:
    centre, half = boxes[..., :2], boxes[..., 2:] / 2
    return torch.cat([centre - half, centre + half], -1)


def _fractions(boxes: Tensor, canvas: tuple[int, int]) -> Tensor:
    check_shape(boxes, "boxes", None, None, 4)
    return _corners(boxes) * boxes.new_tensor(canvas * 2)
