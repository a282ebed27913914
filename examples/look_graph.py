"""The parts of a look as an ONNX graph: window, selection, gist.

The formulas are written with `Value`, which is computed with as with a tensor and adds nodes to the graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from semfov.detection.darknet_onnx import Graph
from semfov.detection.detector import Detector
from semfov.detection.selection import Selection
from semfov.zoom.eye import BORDER
from semfov.zoom.hints import DETECTION_SCORE

OPSET = 18
"""The first opset whose `Resize` has antialiasing."""

IR_VERSION = 8

# Element types by their number in `onnx.TensorProto`.
_ELEMENTS = {torch.float32: 1, torch.uint8: 2, torch.int64: 7, torch.bool: 9, torch.float64: 11}

_END = 2**31 - 1  # of a slice that goes on to the last element


@dataclass(frozen=True, eq=False)
class Value:
    """A tensor in a graph under construction; every operation with it adds a node.

    A number beside a value becomes a constant of its type.

    Attributes:
        graph: the graph.
        name: name of the tensor in the graph.
        dtype: type of its elements.
    """

    graph: Graph
    name: str
    dtype: torch.dtype

    def node(self, op: str, *inputs: Value | float | list[int], dtype: torch.dtype | None = None, **how: Any) -> Value:
        """Add a node that reads this value first.

        Args:
            op: its operation.
            *inputs: what it reads besides: values, numbers of the same type, and lists of whole numbers.
            dtype: type of the result; None for the type of this value.
            **how: attributes of the operation.

        Returns:
            The result.
        """
        names = [self._beside(read).name for read in inputs]
        result = self.graph.add(op, self.name, *names, **how)
        return Value(self.graph, result, self.dtype if dtype is None else dtype)

    def _beside(self, read: Value | float | list[int]) -> Value:
        """Make the value that an operation reads beside this one."""
        if isinstance(read, Value):
            return read
        dtype = torch.int64 if isinstance(read, list) else self.dtype
        return constant(self.graph, torch.tensor(read, dtype=dtype))

    def __add__(self, other: Value | float) -> Value:
        return self.node("Add", other)

    def __sub__(self, other: Value | float) -> Value:
        return self.node("Sub", other)

    def __rsub__(self, other: float) -> Value:
        return self._beside(other) - self

    def __mul__(self, other: Value | float) -> Value:
        return self.node("Mul", other)

    def __rmul__(self, other: float) -> Value:
        return self._beside(other) * self

    def __truediv__(self, other: Value | float) -> Value:
        return self.node("Div", other)

    def __rtruediv__(self, other: float) -> Value:
        return self._beside(other) / self

    def __gt__(self, other: Value | float) -> Value:
        return self.node("Greater", other, dtype=torch.bool)

    def __ge__(self, other: Value | float) -> Value:
        return self.node("GreaterOrEqual", other, dtype=torch.bool)

    def __lt__(self, other: Value | float) -> Value:
        return self.node("Less", other, dtype=torch.bool)

    def __le__(self, other: Value | float) -> Value:
        return self.node("LessOrEqual", other, dtype=torch.bool)

    def __and__(self, other: Value) -> Value:
        return self.node("And", other)

    def minimum(self, other: Value | float) -> Value:
        """Take the smaller one of this value and another."""
        return self.node("Min", other)

    def maximum(self, other: Value | float) -> Value:
        """Take the larger one of this value and another."""
        return self.node("Max", other)

    def where(self, condition: Value, other: Value | float) -> Value:
        """Take this value where a condition holds, and another one elsewhere."""
        return condition.node("Where", self, self._beside(other), dtype=self.dtype)

    def to(self, dtype: torch.dtype) -> Value:
        """Convert the elements to another type."""
        return self.node("Cast", dtype=dtype, to=_ELEMENTS[dtype])

    def shape(self) -> Value:
        """Read the numbers of elements along the axes."""
        return self.node("Shape", dtype=torch.int64)

    def entry(self, index: int, axis: int = 0) -> Value:
        """Select by one index along an axis, which is removed."""
        return self.take(constant(self.graph, torch.tensor(index)), axis)

    def take(self, index: Value, axis: int = 0) -> Value:
        """Select by some indices along an axis."""
        return self.node("Gather", index, axis=axis)

    def without_background(self, axis: int) -> Value:
        """Leave out the first score along an axis."""
        return self.node("Slice", [1], [_END], [axis])

    def unsqueeze(self, axis: int) -> Value:
        """Insert an axis of one element."""
        return self.node("Unsqueeze", [axis])

    def squeeze(self, axis: int) -> Value:
        """Remove an axis of one element."""
        return self.node("Squeeze", [axis])

    def largest(self, axis: int, *, keepdims: bool = False) -> Value:
        """Find the largest elements along an axis."""
        return self.node("ReduceMax", [axis], keepdims=int(keepdims))

    def split(self, lengths: list[int], axis: int) -> list[Value]:
        """Cut it along an axis into parts of some lengths."""
        names = self.graph.add_several("Split", self.name, self._beside(lengths).name, outputs=len(lengths), axis=axis)
        return [Value(self.graph, name, self.dtype) for name in names]


def constant(graph: Graph, tensor: Tensor) -> Value:
    """Add a constant tensor to a graph."""
    return Value(graph, graph.constant(tensor), tensor.dtype)


def stack(*values: Value) -> Value:
    """Make a vector of scalars."""
    first, *others = [value.unsqueeze(0) for value in values]
    return first.node("Concat", *others, axis=0)


def _pixels(*values: Value) -> Value:
    """Make a vector of whole numbers of scalars that are whole."""
    return stack(*values).to(torch.int64)


class Proposals(NamedTuple):
    """All boxes of a detector's head for one canvas.

    Attributes:
        boxes: `(1, N, 4)` in canvas pixels.
        confidence: `(1, N)`.
        vectors: `(1, N, K+1)`, scores of all classes, background first.
    """

    boxes: Value
    confidence: Value
    vectors: Value

    def take(self, index: Value) -> Rows:
        """Select boxes by their indices `(L,)`."""
        boxes = self.boxes.squeeze(0).take(index)
        vectors = self.vectors.squeeze(0).take(index)
        return Rows(boxes, vectors)


class Rows(NamedTuple):
    """Boxes `(L, 4)` and their scores of all classes, background first, `(L, K+1)`."""

    boxes: Value
    vectors: Value

    def scores(self) -> Value:
        """Scores of the classes without background, `(L, K)`."""
        return self.vectors.without_background(1)

    def confidence(self) -> Value:
        """Highest score of any class, `(L,)`."""
        return self.scores().largest(1)


class Window(NamedTuple):
    """A window of a picture on the canvas.

    Attributes:
        canvas: `(1, 3, h, w)`.
        corner: `(2,)`, its upper left corner in picture pixels, not rounded, and maybe outside the picture.
        magnification: `()`, canvas pixels for a picture pixel.
        shown: `(4,)`, edges of what is shown, in picture pixels.
        place: `(4,)`, edges of its place on the canvas, in canvas pixels.
    """

    canvas: Value
    corner: Value
    magnification: Value
    shown: Value
    place: Value


class _Axis(NamedTuple):
    """A window along one axis.

    Attributes:
        edge: where it begins in the picture, not rounded.
        start: first picture pixel that is shown.
        stop: end of these pixels.
        first: first canvas pixel that shows them.
        last: end of these canvas pixels.
    """

    edge: Value
    start: Value
    stop: Value
    first: Value
    last: Value


class LookGraph(Graph):
    """ONNX nodes of a look."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.width, self.height = detector.input_size
        self.fill = float(detector.fill)
        self.faint = detector.faint

    def append(self, model: Any, prefix: str, inputs: Mapping[str, Value]) -> list[Value]:
        """Add a whole model.

        Args:
            model: the model, whose outputs are in single precision.
            prefix: what the names of its values begin with.
            inputs: the values that it reads, by the names of its inputs.

        Returns:
            Its outputs.
        """
        from onnx import compose, inliner

        model = compose.add_prefix(inliner.inline_local_functions(model), prefix)
        sources = {prefix + name: value.name for name, value in inputs.items()}
        for node in model.graph.node:
            for place, name in enumerate(node.input):
                node.input[place] = sources.get(name, name)
        self.nodes += list(model.graph.node)
        self.constants |= {tensor.name: tensor for tensor in model.graph.initializer}
        return [Value(self, output.name, torch.float32) for output in model.graph.output]

    def window(self, picture: Value, fixation: Value) -> Window:
        """Resample a window to the canvas, as `WindowEye` does.

        Args:
            picture: `(H, W, 3)`, bytes.
            fixation: `(3,)`, x, y and magnification.

        Returns:
            The window.
        """
        point = fixation.to(torch.float64)
        magnification = point.entry(2)
        shape = picture.shape().to(torch.float64)
        left, x1, x2, u1, u2 = _axis(point.entry(0), magnification, length=shape.entry(1), count=self.width)
        top, y1, y2, v1, v2 = _axis(point.entry(1), magnification, length=shape.entry(0), count=self.height)

        part = picture.node("Slice", _pixels(y1, x1), _pixels(y2, x2), [0, 1])
        planes = part.unsqueeze(0).to(torch.float32).node("Transpose", perm=[0, 3, 1, 2])
        size = _pixels(y2 - y1), _pixels(x2 - x1)
        size_on_canvas = _pixels(v2 - v1), _pixels(u2 - u1)
        pixels = self._resized(planes, size, size_on_canvas) / 255.0

        # Images and channels are not padded. First what is padded before rows and columns, then what is after them.
        none = constant(self, torch.tensor([0, 0]))
        pads = none.node("Concat", _pixels(v1, u1), none, _pixels(self.height - v2, self.width - u2), axis=0)
        canvas = pixels.node("Pad", pads, self.fill)
        return Window(canvas, stack(left, top), magnification, stack(x1, y1, x2, y2), stack(u1, v1, u2, v2))

    def _resized(self, planes: Value, size: tuple[Value, Value], target: tuple[Value, Value]) -> Value:
        """Resample planes `(1, 3, h, w)` from their numbers of rows and columns `(1,)` to others, as bytes."""
        rows, columns = size
        target_rows, target_columns = target
        # One axis after the other: the rows first if they get fewer.
        rows_first = rows > target_rows
        rows_between = target_rows.where(rows_first, rows)
        columns_between = columns.where(rows_first, target_columns)
        images_and_channels = constant(self, torch.tensor([1, 3]))
        for shape in ((rows_between, columns_between), target):
            sizes = images_and_channels.node("Concat", *shape, axis=0)
            # Weights beyond the border are left out, as by Pillow and torch.
            name = self.add("Resize", planes.name, "", "", sizes.name, mode="linear", antialias=1, exclude_outside=1)
            planes = Value(self, name, torch.float32).node("Round").node("Clip", 0.0, 255.0)
        return planes

    def select(self, proposals: Proposals, selection: Selection) -> Rows:
        """Select among all boxes as `semfov.detection.selection.select` does, most confident first."""
        x1, y1, x2, y2 = proposals.boxes.split([1, 1, 1, 1], axis=2)
        has_area = ((x2 > x1) & (y2 > y1)).squeeze(2)
        is_confident = proposals.confidence >= selection.threshold
        ranked = proposals.confidence.where(has_area & is_confident, 0.0)
        boxes = proposals.boxes
        if selection.per_class:
            # Boxes of different classes are moved apart, so that they do not overlap.
            scores = proposals.vectors.without_background(2)
            label = scores.node("ArgMax", axis=2, keepdims=1).to(torch.float32)
            boxes = boxes + label * (4.0 * max(self.width, self.height))
        limit = [selection.limit]
        lowest = constant(self, torch.tensor([0.0]))
        overlap = constant(self, torch.tensor([selection.iou]))
        survivors = boxes.node("NonMaxSuppression", ranked.unsqueeze(1), limit, overlap, lowest, dtype=torch.int64)
        rows = proposals.take(survivors.entry(2, axis=1))  # image, class and box
        confidence = rows.confidence()
        _, order = self.add_several("TopK", confidence.name, confidence.shape().name, outputs=2, axis=0)
        by_confidence = Value(self, order, torch.int64)
        return Rows(rows.boxes.take(by_confidence), rows.vectors.take(by_confidence))

    def hints(self, proposals: Proposals) -> Rows:
        """Take the hints from all boxes of the detector's head."""
        is_hint = proposals.confidence >= self.faint
        _, index = is_hint.node("NonZero", dtype=torch.int64).split([1, 1], axis=0)
        return proposals.take(index.squeeze(0))

    def to_picture(self, boxes: Value, window: Window) -> Value:
        """Map canvas boxes `(L, 4)` to picture pixels, cut to the window."""
        low, high = window.shown.to(torch.float32).split([2, 2], axis=0)
        first, last = window.place.to(torch.float32).split([2, 2], axis=0)
        scale = (high - low) / (last - first)
        moved = (boxes - _twice(first)) * _twice(scale) + _twice(low)
        return moved.maximum(_twice(low)).minimum(_twice(high))

    def cut(self, boxes: Value, window: Window, picture: Value) -> Value:
        """Tell which canvas boxes `(L, 4)` the border of the window cuts, `(L,)`; that of the picture cuts none."""
        low, high = window.shown.to(torch.float32).split([2, 2], axis=0)
        first, last = window.place.to(torch.float32).split([2, 2], axis=0)
        size = picture.shape().take(constant(self, torch.tensor([1, 0]))).to(torch.float32)
        upper_left, lower_right = boxes.split([2, 2], axis=1)
        cut_before = (upper_left <= first + BORDER) & (low > 0.0)
        cut_after = (lower_right >= last - BORDER) & (high < size)
        sides = cut_before.node("Concat", cut_after, axis=1)
        return sides.to(torch.float32).largest(1).to(torch.bool)

    def gist(self, hints: Rows, detections: Rows, window: Window, cells: int, classes: int) -> tuple[Value, ...]:
        """Compute the gist of a look, as `semfov.zoom.hints.Gist.of` does.

        Args:
            hints: the hints, in picture pixels.
            detections: the detections, in picture pixels.
            window: the window.
            cells: c, number of cells along a side of the window.
            classes: K.

        Returns:
            The strongest hint of every class in each cell `(c, c, K)`, the size of the most confident one `(c, c)`, and
            whether a class was detected, as 0 or 1, `(c, c, K)`.
        """
        none = constant(self, torch.zeros(cells * cells, classes))
        no_class = constant(self, torch.zeros(cells * cells))
        cell = self._cell_of(hints.boxes, window, cells)
        strongest = _highest_in_cells(none, cell, hints.scores(), classes)

        # The size of a cell is that of its most confident hint.
        confidence = hints.confidence()
        top = no_class.node("ScatterElements", cell, confidence, axis=0, reduction="max")
        leads = confidence >= top.take(cell)
        upper_left, lower_right = hints.boxes.split([2, 2], axis=1)
        log_sides = (lower_right - upper_left).node("Clip", 1e-3).node("Log")
        log_magnification = window.magnification.to(torch.float32).node("Log")
        octaves_per_log = float(1 / torch.tensor(2.0).log())
        octaves = (log_sides.node("ReduceMean", [1], keepdims=0) + log_magnification) * octaves_per_log
        size_of_leading = octaves.maximum(0.0).where(leads, 0.0)
        size = no_class.node("ScatterElements", cell, size_of_leading, axis=0, reduction="max")

        scores = detections.scores()
        is_label = scores.node("Equal", scores.largest(1, keepdims=True), dtype=torch.bool)
        is_found = (is_label & (scores >= DETECTION_SCORE)).to(torch.float32)
        found = _highest_in_cells(none, self._cell_of(detections.boxes, window, cells), is_found, classes)
        return (
            strongest.node("Reshape", [cells, cells, classes]),
            size.node("Reshape", [cells, cells]),
            found.node("Reshape", [cells, cells, classes]),
        )

    def _cell_of(self, boxes: Value, window: Window, cells: int) -> Value:
        """Find the number of the cell in which the centre of each box lies, row by row, `(L,)`."""
        corner = window.corner.to(torch.float32)
        size_on_canvas = constant(self, torch.tensor([self.width / cells, self.height / cells]))
        size = size_on_canvas / window.magnification.to(torch.float32)
        upper_left, lower_right = boxes.split([2, 2], axis=1)
        centre = (upper_left + lower_right) / 2.0
        place = ((centre - corner) / size).node("Floor").node("Clip", 0.0, float(cells - 1))
        column, row = place.split([1, 1], axis=1)
        return (row * float(cells) + column).squeeze(1).to(torch.int64)


def _axis(point: Value, magnification: Value, *, length: Value, count: int) -> _Axis:
    """Find what a window shows along one axis, as `semfov.zoom.eye` does.

    Args:
        point: its centre in picture pixels, `()`.
        magnification: canvas pixels for a picture pixel, `()`.
        length: number of picture pixels, `()`.
        count: number of canvas pixels.

    Returns:
        Its edges; at least one pixel is shown.
    """
    half = float(count) / (2.0 * magnification)
    middle = point + 0.5
    edge = middle - half
    last_edge = middle + half
    rounded_edge = edge.node("Round")
    start = rounded_edge.maximum(0.0).minimum(length - 1.0)
    stop = last_edge.node("Round").maximum(start + 1.0).minimum(length)
    # What the window shows beyond the picture is padding on the canvas.
    padding = ((start - rounded_edge) * magnification).node("Round")
    first = padding.minimum(count - 1.0)
    extent = ((stop - start) * magnification).node("Round")
    last = (first + extent).maximum(first + 1.0).minimum(float(count))
    return _Axis(edge, start, stop, first, last)


def _twice(pair: Value) -> Value:
    """Make `(x, y, x, y)` of `(x, y)`."""
    return pair.node("Concat", pair, axis=0)


def _highest_in_cells(lowest: Value, cell: Value, values: Value, classes: int) -> Value:
    """Find the highest of rows `(L, K)` in each cell, by their cells `(L,)`; `lowest` `(cells, K)` where none is."""
    index = cell.unsqueeze(1).node("Expand", [1, classes])
    return lowest.node("ScatterElements", index, values, axis=0, reduction="max")
