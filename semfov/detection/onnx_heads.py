"""Heads of ONNX detectors: how each lays out its outputs, how it is recognised, and its boxes with all scores.

A head is a class, which is registered under its `name` by being defined. To add one, define it here: its docstring says
its layout, `recognises` finds it by names and shapes, and `decode` makes `Candidates` of its outputs.

In shapes, B are images, N boxes, Q queries and K classes. Decoded boxes are `(x1, y1, x2, y2)` in canvas pixels, edges
between pixels (0 is the left edge of the canvas).
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from semfov.detection.detector import FAINT
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.detection.onnx_cells import STRIDES, Canvas, box_counts, cell_count, cell_grid
from semfov.detection.onnx_decoding import (
    check_offsets,
    decode_detr,
    decode_distances,
    decode_end_to_end,
    decode_selected,
    decode_yolov5,
    decode_yolov8,
    decode_yolox,
    fraction_corners,
    likely_rows,
)
from semfov.detection.onnx_signature import Rows, Signature, query_logits
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.errors import check, check_shape

_Outputs = Mapping[str, Tensor]
"""Outputs of a model by name, in its order."""

# What the authors' own code does with a picture.
_LETTERBOX = Preprocessing()
_STRETCH = Preprocessing(stretch=True)
# YOLOX pads on the right and below.
_YOLOX = Preprocessing(channels="bgr", scale=255.0, corner=True)
_IMAGENET = Preprocessing(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225), stretch=True)
_NANODET = Preprocessing(
    channels="bgr", scale=255.0, mean=(103.53, 116.28, 123.675), std=(57.375, 57.12, 58.395), stretch=True
)

_SELECTED_BY_DETR = {"labels", "boxes", "scores"}  # outputs of RT-DETR with its own selection
_DISTANCE_CHANNELS = 32  # of NanoDet-Plus: 8 bins for each side of a box


class Head(ABC):
    """A kind of head. Classes that have a `name` are in `HEADS`, in the order of their definition.

    Attributes:
        name: what `load_onnx` calls it.
        preprocessing: what its networks expect, unless a model's settings say otherwise.
        background: background policy of its scores.
        faint: confidence from which on a candidate is a hint of where to zoom in.
        score_threshold: score from which on a detection counts.
        selects: whether its networks select boxes themselves, and return one class and score for each.
    """

    name: ClassVar[str]
    preprocessing: ClassVar[Preprocessing] = _LETTERBOX
    background: ClassVar[BackgroundPolicy] = "residual"
    faint: ClassVar[float] = FAINT
    score_threshold: ClassVar[float] = SCORE_THRESHOLD
    selects: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "name" in vars(cls):
            HEADS[cls.name] = cls()

    @abstractmethod
    def recognises(self, signature: Signature) -> bool:
        """Tell whether a model may have this head.

        Args:
            signature: names and shapes of the model's outputs, and what its metadata says.

        Returns:
            True where they fit. Several heads may fit: `semfov.detection.onnx_recognition` then compares where they
            place boxes.
        """

    @abstractmethod
    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        """Make boxes and scores of outputs.

        Args:
            outputs: the outputs of a pass by name, in the layout of the class.
            canvas: `(width, height)` in pixels.
            classes: number of classes; None where it is unknown.
            least: confidence from which on boxes are wanted; others may be left out.

        Returns:
            The boxes, in canvas pixels, with all scores.

        Raises:
            InputError: the outputs have another layout.
        """


HEADS: dict[str, Head] = {}
"""All known heads by name."""


class _CellsHead(Head):
    """Base of heads with a row for each of thousands of cells, few of which may show an object.

    The other rows are left out before anything is computed of their boxes.
    """

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        tables = self.tables(outputs, canvas)
        if least > 0:
            rows = likely_rows(self.bound(tables), least)
            tables = tuple(table.index_select(1, rows) for table in tables)
        return self.decode_rows(tables)

    @abstractmethod
    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        """Find all that boxes are computed of: tables `(B, N, …)`, or `(1, N, …)`, with a row for each box."""

    def bound(self, tables: tuple[Tensor, ...]) -> Tensor:
        """Find a score that the confidence of a row does not exceed, `(B, N)`: objectness, as no class scores above 1.

        Rows have it after their boxes in most layouts.
        """
        return tables[0][..., 4]

    @abstractmethod
    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        """Make a box with its scores of each row of the tables."""


class _DistancesHead(_CellsHead):
    """Base of heads whose tables are class scores, the distances of `decode_distances`, and the cells."""

    def bound(self, tables: tuple[Tensor, ...]) -> Tensor:
        return tables[0].amax(-1)

    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        return decode_distances(*tables)


class _Candidates(Head):
    """Outputs of `semfov.detection.export`, as `Candidates` holds them.

    `boxes` `(B, N, 4)`, corners; `classes` or `scores` `(B, N, K)`; perhaps `objectness` `(B, N)` and `background`
    `(B, N)`.
    """

    name = "candidates"

    def recognises(self, signature: Signature) -> bool:
        return signature.layout == "candidates"

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        scores = outputs["classes" if "classes" in outputs else "scores"]
        check_shape(outputs["boxes"], "output boxes", None, None, 4)
        check_shape(scores, "output scores", None, outputs["boxes"].shape[1], None)
        return Candidates(outputs["boxes"], scores, outputs.get("objectness"), outputs.get("background"))


class _RowsHead(Head):
    """Base of heads with one output, whose rows or columns are boxes."""

    def recognises(self, signature: Signature) -> bool:
        return signature.layout == "rows" and self.recognises_rows(signature.rows, signature)

    @abstractmethod
    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        """Tell whether a model with one output may have this head.

        Args:
            rows: the output.
            signature: what else is known of the model.

        Returns:
            True where they fit.
        """


class _Yolox(_CellsHead, _RowsHead):
    """YOLOX (Ge et al. 2021): one output `(B, N, 5 + K)`, for the cells of strides 8, 16 and 32.

    A row is `t_x t_y t_w t_h` (`decode_yolox`), objectness, K class scores.
    """

    name = "yolox"
    preprocessing = _YOLOX

    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        return rows.cells.levels == 3 and rows.may_have_objectness

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        raw = _checked(_single(outputs))
        check_offsets(raw)
        return raw, _grid_of(raw, canvas, STRIDES[:3], 0.0)

    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        return decode_yolox(*tables)


class _YoloxDecoded(_Yolox):
    """YOLOX with boxes that the network has decoded: rows of `yolov5`, for an image in the corner of the canvas."""

    name = "yolox-decoded"

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        return (_checked(_single(outputs)),)

    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        return decode_yolov5(*tables)


class _NanodetPlus(_DistancesHead, _RowsHead):
    """NanoDet-Plus: one output `(B, N, K + 32)`, for the corners of the cells of strides 8, 16, 32 and 64.

    A row has K class scores, then the distances of `decode_distances`, with 8 bins for each side.
    """

    # Nearly every candidate exceeds the usual threshold of hints, as there is no objectness. All classes of a box have
    # some score, which would dilute that of the best one if only their shares counted.
    name = "nanodet-plus"
    preprocessing = _NANODET
    background = "normalised"
    faint = 0.02
    score_threshold = 0.2

    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        in_four_levels = rows.cells == (1, 4) and not rows.boxes_are_columns
        return in_four_levels and not rows.lack_objectness and rows.hold_scores_and(_DISTANCE_CHANNELS)

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        rows = _checked(_single(outputs))
        grid = _grid_of(rows, canvas, STRIDES, 0.0)
        return rows[..., :-_DISTANCE_CHANNELS], rows[..., -_DISTANCE_CHANNELS:], grid


class _Yolov5(_CellsHead, _RowsHead):
    """YOLOv5 and other heads with objectness: one output `(B, N, 5 + K)`, or its transpose.

    A row is `c_x c_y w h` in canvas pixels, objectness, K class scores.
    """

    name = "yolov5"

    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        if rows.cells.anchors == 3:
            return rows.hold_scores_and(5)
        # YOLOv6 has one anchor and three levels, as YOLOX has, whose own exports have these names of input and output.
        named_by_yolox = (signature.image, signature.outputs[0][0]) == ("images", "output")
        return rows.may_have_objectness and not (rows.cells.levels == 3 and named_by_yolox)

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        return (_rows(outputs, canvas),)

    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        return decode_yolov5(*tables)


class _Yolov8(_CellsHead, _RowsHead):
    """YOLOv8 and other heads without objectness: one output `(B, 4 + K, N)`, or its transpose.

    A column is `c_x c_y w h` in canvas pixels, K class scores.
    """

    name = "yolov8"

    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        return rows.lack_objectness

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        return (_rows(outputs, canvas, prefer_columns=True),)

    def bound(self, tables: tuple[Tensor, ...]) -> Tensor:
        return tables[0][..., 4:].amax(-1)

    def decode_rows(self, tables: tuple[Tensor, ...]) -> Candidates:
        return decode_yolov8(tables[0].mT)


class _EndToEnd(_RowsHead):
    """A network of Ultralytics that selects boxes itself: one output `(B, N, 6)`.

    A row is `x1 y1 x2 y2` in canvas pixels, score, number of the class; the boxes have no other scores. Rows of all
    images together, `(N, 7)`, are divided before (`rows_of_images`).
    """

    name = "end2end"
    selects = True

    def recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        if rows.cells.anchors or rows.sides[1] != 6:
            return False
        # The rows of two classes are as long. Ultralytics' exports say which ones they are.
        return signature.classes != 2 or signature.selects or "end2end" not in signature.metadata

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        return decode_end_to_end(_single(outputs), classes)


class _SelectionHead(Head):
    """Base of networks that select boxes themselves, with the outputs of `decode_selected`."""

    selects = True

    def recognises(self, signature: Signature) -> bool:
        return signature.layout == "selection"

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        return decode_selected(outputs, classes)


class _EndToEndDetr(_SelectionHead):
    """RT-DETR with its own selection: the outputs `boxes`, `scores` and `labels`."""

    name = "end2end-detr"
    preprocessing = _STRETCH

    def recognises(self, signature: Signature) -> bool:
        return super().recognises(signature) and {*signature.shapes} == _SELECTED_BY_DETR


class _EndToEndNms(_SelectionHead):
    """A network with non-maximum suppression, by mmdeploy or TensorRT: outputs by other names."""

    name = "end2end-nms"

    def recognises(self, signature: Signature) -> bool:
        return super().recognises(signature) and {*signature.shapes} != _SELECTED_BY_DETR


class _DistanceMaps(_DistancesHead):
    """Base of heads with a class map `(B, N_s, K)` and a distance map `(B, N_s, 4 bins)` for each level of cells.

    The class map of a level comes before its distance map. Distances are those of `decode_distances`, from the middle
    of a cell.
    """

    def recognises(self, signature: Signature) -> bool:
        shapes = [shape for _, shape in signature.outputs]
        if signature.layout != "levels" or any(len(shape) != 3 for shape in shapes):
            return False
        strides = STRIDES[: len(shapes) // 2]
        cells = [cell_count(signature.canvas, [stride]) for stride in strides]
        return sorted(shape[1] for shape in shapes) == sorted(cells * 2)

    def tables(self, outputs: _Outputs, canvas: Canvas) -> tuple[Tensor, ...]:
        strides = STRIDES[: len(outputs) // 2]
        # Some exports have all class maps first, others the two maps of a level together.
        shapes = [tuple(output.shape) for output in outputs.values()]
        class_maps = []
        distance_maps = []
        for stride in strides:
            maps = [output for output in outputs.values() if output.shape[1] == cell_count(canvas, [stride])]
            check(len(maps) == 2, "outputs", f"a class and a distance map at each of strides {strides}", shapes)
            class_maps.append(maps[0])
            distance_maps.append(maps[1])
        scores = torch.cat(class_maps, 1)
        return scores, torch.cat(distance_maps, 1), _grid_of(scores, canvas, strides, 0.5)


class _Picodet(_DistanceMaps):
    """PicoDet: the maps of `_DistanceMaps`, exported by Paddle."""

    name = "picodet"
    preprocessing = _IMAGENET

    def recognises(self, signature: Signature) -> bool:
        # These names are in NanoDet's own exports.
        by_nanodet = any(name.startswith("dis_pred") for name, _ in signature.outputs)
        return super().recognises(signature) and (_made_by_paddle(signature) or not by_nanodet)


class _Nanodet(_DistanceMaps):
    """NanoDet: the maps of `_DistanceMaps`."""

    name = "nanodet"
    preprocessing = _NANODET

    def recognises(self, signature: Signature) -> bool:
        return super().recognises(signature) and not _made_by_paddle(signature)


class _Detr(Head):
    """DETR (Carion et al. 2020): `pred_boxes` `(B, Q, 4)` and logits `(B, Q, K + 1)`.

    Boxes are `c_x c_y w h` as fractions of the canvas. Logits are before a softmax over the classes and "no object",
    which is the last.
    """

    name = "detr"
    preprocessing = _IMAGENET
    background = "own"

    def recognises(self, signature: Signature) -> bool:
        if signature.layout != "queries":
            return False
        # Classes that are unknown are COCO's, by their 91 ids.
        classes = 91 if signature.classes is None else signature.classes
        return query_logits(signature.shapes)[-1] == classes + 1

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        return decode_detr(query_logits(outputs), outputs["pred_boxes"], canvas)


class _SigmoidQueries(Head):
    """Base of DETRs that are trained with focal loss: a sigmoid for each class, without "no object".

    Either boxes `(B, Q, 4)` and logits `(B, Q, K)`, or one output `(B, Q, 4 + K)` with the scores after their sigmoid.
    Boxes are `c_x c_y w h` as fractions of the canvas.
    """

    def decode(self, outputs: _Outputs, canvas: Canvas, classes: int | None, least: float = 0.0) -> Candidates:
        boxes = outputs.get("pred_boxes", outputs.get("dets"))
        if boxes is not None:
            logits = query_logits(outputs)
            check_shape(logits, "logits", None, None, None)
            return Candidates(fraction_corners(boxes, canvas), logits.sigmoid())
        rows = _single(outputs)
        check_shape(rows, "rows", None, None, None)
        return Candidates(fraction_corners(rows[..., :4], canvas), rows[..., 4:])


class _RtDetr(_SigmoidQueries):
    """RT-DETR, D-FINE and others: `pred_boxes` and logits, or rows, of `_SigmoidQueries`."""

    name = "rtdetr"
    preprocessing = _STRETCH

    def recognises(self, signature: Signature) -> bool:
        if signature.layout == "queries":
            # Classes that are unknown are COCO's.
            classes = 80 if signature.classes is None else signature.classes
            return query_logits(signature.shapes)[-1] == classes
        return signature.layout == "rows" and self._recognises_rows(signature.rows, signature)

    def _recognises_rows(self, rows: Rows, signature: Signature) -> bool:
        """Tell whether a model with one output may have this head; only its number of classes tells."""
        if signature.classes is None or rows.cells.anchors:
            return False
        # Rows of 6 are boxes and the scores of two classes, or a box, its score and its class.
        selected = rows.sides[1] == 6 and signature.selects
        return rows.hold_scores_and(4) and not selected


class _RfDetr(_SigmoidQueries):
    """RF-DETR: `dets` and `labels`, the boxes and logits of `_SigmoidQueries`."""

    name = "rfdetr"
    preprocessing = _IMAGENET

    def recognises(self, signature: Signature) -> bool:
        return signature.layout == "dets"


def _made_by_paddle(signature: Signature) -> bool:
    """Tell whether Paddle has exported a model."""
    return "paddle" in signature.producer.lower()


def _single(outputs: _Outputs) -> Tensor:
    """Return the only output of a model."""
    return next(iter(outputs.values()))


def _checked(rows: Tensor) -> Tensor:
    """Return rows of boxes `(B, N, C)`; raises `InputError` for tensors of another shape."""
    check_shape(rows, "outputs", None, None, None)
    return rows


def _grid_of(rows: Tensor, canvas: Canvas, strides: tuple[int, ...], offset: float) -> Tensor:
    """List column, row and stride of the cells that rows `(B, N, C)` are of (`cell_grid`), `(1, N, 3)`."""
    return cell_grid(rows.shape[1], canvas, strides, offset, rows.dtype, rows.device)[None]


def _rows(outputs: _Outputs, canvas: Canvas, *, prefer_columns: bool = False) -> Tensor:
    """Return the only output as rows `(B, N, C)`; exports have boxes along either side.

    `prefer_columns` takes its columns as boxes where both sides, or neither, are as many as cells.
    """
    output = _checked(_single(outputs))
    counts = box_counts(canvas)
    rows_fit, columns_fit = (side in counts for side in output.shape[1:])
    boxes_are_columns = prefer_columns if rows_fit == columns_fit else columns_fit
    return output.mT if boxes_are_columns else output
