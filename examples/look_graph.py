"""The parts of a look as an ONNX graph: window, selection, gist."""

from typing import Any

import torch

from semfov.detection.darknet_onnx import Graph
from semfov.detection.detector import Detector
from semfov.detection.selection import Selection
from semfov.zoom.eye import BORDER
from semfov.zoom.hints import DETECTION_SCORE

OPSET = 18
"""The first opset whose `Resize` has antialiasing."""

IR_VERSION = 8

_DOUBLE, _FLOAT, _INT64, _BOOL = 11, 1, 7, 9  # of onnx.TensorProto


class LookGraph(Graph):
    """ONNX nodes of a look."""

    def __init__(self, detector: Detector) -> None:
        super().__init__()
        self.wide, self.high = detector.input_size
        self.fill = float(detector.fill)
        self.faint = detector.faint

    def double(self, value: float) -> str:
        """Make a constant in double precision, in which windows are computed."""
        return self.constant(torch.tensor(value, dtype=torch.float64))

    def append(self, model: Any, prefix: str, inputs: dict[str, str]) -> list[str]:
        """Add a whole model, whose inputs are named values of this graph; return the names of its outputs."""
        from onnx import compose, inliner

        model = compose.add_prefix(inliner.inline_local_functions(model), prefix)
        sources = {prefix + name: value for name, value in inputs.items()}
        for node in model.graph.node:
            for place, name in enumerate(node.input):
                node.input[place] = sources.get(name, name)
        self.nodes += list(model.graph.node)
        self.constants |= {constant.name: constant for constant in model.graph.initializer}
        return [output.name for output in model.graph.output]

    def window(self, picture: str, fixation: str) -> tuple[str, str, str]:
        """Resample a window to the canvas, as `WindowEye` does.

        Shapes: picture `(H, W, 3)`, fixation `(3,)` → `(1, 3, h, w)`.
        """
        point = self.add("Cast", fixation, to=_DOUBLE)
        x, y, m = (self.add("Gather", point, self.constant(n)) for n in range(3))
        shape = self.add("Cast", self.add("Shape", picture), to=_DOUBLE)
        width, height = (self.add("Gather", shape, self.constant(n)) for n in (1, 0))
        axes = [self._axis(x, m, width, self.wide), self._axis(y, m, height, self.high)]
        (left, x1, x2, u1, u2), (top, y1, y2, v1, v2) = axes
        start = self._whole(y1, x1)
        part = self.add("Slice", picture, start, self._whole(y2, x2), self.constant([0, 1]))
        pixels = self.add("Cast", self.add("Unsqueeze", part, self.constant([0])), to=_FLOAT)
        pixels = self.add("Transpose", pixels, perm=[0, 3, 1, 2])
        # One axis after the other, rounded to bytes after each; columns of pixels first if they become shorter.
        rows, across = self._whole(self.add("Sub", y2, y1)), self._whole(self.add("Sub", x2, x1))
        columns, lines = self._whole(self.add("Sub", u2, u1)), self._whole(self.add("Sub", v2, v1))
        lead, shorter = self.constant([1, 3]), self.add("Greater", rows, lines)
        first = self.add("Where", shorter, lines, rows), self.add("Where", shorter, across, columns)
        for size in ([lead, *first], [lead, lines, columns]):
            # Weights beyond the border are left out, as by Pillow and torch.
            how: dict[str, Any] = {"mode": "linear", "antialias": 1, "exclude_outside": 1}
            resized = self.add("Resize", pixels, "", "", self.add("Concat", *size, axis=0), **how)
            pixels = self.add("Clip", self.add("Round", resized), self.constant(0.0), self.constant(255.0))
        pixels = self.add("Div", pixels, self.constant(255.0))
        none = self.constant([0, 0])
        right = self._whole(self.add("Sub", self.double(self.high), v2), self.add("Sub", self.double(self.wide), u2))
        pads = self.add("Concat", none, self._whole(v1, u1), none, right, axis=0)
        canvas = self.add("Pad", pixels, pads, self.constant(self.fill))
        return canvas, self._vector(x1, y1, x2, y2, u1, v1, u2, v2), self._vector(left, top, m)

    def _axis(self, point: str, m: str, length: str, canvas: int) -> tuple[str, str, str, str, str]:
        """Along one axis: start of the window, and start and stop of its visible part in picture and canvas pixels."""
        one, zero, side = self.double(1.0), self.double(0.0), self.double(float(canvas))
        half = self.add("Div", side, self.add("Mul", self.double(2.0), m))
        middle = self.add("Add", point, self.double(0.5))
        low, high = self.add("Sub", middle, half), self.add("Add", middle, half)
        edge = self.add("Round", low)
        start = self.add("Min", self.add("Max", edge, zero), self.add("Sub", length, one))
        stop = self.add("Min", self.add("Max", self.add("Round", high), self.add("Add", start, one)), length)
        offset = self.add("Round", self.add("Mul", self.add("Sub", start, edge), m))
        first = self.add("Min", offset, self.add("Sub", side, one))
        extent = self.add("Round", self.add("Mul", self.add("Sub", stop, start), m))
        last = self.add("Max", self.add("Add", first, extent), self.add("Add", first, one))
        return low, start, stop, first, self.add("Min", last, side)

    def selection(self, boxes: str, confidence: str, vectors: str, chosen: Selection) -> tuple[str, str]:
        """Select candidates `(1, N, …)` as `select` does: canvas boxes `(L, 4)` and score vectors `(L, K+1)`."""
        x1, y1, x2, y2 = self.add_several("Split", boxes, self.constant([1, 1, 1, 1]), outputs=4, axis=2)
        full = self.add("And", self.add("Greater", x2, x1), self.add("Greater", y2, y1))
        full = self.add("Squeeze", full, self.constant([2]))
        sure = self.add("GreaterOrEqual", confidence, self.constant(chosen.threshold))
        ranked = self.add("Where", self.add("And", full, sure), confidence, self.constant(0.0))
        apart = boxes
        if chosen.per_class:
            # Boxes of different classes are moved apart, so that they do not overlap.
            classes = self.add("Slice", vectors, self.constant([1]), self.constant([2**31 - 1]), self.constant([2]))
            label = self.add("Cast", self.add("ArgMax", classes, axis=2, keepdims=1), to=_FLOAT)
            apart = self.add("Add", boxes, self.add("Mul", label, self.constant(4.0 * max(self.wide, self.high))))
        rows = self.add(
            "NonMaxSuppression",
            apart,
            self.add("Unsqueeze", ranked, self.constant([1])),
            self.constant([chosen.limit]),
            self.constant([chosen.iou]),
            self.constant([0.0]),
        )
        index = self.add("Gather", rows, self.constant(2), axis=1)
        box, vector = (
            self.add("Gather", self.add("Squeeze", each, self.constant([0])), index) for each in (boxes, vectors)
        )
        best = self._best(vector)
        count = self.add("Shape", best)
        _, order = self.add_several("TopK", best, count, outputs=2, axis=0)
        return self.add("Gather", box, order), self.add("Gather", vector, order)

    def hints(self, boxes: str, confidence: str, vectors: str) -> tuple[str, str]:
        """Take the hints from candidates `(1, N, …)`: canvas boxes `(L, 4)` and score vectors `(L, K+1)`."""
        enough = self.add("GreaterOrEqual", confidence, self.constant(self.faint))
        _, index = self.add_several("Split", self.add("NonZero", enough), self.constant([1, 1]), outputs=2, axis=0)
        index = self.add("Squeeze", index, self.constant([0]))
        box, vector = (
            self.add("Gather", self.add("Squeeze", each, self.constant([0])), index) for each in (boxes, vectors)
        )
        return box, vector

    def placed(self, boxes: str, frame: str, picture: str) -> tuple[str, str]:
        """Map canvas boxes `(L, 4)` to picture pixels, cut to the window; also tell which its border cuts, `(L,)`."""
        window, canvas = self.add_several("Split", frame, self.constant([4, 4]), outputs=2, axis=0)
        single = [self.add("Cast", each, to=_FLOAT) for each in (window, canvas)]
        (low, high), (first, last) = (
            self.add_several("Split", n, self.constant([2, 2]), outputs=2, axis=0) for n in single
        )
        scale = self.add("Div", self.add("Sub", high, low), self.add("Sub", last, first))
        twice = {name: self.add("Concat", value, value, axis=0) for name, value in
                 {"scale": scale, "first": first, "low": low, "high": high}.items()}  # fmt: skip
        moved = self.add("Mul", self.add("Sub", boxes, twice["first"]), twice["scale"])
        mapped = self.add("Add", moved, twice["low"])
        mapped = self.add("Min", self.add("Max", mapped, twice["low"]), twice["high"])
        upper, lower = self.add_several("Split", boxes, self.constant([2, 2]), outputs=2, axis=1)
        border = self.constant(float(BORDER))
        shape = self.add("Cast", self.add("Gather", self.add("Shape", picture), self.constant([1, 0])), to=_FLOAT)
        near = self.add(
            "Concat",
            self.add("And", self.add("LessOrEqual", upper, self.add("Add", first, border)),
                     self.add("Greater", low, self.constant(0.0))),
            self.add("And", self.add("GreaterOrEqual", lower, self.add("Sub", last, border)),
                     self.add("Less", high, shape)),
            axis=1,
        )  # fmt: skip
        any_side = self.add("ReduceMax", self.add("Cast", near, to=_FLOAT), self.constant([1]), keepdims=0)
        return mapped, self.add("Cast", any_side, to=_BOOL)

    def gist(
        self, hints: tuple[str, str], detections: tuple[str, str], start: str, cells: int, classes: int
    ) -> tuple[str, str, str]:
        """Compute the gist of a look, as `semfov.zoom.hints.Gist.of` does; → `(c, c, K)`."""
        boxes, vectors = hints
        at, scores, best = self._cells(boxes, start, cells), self._scores(vectors), self._best(vectors)
        nothing = self.constant(torch.zeros(cells * cells, classes))
        strongest = self._strongest(nothing, at, scores, classes)
        alone = self.constant(torch.zeros(cells * cells))
        top = self.add("ScatterElements", alone, at, best, axis=0, reduction="max")
        # The size of a cell is that of its most confident hint.
        leads = self.add("GreaterOrEqual", best, self.add("Gather", top, at))
        corner, opposite = self.add_several("Split", boxes, self.constant([2, 2]), outputs=2, axis=1)
        extent = self.add("Clip", self.add("Sub", opposite, corner), self.constant(1e-3))
        m = self.add("Cast", self.add("Gather", start, self.constant([2])), to=_FLOAT)
        log2 = self.constant(float(1 / torch.tensor(2.0).log()))
        octaves = self.add("ReduceMean", self.add("Log", extent), self.constant([1]), keepdims=0)
        size = self.add("Mul", self.add("Add", octaves, self.add("Log", m)), log2)
        size = self.add("Where", leads, self.add("Max", size, self.constant(0.0)), self.constant(0.0))
        size = self.add("ScatterElements", alone, at, size, axis=0, reduction="max")
        there, vector = detections
        detection_scores = self._scores(vector)
        own = self.add(
            "Equal", detection_scores, self.add("ReduceMax", detection_scores, self.constant([1]), keepdims=1)
        )
        sure = self.add("GreaterOrEqual", detection_scores, self.constant(DETECTION_SCORE))
        found = self.add("Cast", self.add("And", own, sure), to=_FLOAT)
        found = self._strongest(nothing, self._cells(there, start, cells), found, classes)
        shapes = [cells, cells, classes], [cells, cells], [cells, cells, classes]
        pairs = zip((strongest, size, found), shapes, strict=True)
        strongest, size, found = (self.add("Reshape", value, self.constant(shape)) for value, shape in pairs)
        return strongest, size, found

    def _cells(self, boxes: str, start: str, cells: int) -> str:
        """Index of the cell in which the centre of each box lies, `(L,)`."""
        corner = self.add("Cast", self.add("Slice", start, self.constant([0]), self.constant([2])), to=_FLOAT)
        m = self.add("Cast", self.add("Gather", start, self.constant([2])), to=_FLOAT)
        pitch = self.add("Div", self.constant([self.wide / cells, self.high / cells]), m)
        upper, lower = self.add_several("Split", boxes, self.constant([2, 2]), outputs=2, axis=1)
        middle = self.add("Div", self.add("Add", upper, lower), self.constant(2.0))
        place = self.add("Floor", self.add("Div", self.add("Sub", middle, corner), pitch))
        place = self.add("Clip", place, self.constant(0.0), self.constant(float(cells - 1)))
        column, row = self.add_several("Split", place, self.constant([1, 1]), outputs=2, axis=1)
        number = self.add("Add", self.add("Mul", row, self.constant(float(cells))), column)
        return self.add("Cast", self.add("Squeeze", number, self.constant([1])), to=_INT64)

    def _strongest(self, start: str, at: str, values: str, classes: int) -> str:
        """Highest of the rows `(L, K)` in each cell."""
        index = self.add("Expand", self.add("Unsqueeze", at, self.constant([1])), self.constant([1, classes]))
        return self.add("ScatterElements", start, index, values, axis=0, reduction="max")

    def _scores(self, vectors: str) -> str:
        """Scores of the classes without background, `(L, K)`."""
        return self.add("Slice", vectors, self.constant([1]), self.constant([2**31 - 1]), self.constant([1]))

    def _best(self, vectors: str) -> str:
        """Confidence, `(L,)`."""
        return self.add("ReduceMax", self._scores(vectors), self.constant([1]), keepdims=0)

    def _whole(self, *values: str) -> str:
        """Scalars in double precision as a vector of whole numbers."""
        return self.add("Cast", self._vector(*values), to=_INT64)

    def _vector(self, *values: str) -> str:
        return self.add("Concat", *(self.add("Unsqueeze", value, self.constant([0])) for value in values), axis=0)
