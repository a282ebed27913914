"""The training loss of YOLOv3 (Redmon and Farhadi 2018), as a function of the raw maps of its heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.detection.darknet_layers import Head
from semfov.detection.yolo import decode_yolo
from semfov.errors import check, check_shape
from semfov.observation.matching import box_iou


@dataclass(frozen=True)
class Losses:
    """The parts of the loss, each a sum over the images of a batch.

    Attributes:
        objectness: cross-entropies of whether an object is assigned to a box.
        classes: cross-entropies of the classes, for boxes with an object.
        boxes: errors of the positions and sizes of these boxes.
    """

    objectness: Tensor
    classes: Tensor
    boxes: Tensor

    @property
    def total(self) -> Tensor:
        """The sum of the parts, which is minimised in training."""
        return self.objectness + self.classes + self.boxes

    def __add__(self, other: Self) -> Self:
        """Add the losses of two batches."""
        return type(self)(self.objectness + other.objectness, self.classes + other.classes, self.boxes + other.boxes)


@dataclass(frozen=True)
class _Assigned:
    """Boxes of a head that objects are assigned to: their position in the map, and the number of the object."""

    image: Tensor
    row: Tensor
    column: Tensor
    anchor: Tensor
    truth: Tensor


def yolo_loss(
    maps: Sequence[Tensor],
    heads: Sequence[Head],
    canvas: tuple[int, int],
    boxes: Sequence[Tensor],
    labels: Sequence[Tensor],
    *,
    ignore: float = 0.5,
) -> Losses:
    r"""Compute the loss of YOLOv3 on a batch (Redmon and Farhadi 2018, sections 2.1 and 2.2).

    Each object is assigned to one predicted box: in the cell of its centre, with the anchor of the most similar shape
    among all heads. (If two heads have the same anchor, the object is assigned to both. If two objects are assigned to
    the same box, the later one gets it.) With the object's centre :math:`(c_x, c_y)` as fractions of that cell, its
    size :math:`(w, h)`, the anchor's size :math:`(p_w, p_h)` and the canvas' size :math:`(W, H)`, the loss of the
    assigned box :math:`t` is

    .. math:: \Big(2 - \frac{w h}{W H}\Big) \Big( \sum_{a \in x, y} H(c_a, \sigma(t_a))
              + \frac12 \Big(t_w - \ln \frac{w}{p_w}\Big)^2 + \frac12 \Big(t_h - \ln \frac{h}{p_h}\Big)^2 \Big)
              + H(1, \sigma(t_o)) + \sum_k H([k = label], \sigma(t_k))

    where :math:`H` is the binary cross-entropy. The loss of all other boxes is :math:`H(0, \sigma(t_o))`, except that
    it is 0 for predicted boxes that overlap an object by more than `ignore`. The gradient is the same as Darknet's.

    Args:
        maps: raw maps of the heads, each `(B, A (5 + K), h, w)`, as `Darknet` returns them.
        heads: the heads, with their anchors and classes.
        canvas: `(width, height)` of the images in pixels.
        boxes: boxes of the objects in each image, `(M, 4)`, `(x1, y1, x2, y2)` in canvas pixels, with an area above 0.
        labels: classes of the objects in each image, `(M,)`, 1..K.
        ignore: overlap (IoU) above which a box is not trained as background (the paper: 0.5).

    Returns:
        The parts of the loss, summed over images.

    Raises:
        InputError: the shapes of maps, heads, boxes and labels are inconsistent.

    >>> head = Head(((8.0, 8.0),), classes=2)
    >>> losses = yolo_loss([torch.zeros(1, 7, 2, 2)], [head], (16, 16), [torch.zeros(0, 4)], [torch.zeros(0).long()])
    >>> round(float(losses.total), 4)  # four boxes without an object: 4 ln 2
    2.7726
    """
    check(len(maps) == len(heads), "maps", f"one for each of {len(heads)} heads", len(maps))
    check(len(boxes) == len(labels), "labels", f"one tensor for each of {len(boxes)} images", len(labels))
    for raw, head in zip(maps, heads, strict=True):
        check_shape(raw, "maps", len(boxes), head.channels, None, None)
    for own, names in zip(boxes, labels, strict=True):
        check_shape(own, "boxes", len(names), 4)
    truth, label = torch.cat(list(boxes)), torch.cat(list(labels))
    image = torch.cat([torch.full_like(names, number) for number, names in enumerate(labels)])
    belongs = _best_anchors(truth, heads)
    parts = []
    for raw, head, wanted in zip(maps, heads, belongs, strict=True):
        assigned = _assign(raw, canvas, truth, image, wanted)
        parts.append(_head_loss(raw, head, canvas, truth, label, image, assigned, ignore))
    return sum(parts[1:], parts[0])


def _best_anchors(truth: Tensor, heads: Sequence[Head]) -> list[Tensor]:
    """Find the anchors that objects `(M, 4)` are assigned to, `(M, A)` boolean for each head."""
    sizes = truth[:, 2:] - truth[:, :2]
    corner = torch.zeros_like(sizes)
    anchors = truth.new_tensor([anchor for head in heads for anchor in head.anchors])
    overlap = box_iou(torch.cat([corner, sizes], -1), torch.cat([torch.zeros_like(anchors), anchors], -1))
    best = overlap == overlap.amax(-1, keepdim=True)
    return list(best.split([len(head.anchors) for head in heads], -1))


def _assign(raw: Tensor, canvas: tuple[int, int], truth: Tensor, image: Tensor, wanted: Tensor) -> _Assigned:
    """Assign objects to boxes of a head. If several objects are assigned to a box, the last one gets it."""
    rows, columns = raw.shape[-2:]
    number, anchor = wanted.nonzero(as_tuple=True)
    column, row = _cells(truth, canvas, (columns, rows)).long().unbind(-1)
    column, row = column.clamp(0, columns - 1)[number], row.clamp(0, rows - 1)[number]
    place = ((image[number] * wanted.shape[1] + anchor) * rows + row) * columns + column
    last = {slot: index for index, slot in enumerate(place.tolist())}
    kept = torch.tensor(list(last.values()), dtype=torch.int64, device=raw.device)
    return _Assigned(image[number][kept], row[kept], column[kept], anchor[kept], number[kept])


def _cells(truth: Tensor, canvas: tuple[int, int], size: tuple[int, int]) -> Tensor:
    """Convert the centres of objects to units of the cells of a map with `(columns, rows)`, `(M, 2)`."""
    return (truth[:, :2] + truth[:, 2:]) / 2 * (truth.new_tensor(size) / truth.new_tensor(canvas))


def _head_loss(
    raw: Tensor,
    head: Head,
    canvas: tuple[int, int],
    truth: Tensor,
    label: Tensor,
    image: Tensor,
    assigned: _Assigned,
    ignore: float,
) -> Losses:
    """Compute the loss of one head."""
    batch, _, rows, columns = raw.shape
    cells = raw.view(batch, len(head.anchors), 5 + head.classes, rows, columns)
    of_object = torch.zeros_like(cells[:, :, 4])
    of_object[assigned.image, assigned.anchor, assigned.row, assigned.column] = 1.0
    counted = ~_overlapping(raw.detach(), head, canvas, truth, image, ignore) | (of_object > 0)
    objectness = F.binary_cross_entropy_with_logits(cells[:, :, 4], of_object, counted.to(raw), reduction="sum")

    chosen = cells[assigned.image, assigned.anchor, :, assigned.row, assigned.column]
    wanted = F.one_hot(label[assigned.truth] - 1, head.classes).to(raw)
    classes = F.binary_cross_entropy_with_logits(chosen[:, 5:], wanted, reduction="sum")

    object_ = truth[assigned.truth]
    size = object_[:, 2:] - object_[:, :2]
    weight = 2 - size.prod(-1, keepdim=True) / (canvas[0] * canvas[1])
    place = _cells(object_, canvas, (columns, rows)) - torch.stack([assigned.column, assigned.row], -1)
    # The value of the sigmoid for which `decode_yolo` gives this centre.
    reach = ((place + (head.scale - 1) / 2) / head.scale).clamp(0, 1)
    centre = F.binary_cross_entropy_with_logits(chosen[:, :2], reach, weight.expand_as(reach), reduction="sum")
    ratio = size / raw.new_tensor(head.anchors)[assigned.anchor]
    extent = (weight * (chosen[:, 2:4] - ratio.log()).square()).sum() / 2
    return Losses(objectness, classes, centre + extent)


def _overlapping(
    raw: Tensor, head: Head, canvas: tuple[int, int], truth: Tensor, image: Tensor, ignore: float
) -> Tensor:
    """Find the predicted boxes that overlap an object of their image by more than `ignore`, `(B, A, h, w)` boolean."""
    batch, _, rows, columns = raw.shape
    predicted = decode_yolo(raw, head.anchors, canvas, head.scale).boxes
    found = predicted.new_zeros(batch, rows * columns * len(head.anchors), dtype=torch.bool)
    for number in image.unique().tolist():
        found[number] = (box_iou(predicted[number], truth[image == number]) > ignore).any(-1)
    return found.view(batch, rows, columns, len(head.anchors)).permute(0, 3, 1, 2)
