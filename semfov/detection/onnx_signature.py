"""Properties of an ONNX model that are known before it runs: names and shapes of outputs, and metadata."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeVar

from semfov.detection.onnx_cells import Canvas, CellBoxes, box_counts

Layout = Literal["queries", "dets", "selection", "candidates", "levels", "rows", "unknown"]
"""How a model divides its result into outputs; `Signature.layout` describes them."""

_Output = TypeVar("_Output")

_QUERY_LOGITS = ("logits", "pred_logits", "labels")
_SELECTED = {
    "boxes": ("boxes", "dets", "det_boxes", "bboxes", "nmsed_boxes"),
    "scores": ("scores", "det_scores", "nmsed_scores"),
    "labels": ("labels", "det_classes", "nmsed_classes", "classes"),
    "count": ("num_dets", "num_detections"),
}
"""Names of the outputs of networks that select boxes themselves: RT-DETR's, mmdeploy's and those of TensorRT."""

# Numbers of COCO's scores: its classes, and its category ids with their gaps.
_COCO_COUNTS = (80, 91)


@dataclass(frozen=True)
class Rows:
    """The only output of a model, `(1, rows, columns)`: one dimension has boxes, the other their channels.

    Attributes:
        sides: `(rows, columns)`.
        cells: anchors and levels of the cells that there are as many boxes for; zeros where no cells fit.
        boxes_are_columns: as in YOLOv8's export.
        classes: number of classes; None where it is unknown.
    """

    sides: tuple[int, int]
    cells: CellBoxes
    boxes_are_columns: bool
    classes: int | None

    @staticmethod
    def of(sides: tuple[int, int], canvas: Canvas, classes: int | None) -> "Rows":
        """Find which side of an output are boxes, by the numbers of boxes that cells of a canvas have."""
        counts = box_counts(canvas)
        rows, columns = sides
        boxes_are_columns = columns in counts and rows not in counts
        boxes = columns if boxes_are_columns else rows
        return Rows(sides, counts.get(boxes, CellBoxes(0, 0)), boxes_are_columns, classes)

    @property
    def channels(self) -> int:
        """Numbers for each box."""
        return self.sides[0] if self.boxes_are_columns else self.sides[1]

    def hold_scores_and(self, others: int) -> bool:
        """Tell whether channels hold some other numbers and a score for each class; at least one, if unknown."""
        return self.channels > others and self.classes in (None, self.channels - others)

    @property
    def lack_objectness(self) -> bool:
        """Whether the boxes of cells have class scores alone."""
        if self.cells.anchors != 1 or not self.hold_scores_and(4):
            return False
        # Without names, rows have an objectness unless their scores are as many as COCO's.
        return self.boxes_are_columns or self.classes is not None or self.channels - 4 in _COCO_COUNTS

    @property
    def may_have_objectness(self) -> bool:
        """Whether the boxes of cells with one anchor may have an objectness before their class scores."""
        rows_of_cells = self.cells.anchors == 1 and not self.boxes_are_columns
        return rows_of_cells and not self.lack_objectness and self.hold_scores_and(5)


@dataclass(frozen=True)
class Signature:
    """Properties of a model that are known before it runs on an image.

    Attributes:
        image: name of the input for images.
        outputs: name and shape of each output for one image, in order.
        canvas: `(width, height)` in pixels.
        producer: the program that exported the model, `""` if it does not say.
        classes: number of the classes; None where it is unknown.
        metadata: texts by key, as exporters write them.
    """

    image: str
    outputs: tuple[tuple[str, tuple[int, ...]], ...]
    canvas: Canvas
    producer: str = ""
    classes: int | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the outputs by name."""
        return dict(self.outputs)

    @cached_property
    def layout(self) -> Layout:
        """The layout of the outputs, by their names, else by their number.

        - `queries`: DETR's boxes `(1, Q, 4)` and logits.
        - `dets`: RF-DETR's boxes `dets` `(1, Q, 4)` and logits `labels` `(1, Q, K)`.
        - `selection`: boxes that the network selects itself, with a score and a class each.
        - `candidates`: boxes, scores, and whatever a `Candidates` holds besides.
        - `levels`: several outputs, a few for each level of cells.
        - `rows`: one output `(1, rows, columns)`.
        """
        names = self.shapes.keys()
        selected = selected_outputs(self.shapes)
        _, first_shape = self.outputs[0]
        # The order tells apart outputs that fit two layouts: the one with more of its own names comes first.
        layouts: dict[Layout, bool] = {
            "queries": "pred_boxes" in names and not names.isdisjoint(_QUERY_LOGITS),
            "dets": "dets" in names and len(self.shapes.get("labels", ())) == 3,
            "selection": "boxes" in selected and len(selected.get("labels", ())) == 2,
            "candidates": "boxes" in names and not names.isdisjoint(("classes", "scores")),
            "levels": len(names) > 1,
            "rows": len(first_shape) == 3,
        }
        return next((layout for layout, is_fit in layouts.items() if is_fit), "unknown")

    @cached_property
    def rows(self) -> Rows:
        """The only output of the layout `rows`."""
        _, rows, columns = self.outputs[0][1]
        return Rows.of((rows, columns), self.canvas, self.classes)

    @property
    def selects(self) -> bool:
        """Whether Ultralytics' metadata says that the network selects boxes itself."""
        return self.metadata.get("end2end") == "True" or "'nms': True" in self.metadata.get("args", "")


def query_logits(outputs: Mapping[str, _Output]) -> _Output:
    """Return the output with the logits of queries.

    Args:
        outputs: outputs of a DETR, or their shapes, by name.

    Returns:
        The one of the logits.
    """
    return outputs[next(name for name in _QUERY_LOGITS if name in outputs)]


def selected_outputs(outputs: Mapping[str, _Output]) -> dict[str, _Output]:
    """Find which output has boxes, scores or classes, for a network that selects boxes itself.

    Args:
        outputs: the outputs, or their shapes, by the names of the exporter.

    Returns:
        Those that are there, by `boxes`, `scores`, `labels` and `count`.
    """
    selected = {}
    for meaning, names in _SELECTED.items():
        name = next((name for name in names if name in outputs), None)
        if name is not None:
            selected[meaning] = outputs[name]
    return selected
