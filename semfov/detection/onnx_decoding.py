"""Formulas by which heads of ONNX models place boxes: tensors in, `Candidates` out.

In shapes, B are images, N boxes, Q queries and K classes. Decoded boxes are `(x1, y1, x2, y2)` in canvas pixels, edges
between pixels (0 is the left edge of the canvas).
"""

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from semfov.detection.class_names import NAMING
from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_signature import selected_outputs
from semfov.detection.scores import Candidates
from semfov.errors import InputError, check, check_shape, values_known

COLUMNS = 7
"""Numbers in a row of `rows_of_images`."""

_FEW = 64  # cells


def likely_rows(bound: Tensor, least: float) -> Tensor:
    """Find the rows of a head that may have a confidence in some image of a batch.

    Args:
        bound: `(B, N)`, a score that the confidence of a row does not exceed.
        least: the confidence.

    Returns:
        Numbers of the rows in their order, `(M,)`. NaN may stand for any score, so that its row is among them.

    >>> likely_rows(torch.tensor([[0.1, 0.5, 0.0], [0.1, 0.0, 0.7]]), 0.2)
    tensor([1, 2])
    """
    return (~(bound < least)).any(0).nonzero()[:, 0]


def decode_yolox(raw: Tensor, grid: Tensor) -> Candidates:
    """Decode offsets from cells and logarithms of sizes (YOLOX, Ge et al. 2021).

    For the cell (i, j) of a level with stride s, centre and size of the box are

        c_x = (t_x + i) s,   c_y = (t_y + j) s,   w = s exp(t_w),   h = s exp(t_h)

    Args:
        raw: `(B, N, 5 + K)`: `t_x t_y t_w t_h`, objectness, class scores of each cell.
        grid: column i, row j and stride s in pixels of each cell, `(..., N, 3)`.

    Returns:
        The boxes, with objectness.
    """
    cell = grid[..., :2]
    stride = grid[..., 2:]
    offset = raw[..., 0:2]
    log_size = raw[..., 2:4]
    centre = (offset + cell) * stride
    size = log_size.exp() * stride
    boxes = corners(torch.cat([centre, size], -1))
    return Candidates(boxes, classes=raw[..., 5:], objectness=raw[..., 4])


def check_offsets(raw: Tensor) -> None:
    """Raise `InputError` where rows `(B, N, 5 + K)` for `decode_yolox` hold boxes as fractions of the canvas instead.

    They have the same shape. All rows of a pass tell, and not a few of them.
    """
    expected = "offsets from cells and logarithms of sizes, some of them below 0"
    got = "numbers from 0 to 1, as fractions of the canvas"
    check(not _are_fractions(raw[..., :4]), "output of the head", expected, got)


def _are_fractions(boxes: Tensor) -> bool:
    """Tell whether all numbers of boxes `(B, N, 4)` are known to lie from 0 to 1, and are not all the same."""
    if not values_known(boxes) or not boxes.numel():
        return False
    # Mostly a few cells tell, and not all need to be read.
    if not _lie_in_unit(boxes[:, :_FEW]) or not _lie_in_unit(boxes):
        return False
    return bool((boxes != boxes[0, 0, 0]).any())


def _lie_in_unit(numbers: Tensor) -> bool:
    """Whether all numbers lie from 0 to 1."""
    least, greatest = map(float, numbers.detach().aminmax())
    return least >= 0 and greatest <= 1


def decode_yolov5(rows: Tensor) -> Candidates:
    """Decode rows whose boxes the network itself has placed.

    Args:
        rows: `(B, N, 5 + K)`: centre and size of the box in canvas pixels, objectness, class scores.

    Returns:
        The boxes, with objectness.
    """
    check_shape(rows, "rows", None, None, None)
    return Candidates(corners(rows[..., :4]), rows[..., 5:], rows[..., 4])


def decode_yolov8(columns: Tensor) -> Candidates:
    """Decode columns whose boxes the network itself has placed.

    Args:
        columns: `(B, 4 + K, N)`: centre and size of the box in canvas pixels, class scores.

    Returns:
        The boxes, without objectness.
    """
    check_shape(columns, "columns", None, None, None)
    rows = columns.transpose(1, 2)
    return Candidates(corners(rows[..., :4]), rows[..., 4:])


def decode_end_to_end(rows: Tensor, classes: int | None) -> Candidates:
    """Decode rows that a network has selected itself: the score of the class of a box, and 0 for all other classes.

    Args:
        rows: `(B, N, 6)`: corners of the box in canvas pixels, score, number of the class from 0.
        classes: number of classes K.

    Returns:
        The boxes, without objectness.

    Raises:
        InputError: K is unknown, or the rows number other classes.
    """
    if classes is None:
        expected = "the names of the model's classes, which its rows only number"
        raise InputError(f"classes: expected {expected}, got None; {NAMING}")
    check_shape(rows, "rows", None, None, 6)
    scores = rows[..., 4]
    numbers = rows[..., 5]
    if values_known(rows):
        _check_numbers_of_classes(numbers[scores > 0], classes)
    # Rows without a score are padding, whose class may be any number, or NaN.
    index = numbers.nan_to_num(0).long().clamp(0, max(classes - 1, 0))
    nothing = scores.new_zeros(*scores.shape, classes)  # (B, N, K)
    vectors = nothing.scatter(-1, index[..., None], scores[..., None])
    return Candidates(rows[..., :4], vectors)


def rows_of_images(flat: Tensor, images: int) -> Tensor:
    """Divide the rows that a network has selected in all images of a pass by their images, as YOLOv7 exports them.

    Args:
        flat: `(N, 7)`: number of the image from 0, corners of the box, number of the class, score.
        images: number of images B.

    Returns:
        `(B, L, 6)`, rows of `decode_end_to_end`; after the last row of an image follow zeros.

    Raises:
        InputError: a row is of no image.

    >>> rows_of_images(torch.tensor([[1.0, 2, 3, 8, 9, 5, 0.5]]), images=2)[1].tolist()
    [[2.0, 3.0, 8.0, 9.0, 0.5, 5.0]]
    """
    number = flat[:, 0]
    is_of_image = number == torch.arange(images).to(flat)[:, None]  # (B, N)
    are_known = bool(is_of_image.any(0).all())
    check(
        are_known, "rows", f"the number of an image, from 0 to {images - 1}, in the first column", number[:3].tolist()
    )
    # Selected rows of other networks have the score before the class.
    rows = flat[:, [1, 2, 3, 4, 6, 5]]
    return pad_sequence([rows[of_image] for of_image in is_of_image], batch_first=True)


def _check_numbers_of_classes(numbers: Tensor, classes: int) -> None:
    """Raise `InputError` unless numbers `(M,)` of classes are whole, from 0 to `classes - 1`."""
    integral = bool((numbers == numbers.round()).all())
    check(integral, "rows", "a whole number of a class in the last column", numbers[:3].tolist())
    if len(numbers):
        inside = float(numbers.min()) >= 0 and float(numbers.max()) < classes
        check(inside, "classes", "a name for each class of the rows", f"{classes}, and class {numbers.max():g}")


def decode_selected(outputs: Mapping[str, Tensor], classes: int | None) -> Candidates:
    """Decode the outputs of a network that selects boxes itself, as rows of `decode_end_to_end`.

    Args:
        outputs: boxes `(B, N, 4)`, corners in canvas pixels; scores `(B, N)`, or the fifth column of the boxes; labels
            `(B, N)`, numbers of classes from 0; and perhaps the number of boxes of each image, `(B,)` or `(B, 1)`,
            after which boxes are padding.
        classes: number of classes K.

    Returns:
        The boxes, without objectness; padding has scores of 0.
    """
    selected = selected_outputs(outputs)
    boxes = selected["boxes"]
    labels = selected["labels"]
    check_shape(labels, "labels", None, None)
    # mmdeploy writes the score of a box beside its corners.
    scores = selected["scores"] if "scores" in selected else boxes[..., 4]
    if "count" in selected:
        place = torch.arange(scores.shape[1], device=scores.device)
        is_box = place < selected["count"].reshape(-1, 1)  # (B, N); what follows is padding
        scores = scores * is_box
    rows = torch.cat([boxes[..., :4], scores[..., None], labels[..., None]], -1)
    return decode_end_to_end(rows, classes)


def decode_distances(scores: Tensor, distances: Tensor, grid: Tensor) -> Candidates:
    r"""Decode boxes given as distributions over the distance to each side (distribution focal loss, Li et al. 2020).

    The distance from the point `p = s (i, j)` to the left, upper, right or lower side is `d = s Σ_b b softmax(t)_b`.

    Args:
        scores: class scores `(B, N, K)` of the cells.
        distances: `t`, `(B, N, 4 bins)`.
        grid: column i, row j and stride s in pixels of the point of each cell, `(..., N, 3)`.

    Returns:
        The boxes, without objectness.
    """
    check_shape(scores, "classes", None, None, None)
    check_shape(distances, "distances", None, scores.shape[1], None)
    shape = tuple(distances.shape)
    bins, rest = divmod(shape[-1], 4)
    expected = "4 · bins channels, the same number of bins for each side"
    check(bins > 0 and rest == 0, "distances", expected, shape)
    stride = grid[..., 2:]
    point = grid[..., :2] * stride
    chances = distances.unflatten(-1, (4, bins)).softmax(-1)  # (B, N, 4, bins)
    bin_numbers = torch.arange(bins).to(distances)
    distance = chances @ bin_numbers * stride  # (B, N, 4), to the left, upper, right and lower side
    upper_left = point - distance[..., :2]
    lower_right = point + distance[..., 2:]
    boxes = torch.cat([upper_left, lower_right], -1)
    return Candidates(boxes, scores)


def decode_detr(logits: Tensor, boxes: Tensor, canvas: Canvas) -> Candidates:
    """Decode the queries of a DETR with a softmax over the classes and "no object".

    Args:
        logits: `(B, Q, K + 1)`, "no object" last.
        boxes: `(B, Q, 4)`, centre and size as fractions of the canvas.
        canvas: `(width, height)` in pixels.

    Returns:
        The boxes, with "no object" as their background.
    """
    check_shape(logits, "logits", None, None, None)
    scores = logits.softmax(-1)
    no_object = scores[..., -1]
    return Candidates(fraction_corners(boxes, canvas), scores[..., :-1], background=no_object)


def corners(boxes: Tensor) -> Tensor:
    """Convert boxes from centre and size to corners.

    Args:
        boxes: `(..., 4)`, `(c_x, c_y, width, height)`.

    Returns:
        `(..., 4)`, `(x1, y1, x2, y2)`, in the same unit.
    """
    centre = boxes[..., :2]
    half = boxes[..., 2:] / 2
    return torch.cat([centre - half, centre + half], -1)


def fraction_corners(boxes: Tensor, canvas: Canvas) -> Tensor:
    """Convert boxes from centre and size, as fractions of a canvas, to corners in pixels.

    Args:
        boxes: `(..., 4)`, `(c_x, c_y, width, height)` as fractions.
        canvas: `(width, height)` in pixels.

    Returns:
        `(..., 4)`, `(x1, y1, x2, y2)` in canvas pixels.
    """
    check_shape(boxes, "boxes", None, None, 4)
    return corners(boxes) * boxes.new_tensor(canvas * 2)
