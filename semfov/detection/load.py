"""`load_detector`: every detector by its name or its file."""

from collections.abc import Sequence
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch

from semfov.detection.architectures import ARCHITECTURES
from semfov.detection.coco_classes import COCO_CLASSES
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import read_cfg
from semfov.detection.darknet_weights import read_weights
from semfov.detection.detector import Detector
from semfov.detection.onnx_twin import Runtime
from semfov.detection.scores import BackgroundPolicy
from semfov.detection.selection import Selection
from semfov.detection.weights import WEIGHTS, fetch
from semfov.detection.yolo import YoloV3
from semfov.errors import DataError, InputError, lookup
from semfov.io.files import check_regular

_WEIGHTS_ALONE = "detector: expected a cfg and its weights, load_detector('x.cfg', weights='{}')"


def load_detector(name_or_path: str | PathLike[str], **options: Any) -> Detector:
    """A detector by its name or its file, ready for inference.

    - `"yolov3-tiny"`, `"yolov3"`, `"yolov3-spp"`: options of `load_yolo`.
    - a path that ends in `.cfg`, with `weights=`: any Darknet network with YOLOv3 heads; options of `load_yolo`.
    - a path that ends in `.onnx`: a model of your own; options of `semfov.detection.onnx.load_onnx`.
    - `"yolox-nano"`, `"yolox-tiny"`, `"yolox-s"`: published models; options of the same.
    - `"torchvision:<model>"`: options of `semfov.detection.torchvision.load_torchvision`.

    The weights of a name are downloaded once (`semfov.detection.weights`); `weights=` reads a file instead.

    Raises:
        InputError: the name or an option is not known.
        DataError: weights are damaged, or cannot be had.
    """
    name = fspath(name_or_path)
    if name.endswith(".onnx") or (name in WEIGHTS and WEIGHTS[name].file.endswith(".onnx")):
        from semfov.detection.onnx import load_onnx

        return load_onnx(name, **options)
    if name.startswith("torchvision:"):
        from semfov.detection.torchvision import load_torchvision

        return load_torchvision(name, **options)
    if name.endswith(".weights"):
        raise InputError(_WEIGHTS_ALONE.format(name))
    if not name.endswith(".cfg"):
        lookup(name, WEIGHTS, "detector")
    return load_yolo(name, **options)


def check_detector(name_or_path: str | PathLike[str]) -> tuple[str, ...] | None:
    """Whether this names a detector, told without loading it: its classes, or None where only the model knows them.

    Raises:
        InputError: no detector has this name.
        DataError: there is no such file.

    >>> check_detector("yolox-nano")[:2]
    ('person', 'bicycle')
    """
    name = fspath(name_or_path)
    if name.endswith((".onnx", ".cfg")):
        if not Path(name).exists():
            raise DataError(f"detector: no such file: {name}; check the path")
        check_regular(name)
        return None
    if name.startswith("torchvision:"):
        return None
    if name.endswith(".weights"):
        raise InputError(_WEIGHTS_ALONE.format(name))
    lookup(name, WEIGHTS, "detector")
    return COCO_CLASSES


def load_yolo(
    name_or_cfg: str,
    *,
    weights: str | PathLike[str] | None = None,
    classes: Sequence[str] | str | PathLike[str] | None = None,
    input_size: int | tuple[int, int] | None = None,
    stride: int | None = 32,
    background: BackgroundPolicy = "residual",
    threshold: float = 0.02,
    iou: float = 0.5,
    limit: int = 100,
    per_class: bool = False,
    runtime: Runtime = "auto",
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
) -> YoloV3:
    """YOLOv3, YOLOv3-tiny, YOLOv3-spp or a network from a cfg of your own, with trained weights.

    Args:
        name_or_cfg: name, or path of a cfg.
        weights: path of a Darknet weights file; None takes the published weights of `name_or_cfg`.
        classes: class names, or a text file with one on each line; None means the 80 of COCO.
        input_size: canvas in pixels, one side or `(width, height)`; None takes the cfg's.
        stride: pad the canvas only to a multiple of it; None pads to `input_size`.
        background: background policy of the scores (`semfov.detection.score_vectors`).
        threshold: see `Selection`, as for `iou`, `limit` and `per_class`.
        runtime: what computes the network: `"torch"`, `"onnxruntime"` on a CPU without gradients, or `"auto"`, which
            takes onnxruntime where it can, as it is faster, and else torch (`semfov.detection.yolo.YoloV3`).
        device: where the network lives.
        dtype: of the network's parameters.
    """
    if name_or_cfg.endswith(".cfg"):
        if weights is None:
            raise InputError(f"weights: expected the path of the weights for {name_or_cfg!r}, got None")
        name, sections = Path(name_or_cfg).stem, read_cfg(name_or_cfg)
    else:
        name = lookup(name_or_cfg, ARCHITECTURES, "detector")
        sections = ARCHITECTURES[name]()
    network = Darknet(sections).to(dtype).requires_grad_(False)
    digest = read_weights(network, fetch(name) if weights is None else weights)
    network.to(memory_format=torch.channels_last)
    detector = YoloV3(
        network,
        _names(classes),
        name=name,
        input_size=(input_size, input_size) if isinstance(input_size, int) else input_size,
        stride=stride,
        background=background,
        selection=Selection(threshold, iou, limit, per_class),
        digest=digest,
        runtime=runtime,
    )
    return detector.to(device).eval()


def _names(classes: Sequence[str] | str | PathLike[str] | None) -> tuple[str, ...]:
    """Class names from a list, from the lines of a file, or COCO's."""
    if not isinstance(classes, str | PathLike):
        return COCO_CLASSES if classes is None else tuple(classes)
    check_regular(classes)
    try:
        lines = Path(classes).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read the class names in {str(classes)!r}: {error}") from error
    return tuple(line.strip() for line in lines if line.strip())
