"""Detection heads: decoders of their outputs to all boxes with all scores, and the recognition of a head by shapes.

Boxes are `(x1, y1, x2, y2)` in canvas pixels, edges between pixels (0 is the left edge of the canvas).
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from semfov.detection.detector import FAINT
from semfov.detection.objects import LEAST
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.errors import InputError, check, check_shape, values_known
from semfov.sensor.lines import constant

_Outputs = Mapping[str, Tensor]
_Named = TypeVar("_Named")
_Canvas = tuple[int, int]


def cells(canvas: tuple[int, int], stride: int) -> tuple[int, int]:
    """Columns and rows of the map of a level, rounded up where the canvas is not a multiple of `stride`."""
    return -(-canvas[0] // stride), -(-canvas[1] // stride)


def _cell_count(canvas: tuple[int, int], strides: Sequence[int]) -> int:
    """Total number of cells of all levels."""
    return sum(columns * rows for columns, rows in (cells(canvas, stride) for stride in strides))


def _decode_yolov5(rows: Tensor) -> Candidates:
    """Decode YOLOv5-style rows, whose boxes the network itself has decoded; rows `(B, N, 5 + K)`."""
    check_shape(rows, "rows", None, None, None)
    return Candidates(_corners(rows[..., :4]), rows[..., 5:], rows[..., 4])


def decode_yolov8(columns: Tensor) -> Candidates:
    """Decode YOLOv8-style columns, whose boxes the network itself has decoded; columns `(B, 4 + K, N)`."""
    check_shape(columns, "columns", None, None, None)
    rows = columns.transpose(1, 2)
    return Candidates(_corners(rows[..., :4]), rows[..., 4:])


def _decode_end_to_end(rows: Tensor, classes: int | None) -> Candidates:
    """Decode rows `x1 y1 x2 y2 score class`, `(B, N, 6)`, that a network has selected itself: other scores are 0."""
    if classes is None:
        expected = "the names of the model's classes, which its rows only number"
        raise InputError(f"classes: expected {expected}, got None; give them by classes=cat,dog")
    check_shape(rows, "rows", None, None, 6)
    scores, numbers = rows[..., 4], rows[..., 5]
    if values_known(rows):
        used = numbers[scores > 0]
        whole = bool((used == used.round()).all())
        check(whole, "rows", "a whole number of a class in the last column", used[:3].tolist())
        known = not len(used) or (float(used.min()) >= 0 and float(used.max()) < classes)
        got = f"{classes}, and class {used.max() if len(used) else 0:g}"
        check(known, "classes", "a name for each class of the rows", got)
    index = numbers.nan_to_num(0).long().clamp(0, max(classes - 1, 0))
    vectors = scores.new_zeros(*scores.shape, classes).scatter(-1, index[..., None], scores[..., None])
    return Candidates(rows[..., :4], vectors)


def _selected_outputs(outputs: Mapping[str, _Named]) -> dict[str, _Named]:
    """The outputs of a network that selects boxes itself by what they are: boxes, scores, labels and count."""
    found = {what: next((name for name in names if name in outputs), None) for what, names in _SELECTED.items()}
    return {what: outputs[name] for what, name in found.items() if name is not None}


def _decode_selected(outputs: _Outputs, canvas: _Canvas, classes: int | None) -> Candidates:
    """Decode boxes `(B, N, 4)`, scores and labels `(B, N)` that a network has selected itself, as rows of `end2end`.

    Scores may be the fifth column of the boxes. Where a network counts its boxes, those after that number are padding.
    """
    found = _selected_outputs(outputs)
    boxes, labels = found["boxes"], found["labels"]
    check_shape(labels, "labels", None, None)
    scores = found["scores"] if "scores" in found else boxes[..., 4]
    if "count" in found:
        place = torch.arange(scores.shape[1], device=scores.device)
        scores = scores * (place < found["count"].reshape(-1, 1))
    return _decode_end_to_end(torch.cat([boxes[..., :4], scores[..., None], labels[..., None]], -1), classes)


def _decode_distances(
    classes: Tensor,
    distances: Tensor,
    canvas: _Canvas,
    *,
    strides: tuple[int, ...] = (8, 16, 32, 64),
    offset: float = 0.5,
) -> Candidates:
    r"""Decode boxes given as distributions over the distance to each side (distribution focal loss, Li et al. 2020).

    The distance from the point `p = (cell + offset) s` to the left, upper, right or lower side is
    `d = s Σ_b b softmax(t)_b`.

    Shapes: classes `(B, N, K)`, distances `(B, N, 4 bins)`.
    """
    check_shape(classes, "classes", None, None, None)
    check_shape(distances, "distances", None, classes.shape[1], None)
    bins = distances.shape[-1] // 4
    whole = bins > 0 and distances.shape[-1] == 4 * bins
    check(whole, "distances", "4 · bins channels, the same number of bins for each side", tuple(distances.shape))
    grid = _grid(distances.shape[1], canvas, strides, offset, distances.dtype, distances.device)
    expected = distances.unflatten(-1, (4, bins)).softmax(-1) @ torch.arange(bins).to(distances)
    point, reach = grid[:, :2] * grid[:, 2:], expected * grid[:, 2:]
    return Candidates(torch.cat([point - reach[..., :2], point + reach[..., 2:]], -1), classes)


def _decode_detr(logits: Tensor, boxes: Tensor, canvas: tuple[int, int]) -> Candidates:
    """Decode DETR (Carion et al. 2020), with a softmax over the classes and "no object"; logits `(B, Q, K + 1)`."""
    check_shape(logits, "logits", None, None, None)
    scores = logits.softmax(-1)
    return Candidates(_fractions(boxes, canvas), scores[..., :-1], background=scores[..., -1])


@constant
def _grid(
    count: int, canvas: _Canvas, strides: tuple[int, ...], offset: float, dtype: torch.dtype, device: torch.device
) -> Tensor:
    """Column, row and stride of each of the `count` cells of all levels, `(N, 3)`."""
    expected = _cell_count(canvas, strides)
    what = f"{expected} rows, one for each cell of a {canvas[0]} x {canvas[1]} canvas at strides {strides}"
    check(count == expected, "output of the head", what, count)
    levels = []
    for stride in strides:
        columns, rows = (torch.arange(side, device=device, dtype=dtype) + offset for side in cells(canvas, stride))
        x, y = torch.meshgrid(columns, rows, indexing="xy")
        levels.append(torch.stack([x, y, torch.full_like(x, stride)], -1).reshape(-1, 3))
    return torch.cat(levels)


def _corners(boxes: Tensor) -> Tensor:
    centre, half = boxes[..., :2], boxes[..., 2:] / 2
    return torch.cat([centre - half, centre + half], -1)


def _fractions(boxes: Tensor, canvas: tuple[int, int]) -> Tensor:
    check_shape(boxes, "boxes", None, None, 4)
    return _corners(boxes) * boxes.new_tensor(canvas * 2)


def misplaced(boxes: Tensor, canvas: tuple[int, int]) -> str | None:
    """What boxes `(B, N, 4)` of one pass look like if another head has made them, and what to do; None if in place."""
    wrong = _wrong_places(boxes, canvas)
    # Boxes of a network that selects them are in no order, and a square canvas has room for both readings.
    exchanged = _exchanged(boxes, canvas) if wrong is None else _wrong_places(boxes[..., _EXCHANGED], canvas) is None
    if exchanged:
        return "boxes whose y comes before x; export the model with boxes as x1 y1 x2 y2"
    return wrong and f"{wrong}; name the model's head with head=, one of {', '.join(sorted(HEADS))}"


def _exchanged(boxes: Tensor, canvas: tuple[int, int]) -> bool:
    """Whether the middles of boxes in the order of cells go down where the cells of the finest level go right."""
    if boxes.shape[1] not in _box_counts(canvas):
        return False
    columns, rows = cells(canvas, STRIDES[0])
    cell = torch.arange(columns * rows)
    places = torch.stack([(boxes[0, cell, side] + boxes[0, cell, side + 2]).detach().cpu() for side in (0, 1)])
    both = torch.corrcoef(torch.cat([places.double(), torch.stack([cell % columns, cell // columns])]))
    return bool((both[0, 3] > _ALONG) & (both[1, 2] > _ALONG))


def _wrong_places(boxes: Tensor, canvas: tuple[int, int]) -> str | None:
    """Why boxes `(B, N, 4)` of one pass cannot be in their places, in words; None for boxes that can."""
    rows = boxes.detach().reshape(-1, 4).double()
    rows = rows[(rows != 0).any(-1)][:_ENOUGH]  # empty rows of a network that selects boxes itself
    if not len(rows):
        return None
    low, high, size = rows[:, :2], rows[:, 2:], rows.new_tensor(canvas)
    middle = (low + high) / 2
    if not bool(rows.isfinite().all()):
        return "boxes that are not finite"
    spread = middle.quantile(0.9, 0) - middle.quantile(0.1, 0)
    many = len(rows) >= _MANY and bool((spread > size / 4).all())
    odd = torch.stack([high < low, (middle - size / 2).abs() > size])
    crossed, outside = (odd.any(-1).double().mean(-1) >= _MOST_MISPLACED).tolist()
    places = middle.median(0).values.round().long().tolist()
    forms = {
        "fractions of the canvas instead of pixels": float(rows.abs().max()) <= _FRACTIONS < min(canvas),
        "boxes whose right or lower edge comes first": crossed,
        "corners of boxes that were read as their centres and sizes": many and bool((high >= 3 * low).all()),
        f"boxes around {places}, outside the canvas": outside,
    }
    return next((form for form, fits in forms.items() if fits), None)


_FRACTIONS = 2.0  # coordinates up to here, of all boxes of a canvas, are no pixels
_EXCHANGED = [1, 0, 3, 2]  # coordinates of boxes with y before x
_ALONG = 0.8  # correlation of places with cells from which on boxes follow them
_ENOUGH = 100_000  # number of boxes whose places are looked at
_MANY = 20  # number of boxes from which on all of them do not begin in the upper left corner
_MOST_MISPLACED = 0.5  # share of the boxes of a pass that may lie elsewhere

_LETTERBOX = Preprocessing()
_YOLOX = Preprocessing(channels="bgr", scale=255.0, corner=True)
_IMAGENET = Preprocessing(mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225), stretch=True)
_NANODET = Preprocessing(
    channels="bgr", scale=255.0, mean=(103.53, 116.28, 123.675), std=(57.375, 57.12, 58.395), stretch=True
)

STRIDES = (8, 16, 32, 64)
_OTHER_TASKS = ("segment", "pose", "obb", "classify")
"""Tasks in Ultralytics' metadata whose outputs are other ones than those of detection."""
_SCORES = "all class scores of each box"
_DETR_LOGITS = ("logits", "pred_logits", "labels")
_DETR_BOXES = ("pred_boxes", "dets")
_SELECTED = {
    "boxes": ("boxes", "dets", "det_boxes", "bboxes", "nmsed_boxes"),
    "scores": ("scores", "det_scores", "nmsed_scores"),
    "labels": ("labels", "det_classes", "nmsed_classes", "classes"),
    "count": ("num_dets", "num_detections"),
}
"""Names of the outputs of networks that select boxes themselves: RT-DETR's, mmdeploy's and those of TensorRT."""


class _DetectionHead(NamedTuple):
    """The head of a family of networks; `decode` takes outputs, `(width, height)` and the number of names, if known."""

    decode: Callable[[_Outputs, _Canvas, int | None], Candidates]
    preprocessing: Preprocessing = _LETTERBOX
    background: BackgroundPolicy = "residual"
    faint: float = FAINT
    least: float = LEAST


@dataclass(frozen=True)
class Signature:
    """Properties of a model that are known before it runs on an image; canvas `(width, height)`."""

    image: str
    outputs: tuple[tuple[str, tuple[int, ...]], ...]
    canvas: _Canvas
    producer: str = ""
    classes: int | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    def head(self, run: Callable[[], _Outputs] | None = None) -> str:
        """Recognise the head of a model by its metadata, by names and shapes, and by where `run` places boxes."""
        task = self.metadata.get("task", "detect")
        check(task not in _OTHER_TASKS, "task", "a model that detects objects with upright boxes", f"one for {task!r}")
        names = list(_fitting(self))
        if len(names) > 1 and run is not None:
            outputs = run()
            names = [name for name in names if _fits(name, outputs, self)] or names
        if len(names) == 1 or names == ["yolox", "yolox-decoded"]:  # YOLOX's own names, and values that do not tell
            return names[0]
        shapes = ", ".join(f"{name} {shape}" for name, shape in self.outputs)
        width, height = self.canvas
        count = "" if self.classes is None else f" with {self.classes} classes"
        fits = f"{' and '.join(names)} fit" if names else "no head fits with certainty"
        raise InputError(
            f"outputs {shapes} on a {width} x {height} canvas{count}: {fits}; "
            f"name the head with head=, one of {', '.join(sorted(HEADS))}"
        )


def _fits(name: str, outputs: _Outputs, signature: Signature) -> bool:
    """Whether the boxes that a head makes of outputs lie on the canvas."""
    try:
        found = HEADS[name].decode(outputs, signature.canvas, signature.classes)
    except InputError:
        return False
    return misplaced(found.boxes, signature.canvas) is None


def _fitting(signature: Signature) -> Iterator[str]:
    shapes = dict(signature.outputs)
    names = list(shapes)
    selected = _selected_outputs(shapes)
    if "pred_boxes" in shapes and any(name in shapes for name in _DETR_LOGITS):
        # A softmax has one channel more than classes. Unknown classes are COCO's, 91 ids or 80 classes.
        channels, classes = shapes[_logits(shapes)][-1], signature.classes
        if channels == (80 if classes is None else classes):
            yield "rtdetr"
        elif channels == (92 if classes is None else classes + 1):
            yield "detr"
    elif {"dets", "labels"} <= shapes.keys() and len(shapes["labels"]) == 3:
        yield "rfdetr"
    elif "boxes" in selected and len(selected.get("labels", ())) == 2:
        yield "end2end-detr" if {*shapes} == {"labels", "boxes", "scores"} else "end2end-nms"
    elif "boxes" in shapes and shapes.keys() & {"classes", "scores"}:
        yield "candidates"
    elif len(shapes) > 1:
        yield from _distances(signature)
    elif len(shapes[names[0]]) == 3:
        yield from _single(signature, names[0], *shapes[names[0]][1:])


def _distances(signature: Signature) -> Iterator[str]:
    """Heads with a class map and a distance map for each level."""
    shapes = [shape for _, shape in signature.outputs]
    count = len(shapes) // 2
    rows = [_cell_count(signature.canvas, [stride]) for stride in STRIDES[:count]]
    if any(len(shape) != 3 for shape in shapes) or sorted(shape[1] for shape in shapes) != sorted(rows * 2):
        return
    if "paddle" in signature.producer.lower():
        yield "picodet"
    elif any(name.startswith("dis_pred") for name, _ in signature.outputs):
        yield "nanodet"
    else:
        yield from ("picodet", "nanodet")


def _single(signature: Signature, name: str, rows: int, columns: int) -> Iterator[str]:
    """Heads with everything in one tensor `(1, rows, columns)`, of which either may be the boxes."""
    classes, meta = signature.classes, signature.metadata
    counts = _box_counts(signature.canvas)
    across = columns in counts and rows not in counts
    anchors, levels = counts.get(columns if across else rows, (0, 0))
    channels = rows if across else columns

    def scores(others: int) -> bool:
        return channels > others and classes in (None, channels - others)

    if anchors == 3:
        yield from ("yolov5",) if scores(5) else ()
    # Without names, rows have an objectness unless their scores are as many as COCO's.
    elif anchors and scores(4) and (across or classes is not None or channels - 4 in (80, 91)):
        yield "yolov8"
    elif levels == 3 and scores(5) and not across:
        named = (signature.image, name) == ("images", "output")  # names in YOLOX's own exports
        yield from ("yolox", "yolox-decoded", *(() if named else ("yolov5",)))
    elif levels == 4 and not across:
        yield from ("nanodet-plus",) if scores(32) else ()
        yield from ("yolov5",) if scores(5) else ()
    elif columns == 6 and not anchors:
        selects = meta.get("end2end") == "True" or "'nms': True" in meta.get("args", "")
        if classes != 2 or selects or "end2end" not in meta:
            yield "end2end"
        if classes == 2 and not selects:
            yield "rtdetr"
    elif columns == 7 and classes != 3 and not anchors:
        got = "boxes without them; export the model without NMS"
        check(False, f"output {name} (1, {rows}, {columns})", _SCORES, got)
    elif classes is not None and scores(4) and not across:
        yield "rtdetr"


def _box_counts(canvas: _Canvas) -> dict[int, tuple[int, int]]:
    """Anchors per cell and levels by the number of boxes of a head with cells."""
    return {
        anchors * _cell_count(canvas, STRIDES[:levels]): (anchors, levels) for anchors in (3, 1) for levels in (4, 3)
    }


def _logits(outputs: Mapping[str, object]) -> str:
    return next(name for name in _DETR_LOGITS if name in outputs)


def _first(outputs: _Outputs) -> Tensor:
    return next(iter(outputs.values()))


def _rows(outputs: _Outputs, canvas: _Canvas, *, across: bool = False) -> Tensor:
    """The only tensor of a head as rows `(B, N, C)`; `across`: usually the boxes are its columns."""
    tensor, counts = _first(outputs), _box_counts(canvas)
    check_shape(tensor, "outputs", None, None, None)
    rows, columns = (size in counts for size in tensor.shape[1:])
    return tensor.mT if (columns and not rows) or (across and rows == columns) else tensor


def _candidates(outputs: _Outputs, canvas: _Canvas, count: int | None) -> Candidates:
    scores = outputs["classes" if "classes" in outputs else "scores"]
    return Candidates(outputs["boxes"], scores, outputs.get("objectness"), outputs.get("background"))


def _yolox(outputs: _Outputs, canvas: _Canvas, count: int | None) -> Candidates:
    """Decode the raw output of YOLOX (Ge et al. 2021), `(B, N, 5 + K)`.

    For the cell (i, j) of a level with stride s, centre and size of the box are

        c_x = (t_x + i) s,   c_y = (t_y + j) s,   w = s exp(t_w),   h = s exp(t_h)
    """
    raw = _first(outputs)
    check_shape(raw, "raw", None, None, None)
    if values_known(raw) and raw.numel():
        low, high = map(float, raw[..., :4].detach().aminmax())
        form = "offsets from cells and logarithms of sizes, some of them below 0"
        check(not 0 <= low < high <= 1, "output of the head", form, "numbers from 0 to 1, as fractions of the canvas")
    grid = _grid(raw.shape[1], canvas, STRIDES[:3], 0.0, raw.dtype, raw.device)
    centre = (raw[..., 0:2] + grid[:, :2]) * grid[:, 2:]
    size = raw[..., 2:4].exp() * grid[:, 2:]
    return Candidates(_corners(torch.cat([centre, size], -1)), raw[..., 5:], raw[..., 4])


def _level_maps(outputs: _Outputs, canvas: _Canvas, count: int | None) -> Candidates:
    """Decode PicoDet and NanoDet, where the class map of a level comes before its distance map."""
    strides = STRIDES[: len(outputs) // 2]
    counts = [_cell_count(canvas, [stride]) for stride in strides]
    levels = [[each for each in outputs.values() if each.shape[1] == count] for count in counts]
    pairs, shapes = all(len(level) == 2 for level in levels), [tuple(each.shape) for each in outputs.values()]
    check(pairs, "outputs", f"a class and a distance map at each of strides {strides}", shapes)
    classes, distances = (torch.cat([level[index] for level in levels], 1) for index in (0, 1))
    return _decode_distances(classes, distances, canvas, strides=strides)


def _rtdetr(outputs: _Outputs, canvas: _Canvas, count: int | None) -> Candidates:
    """Decode DETRs trained with focal loss (RT-DETR): a sigmoid a class, without "no object"; logits `(B, Q, K)`."""
    boxes = next((outputs[name] for name in _DETR_BOXES if name in outputs), None)
    if boxes is not None:
        logits = outputs[_logits(outputs)]
        check_shape(logits, "logits", None, None, None)
        return Candidates(_fractions(boxes, canvas), logits.sigmoid())
    rows = _first(outputs)  # `(B, Q, 4 + K)`, with the scores after their sigmoid
    check_shape(rows, "rows", None, None, None)
    return Candidates(_fractions(rows[..., :4], canvas), rows[..., 4:])


HEADS: dict[str, _DetectionHead] = {
    "candidates": _DetectionHead(_candidates),
    "yolox": _DetectionHead(_yolox, _YOLOX),
    "yolox-decoded": _DetectionHead(lambda outputs, canvas, _: _decode_yolov5(_first(outputs)), _YOLOX),
    "yolov5": _DetectionHead(lambda outputs, canvas, _: _decode_yolov5(_rows(outputs, canvas))),
    "yolov8": _DetectionHead(lambda outputs, canvas, _: decode_yolov8(_rows(outputs, canvas, across=True).mT)),
    "end2end": _DetectionHead(lambda outputs, _, count: _decode_end_to_end(_first(outputs), count)),
    "end2end-detr": _DetectionHead(_decode_selected, Preprocessing(stretch=True)),
    "end2end-nms": _DetectionHead(_decode_selected),
    "picodet": _DetectionHead(_level_maps, _IMAGENET),
    "nanodet": _DetectionHead(_level_maps, _NANODET),
    # Class scores, then distances with 8 bins for each side. Nearly every candidate exceeds the usual threshold of
    # hints, as there is no objectness. All classes of a box have some score, which would dilute that of the best one if
    # only their shares counted.
    "nanodet-plus": _DetectionHead(
        lambda outputs, canvas, _: _decode_distances(
            _first(outputs)[..., :-32], _first(outputs)[..., -32:], canvas, offset=0.0
        ),
        _NANODET,
        "normalised",
        faint=0.02,
        least=0.2,
    ),
    "detr": _DetectionHead(
        lambda outputs, canvas, _: _decode_detr(outputs[_logits(outputs)], outputs["pred_boxes"], canvas),
        _IMAGENET,
        "own",
    ),
    "rtdetr": _DetectionHead(_rtdetr, Preprocessing(stretch=True)),
    "rfdetr": _DetectionHead(_rtdetr, _IMAGENET),
}
"""All known heads by name."""
