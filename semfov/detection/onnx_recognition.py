"""Recognition of the head of an ONNX model by names and shapes, where only one head fits."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.detection import onnx_heads as heads
from semfov.detection.detector import FAINT
from semfov.detection.objects import LEAST
from semfov.detection.preprocessing import IMAGENET_MEAN, IMAGENET_STD, Preprocessing
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.errors import InputError

Outputs = Mapping[str, Tensor]
Canvas = tuple[int, int]

_LETTERBOX = Preprocessing()
_IMAGENET = Preprocessing(mean=IMAGENET_MEAN, std=IMAGENET_STD, stretch=True)
_NANODET = Preprocessing(
    channels="bgr", scale=255.0, mean=(103.53, 116.28, 123.675), std=(57.375, 57.12, 58.395), stretch=True
)

STRIDES = (8, 16, 32, 64)
DETR_LOGITS = ("logits", "pred_logits")


@dataclass(frozen=True)
class DetectionHead:
    """The head of a family of networks.

    Attributes:
        decode: function from the outputs by name, in the model's order, and the canvas `(width, height)` to all boxes.
        preprocessing: preprocessing with which the family is trained.
        background: background policy for its scores.
        faint: confidence from which on its candidates are hints (`semfov.detection.Detector`).
        least: score from which on its detections count.
    """

    decode: Callable[[Outputs, Canvas], Candidates]
    preprocessing: Preprocessing = _LETTERBOX
    background: BackgroundPolicy = "residual"
    faint: float = FAINT
    least: float = LEAST


@dataclass(frozen=True)
class Signature:
    """Properties of a model that are known before it runs on an image.

    Attributes:
        image: name of the image input.
        outputs: name and shape of each output for a batch of one canvas.
        canvas: `(width, height)` of the canvas.
        producer: name of the exporter, as stored in the file.
        classes: number of classes; None where it is not known.
    """

    image: str
    outputs: tuple[tuple[str, tuple[int, ...]], ...]
    canvas: Canvas
    producer: str = ""
    classes: int | None = None


def recognise(signature: Signature) -> str:
    """Recognise the head of a model.

    Args:
        signature: properties of the model.

    Returns:
        The name of the head in `HEADS`.

    Raises:
        InputError: no head or several heads fit (the message lists the choices), or the model returns boxes without
            their full scores.

    >>> recognise(Signature("images", (("output0", (1, 84, 8400)),), (640, 640)))
    'yolov8'
    """
    names = list(_fitting(signature))
    if len(names) == 1:
        return names[0]
    shapes = ", ".join(f"{name} {shape}" for name, shape in signature.outputs)
    width, height = signature.canvas
    count = "" if signature.classes is None else f" with {signature.classes} classes"
    fits = f"{' and '.join(names)} fit" if names else "no head fits with certainty"
    raise InputError(
        f"outputs {shapes} on a {width} x {height} canvas{count}: {fits}; "
        f"name the head with head=, one of {', '.join(sorted(HEADS))}"
    )


def _fitting(signature: Signature) -> Iterator[str]:
    shapes = dict(signature.outputs)
    names = list(shapes)
    if "pred_boxes" in shapes and any(name in shapes for name in DETR_LOGITS):
        yield from _detr(shapes[_logits(shapes)][-1], signature.classes)
    elif {"labels", "boxes", "scores"} <= set(shapes):
        raise InputError(
            f"outputs {', '.join(names)}: expected all class scores of each box, got one class; export the model "
            f"without its top-k"
        )
    elif {"boxes", _classes(shapes)} <= set(shapes):
        yield "candidates"
    elif len(shapes) > 1:
        yield from _distances(signature)
    elif len(shapes[names[0]]) == 3:
        yield from _single(signature, names[0], *shapes[names[0]][1:])


def _detr(channels: int, classes: int | None) -> Iterator[str]:
    """Heads of DETR; a softmax has one channel more than classes. Unknown classes are COCO's, 91 ids or 80 classes."""
    if channels == (80 if classes is None else classes):
        yield "rtdetr"
    elif channels == (92 if classes is None else classes + 1):
        yield "detr"


def _distances(signature: Signature) -> Iterator[str]:
    """Heads with a class map and a distance map for each level."""
    shapes = [shape for _, shape in signature.outputs]
    count = len(shapes) // 2
    rows = [columns * rows for columns, rows in (heads.cells(signature.canvas, s) for s in STRIDES[:count])]
    if any(len(shape) != 3 for shape in shapes) or sorted(shape[1] for shape in shapes) != sorted(rows * 2):
        return
    if "paddle" in signature.producer.lower():
        yield "picodet"
    elif any(name.startswith("dis_pred") for name, _ in signature.outputs):
        yield "nanodet"
    else:
        yield from ("picodet", "nanodet")


def _single(signature: Signature, name: str, rows: int, columns: int) -> Iterator[str]:
    """Heads with everything in one tensor `(1, rows, columns)`."""
    canvas, classes = signature.canvas, signature.classes
    three, four = (heads.cell_count(canvas, STRIDES[:count]) for count in (3, 4))

    def scores(channels: int, others: int) -> bool:
        return channels > others and classes in (None, channels - others)

    if columns in (6, 7) and rows not in (three, four, 3 * three, 3 * four) and classes != columns - 4:
        raise InputError(
            f"output {name} (1, {rows}, {columns}): expected all class scores of each box, got boxes without them; "
            f"export the model without NMS"
        )
    if columns in (three, four) and scores(rows, 4):
        yield "yolov8"
    elif rows in (3 * three, 3 * four) and scores(columns, 5):
        yield "yolov5"
    elif rows == three and scores(columns, 5):
        yield "yolox"
        if (signature.image, name) != ("images", "output"):  # names in YOLOX's own exports of raw outputs
            yield "yolov5"
    elif rows == four and classes is None:
        yield from ("nanodet-plus", "yolov5")
    elif rows == four and scores(columns, 32):
        yield "nanodet-plus"
    elif classes is not None and scores(columns, 4):
        yield "rtdetr"


def _logits(outputs: Mapping[str, object]) -> str:
    return next(name for name in DETR_LOGITS if name in outputs)


def _classes(outputs: Mapping[str, object]) -> str:
    return "classes" if "classes" in outputs else "scores"


def _first(outputs: Outputs) -> Tensor:
    return next(iter(outputs.values()))


def _candidates(outputs: Outputs, canvas: Canvas) -> Candidates:
    return Candidates(
        outputs["boxes"], outputs[_classes(outputs)], outputs.get("objectness"), outputs.get("background")
    )


def _level_maps(outputs: Outputs, canvas: Canvas) -> Candidates:
    """Decode PicoDet and NanoDet, where the class map of a level comes before its distance map."""
    strides = STRIDES[: len(outputs) // 2]
    maps = list(outputs.values())
    levels = []
    for stride in strides:
        columns, rows = heads.cells(canvas, stride)
        levels.append([each for each in maps if each.shape[1] == columns * rows])
    if any(len(level) != 2 for level in levels):
        got = [tuple(each.shape) for each in maps]
        raise InputError(f"outputs: expected a class and a distance map at each of strides {strides}, got {got}")
    classes, distances = (torch.cat([level[index] for level in levels], 1) for index in (0, 1))
    return heads.decode_distances(classes, distances, canvas, strides=strides)


def _nanodet_plus(outputs: Outputs, canvas: Canvas) -> Candidates:
    """Decode NanoDet-Plus: class scores, then distances with 8 bins for each side."""
    rows = _first(outputs)
    return heads.decode_distances(rows[..., :-32], rows[..., -32:], canvas, strides=STRIDES, offset=0.0)


def _rtdetr(outputs: Outputs, canvas: Canvas) -> Candidates:
    if "pred_boxes" in outputs:
        return heads.decode_rtdetr(outputs[_logits(outputs)], outputs["pred_boxes"], canvas)
    return heads.decode_rtdetr_rows(_first(outputs), canvas)


HEADS: dict[str, DetectionHead] = {
    "candidates": DetectionHead(_candidates),
    "yolox": DetectionHead(
        lambda outputs, canvas: heads.decode_yolox(_first(outputs), canvas),
        Preprocessing(channels="bgr", scale=255.0, corner=True),
    ),
    "yolov5": DetectionHead(lambda outputs, canvas: heads.decode_yolov5(_first(outputs))),
    "yolov8": DetectionHead(lambda outputs, canvas: heads.decode_yolov8(_first(outputs))),
    "picodet": DetectionHead(_level_maps, _IMAGENET),
    "nanodet": DetectionHead(_level_maps, _NANODET),
    # Nearly every candidate exceeds the usual threshold of hints, as there is no objectness. All classes of a box have
    # some score, which would dilute that of the best one if only their shares counted.
    "nanodet-plus": DetectionHead(_nanodet_plus, _NANODET, "normalised", faint=0.02, least=0.2),
    "detr": DetectionHead(
        lambda outputs, canvas: heads.decode_detr(outputs[_logits(outputs)], outputs["pred_boxes"], canvas),
        _IMAGENET,
        "own",
    ),
    "rtdetr": DetectionHead(_rtdetr, Preprocessing(stretch=True)),
}
"""All known heads by name."""
