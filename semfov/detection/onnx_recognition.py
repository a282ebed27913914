"""Recognition of the head of an ONNX model, and advice if no known head fits."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_heads import HEADS, Head
from semfov.detection.onnx_places import axes_exchanged, misplacement
from semfov.detection.onnx_signature import Signature
from semfov.errors import InputError, check

_Outputs = Mapping[str, Tensor]
"""Outputs of a model by name, in its order."""

_OTHER_TASKS = ("segment", "pose", "obb", "classify")
"""Tasks in Ultralytics' metadata whose outputs are other ones than those of detection."""

_EXPORT = (
    "export the model with the outputs `boxes` (B, N, 4), corners x1 y1 x2 y2 in pixels of its input, and `scores` "
    "(B, N, K) after their sigmoid"
)

MISFITS = KeyError, IndexError, RuntimeError, TypeError, StopIteration, ValueError
"""Errors of a head that decodes the outputs of another one; its own `InputError` is one of them."""


def recognise(signature: Signature, run: Callable[[], _Outputs] | None = None) -> str:
    """Recognise the head of a model.

    Args:
        signature: names and shapes of the model's outputs, and what its metadata says.
        run: runs the model on some image, for its outputs by name; called where several heads fit the signature, to
            compare where they place boxes. None leaves such a model unrecognised.

    Returns:
        The head's name.

    Raises:
        InputError: no head fits, or several do, or the model does not detect objects with all their scores.
    """
    task = signature.metadata.get("task", "detect")
    check(task not in _OTHER_TASKS, "task", "a model that detects objects with upright boxes", f"one for {task!r}")
    _check_has_scores(signature)
    names = [name for name, head in HEADS.items() if head.recognises(signature)]
    if len(names) > 1 and run is not None:
        names = _placing_boxes(names, run(), signature)
    # Outputs with YOLOX's own names are YOLOX's, even where the values do not tell which form they have.
    if len(names) == 1 or names == ["yolox", "yolox-decoded"]:
        return names[0]
    raise InputError(_unrecognised(signature, names, _remedy(signature, names, run)))


def _placing_boxes(names: list[str], outputs: _Outputs, signature: Signature) -> list[str]:
    """List the heads that place boxes on the canvas; all, if none does, so that a message names them."""
    placing = [name for name in names if _reads(HEADS[name], outputs, signature.canvas, signature.classes)]
    return placing or names


def _remedy(signature: Signature, names: Sequence[str], run: Callable[[], _Outputs] | None) -> str:
    """Say what to do about a model that none or several heads fit, those of some names; `run` as for `recognise`."""
    classes = "" if names else _classes_instead(signature)
    if classes:
        return classes
    outputs = {name: torch.zeros(shape) for name, shape in signature.outputs} if run is None else run()
    return remedy_of_head(outputs, signature.canvas, signature.classes)


def _unrecognised(signature: Signature, names: Sequence[str], remedy: str) -> str:
    """Write that no head fits a signature for certain, or that several do, and what to do."""
    shapes = ", ".join(f"{name} {shape}" for name, shape in signature.outputs)
    width, height = signature.canvas
    count = "" if signature.classes is None else f" with {signature.classes} classes"
    candidates = f"{' and '.join(names)} fit" if names else "no head fits with certainty"
    return f"outputs {shapes} on a {width} x {height} canvas{count}: {candidates}; {remedy}"


def _classes_instead(signature: Signature) -> str:
    """Say how many names of classes a head expects that fits all but their number; empty where none does."""
    if signature.classes is None or signature.layout != "rows":
        return ""
    unnamed = replace(signature, classes=None)
    fitting = [head for head in HEADS.values() if head.recognises(unnamed) and not head.selects]
    outputs = {name: torch.ones(shape) for name, shape in signature.outputs}
    counts = {head.decode(outputs, signature.canvas, None).classes.shape[-1] for head in fitting}
    if len(counts) != 1:
        return ""
    return f"give classes= with the {counts.pop()} names of its classes in the order of the scores"


def remedy_of_head(outputs: _Outputs, canvas: Canvas, classes: int | None) -> str:
    """Say which heads read the outputs of a model, or in which form to export it where none does.

    Args:
        outputs: the outputs of a pass by name.
        canvas: `(width, height)` in pixels.
        classes: number of classes; None where it is unknown.

    Returns:
        The remedy, for the end of a message.
    """
    reading = [name for name, head in sorted(HEADS.items()) if _reads(head, outputs, canvas, classes)]
    if reading:
        return f"name the head with head=, one of {', '.join(reading)}"
    return _EXPORT


def _reads(head: Head, outputs: _Outputs, canvas: Canvas, classes: int | None) -> bool:
    """Tell whether a head finds boxes on the canvas in outputs, with a score for each class."""
    try:
        candidates = head.decode(outputs, canvas, classes)
    except MISFITS:
        return False
    boxes = candidates.boxes
    scores = candidates.classes
    has_forms = boxes.ndim == 3 and scores.ndim == 3 and boxes.shape == (*scores.shape[:2], 4)
    if not has_forms or scores.shape[2] == 0 or classes not in (None, scores.shape[2]):
        return False
    return not axes_exchanged(boxes, canvas) and misplacement(boxes, canvas) is None


def _check_has_scores(signature: Signature) -> None:
    """Raise `InputError` for rows of 7: image, box, class and score, which are left after non-maximum suppression."""
    if signature.layout != "rows":
        return
    rows, columns = signature.rows.sides
    name, _ = signature.outputs[0]
    # With three classes, rows of 7 are boxes and all scores; with as many rows as cells, no box was left out.
    selected = columns == 7 and signature.classes != 3 and not signature.rows.cells.anchors
    output = f"output {name} (1, {rows}, {columns})"
    check(not selected, output, "all class scores of each box", "boxes without them; export the model without NMS")


def explain_misplacement(boxes: Tensor, canvas: Canvas, remedy: Callable[[], str] = str) -> str | None:
    """Describe what boxes of one pass look like if another head has made them, and what to do.

    Args:
        boxes: `(B, N, 4)`, corners in canvas pixels.
        canvas: `(width, height)` in pixels.
        remedy: says what to do where boxes do not lie in their places (`remedy_of_head`).

    Returns:
        The description; None for boxes in place.
    """
    if axes_exchanged(boxes, canvas):
        return "boxes whose y comes before x; export the model with boxes as x1 y1 x2 y2"
    reason = misplacement(boxes, canvas)
    return None if reason is None else f"{reason}; {remedy()}"
