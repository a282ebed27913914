"""Loading of detectors by name, file or model: `load_detector`."""

import re
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import fields, replace
from inspect import Parameter, signature
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import nn

from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.darknet import Darknet
from semfov.detection.darknet_config import ARCHITECTURES, read_cfg
from semfov.detection.detector import Detector
from semfov.detection.onnx import load_onnx
from semfov.detection.selection import Selection
from semfov.detection.torchvision import TorchvisionDetector
from semfov.detection.transformers import TransformersDetector
from semfov.detection.ultralytics import UltralyticsDetector
from semfov.detection.weights import WEIGHTS, fetch
from semfov.detection.yolo import Runtime, YoloV3
from semfov.errors import DataError, InputError, check, check_device, check_options, lookup
from semfov.io.files import check_regular, read_text

_EXPORTED = re.compile(r"(yolo(v?([5-9]|1\d|26)|world|-nas|e-)[a-z0-9_-]*|rt-?detr[a-z0-9_-]*)")
"""Names of models of Ultralytics, of which there are files of Python's pickle."""

_OTHER_FORMATS = (".tflite", ".engine", ".trt", ".xml", ".bin", ".pb", ".h5", ".keras", ".mlmodel", ".safetensors")
"""Ends of the names of models in formats that are not read."""

_SELECTING = [each.name for each in fields(Selection)]
_COMMON = ["background", "device", *_SELECTING]  # options of all detectors

_WRAPPERS: dict[str, Callable[..., Detector]] = {
    "torchvision.models.detection.": TorchvisionDetector,
    "transformers.models.": TransformersDetector,
    "ultralytics.": UltralyticsDetector,
}
"""Classes of detectors that hold a module (in memory, not a copy), by the package of its class or of its bases."""

_INNER = "module", "_orig_mod", "model"
"""Where a model is in what wraps it: for several GPUs, compiled, or for training."""

DetectorLike = str | PathLike[str] | nn.Module
"""What `load_detector` takes: the name or file of a detector, a `Detector`, or a model of another library."""


def load_detector(model: DetectorLike, **options: Any) -> Detector:
    """Load a detector by its name or its file, or make one of a model in memory.

    - `"yolov3-tiny"`, `"yolov3"`, `"yolov3-spp"`: published Darknet networks; options of `load_yolo`.
    - A path that ends in `.cfg`, with `weights=`: any Darknet network with YOLOv3 heads; options of `load_yolo`.
    - A path that ends in `.onnx`: your own ONNX model; options of `semfov.detection.onnx.load_onnx`.
    - `"yolox-nano"`, `"yolox-tiny"`, `"yolox-s"`, `"nanodet-plus-m-1.5x"`: published ONNX models; options of
      `semfov.detection.onnx.load_onnx`. The last one needs `weights=`, a file that you have.
    - `"torchvision:<model>"`: torchvision's models; options of `semfov.detection.torchvision.TorchvisionDetector.load`.
    - `"hf:<owner>/<name>"`: models of Hugging Face's hub; options of `TransformersDetector.load` in
      `semfov.detection.transformers`.
    - A model of torchvision, transformers or Ultralytics: options of `TorchvisionDetector`, `TransformersDetector`
      and `UltralyticsDetector` in the modules of these names in `semfov.detection`.
    - A `Detector`: returned as it is.

    `yolox-nano`, the default detector, is in the package. The weights of others are downloaded once
    (`semfov.detection.weights`); `weights=` reads a file instead.
    Names are the same in upper and lower case.

    Args:
        model: name of the detector, path of its `.cfg` or `.onnx` file, or a model.
        **options: options of the loader of this kind of detector.

    Returns:
        The detector.

    Raises:
        InputError: the name, the model or an option is unknown.
        DataError: the weights are damaged, or cannot be downloaded.

    Example::

        detector = load_detector("yolox-nano", threshold=0.05)
        detections = detector(images)  # (B, 3, H, W), RGB in [0, 1]
    """
    if isinstance(model, Detector):
        check(not options, "options", "none for a detector that is made already", ", ".join(options))
        return model
    if isinstance(model, str | PathLike):
        name = _detector_name(model)
        load: Callable[..., Detector] = load_yolo
        if name.endswith(".onnx") or (name in WEIGHTS and WEIGHTS[name].file.endswith(".onnx")):
            load = load_onnx
        elif name.startswith("torchvision:"):
            load = TorchvisionDetector.load
        elif name.startswith("hf:"):
            load = TransformersDetector.load
        return _load(load, name, name, options)
    for package, wrapper in _WRAPPERS.items():
        if any(f"{kind.__module__}.".startswith(package) for kind in type(model).__mro__):
            return _load(wrapper, model, f"a {type(model).__name__}", options)
    inner = next((name for name in _INNER if isinstance(getattr(model, name, None), nn.Module)), None)
    way = "write a class with the method propose (semfov.Detector), or export it to ONNX"
    if inner is not None:
        way = f"give the {type(getattr(model, inner)).__name__} in it, which is its .{inner}; or {way}"
    kind = f"{type(model).__module__}.{type(model).__qualname__}"
    expected = "a model of torchvision, transformers or Ultralytics"
    raise InputError(f"detector: expected {expected}, got {kind}; {way}")


def _load(load: Callable[..., Detector], model: str | nn.Module, what: str, options: dict[str, Any]) -> Detector:
    """Call a loader with options that it has, and set those of all detectors."""
    own = _options_of(load)
    check_options(options, [*own, *_COMMON], f"semfov.load_detector for {what}")
    if options.get("classes") is not None:
        options = {**options, "classes": given_names(options["classes"])}
    if "device" in options:
        try:
            torch.device(options["device"])
        except (RuntimeError, TypeError):
            got = repr(options["device"])
            raise InputError(f"device: expected a device of PyTorch, such as cpu or cuda, got {got}") from None
    selecting = {name: value for name, value in options.items() if name in _SELECTING}
    Selection(**selecting)  # what is wrong is told before a network is loaded
    detector = load(model, **{name: value for name, value in options.items() if name in own})
    detector.selection = replace(detector.selection, **selecting)
    if options.get("background") is not None:
        detector.background = options["background"]
    if "device" in own or options.get("device") is None:
        return detector
    if torch.device(options["device"]).type != "meta":
        check_device(options["device"])
    return detector.to(options["device"])


def _options_of(load: Callable[..., Detector]) -> list[str]:
    """Names of the options that a loader has of its own."""
    return [each.name for each in signature(load).parameters.values() if each.kind is Parameter.KEYWORD_ONLY]


def loader_options() -> list[str]:
    """Names of the options of `load_detector` for any detector."""
    loaders: list[Callable[..., Detector]] = [load_yolo, load_onnx, TorchvisionDetector.load, TransformersDetector.load]
    return [*_COMMON, *(name for load in (*loaders, *_WRAPPERS.values()) for name in _options_of(load))]


def check_detector(name_or_path: str | PathLike[str]) -> tuple[str, ...] | None:
    """Check without loading it that a detector exists."""
    name = _detector_name(name_or_path)
    if name.endswith((".onnx", ".cfg")):
        if not Path(name).exists():
            raise DataError(f"detector: no such file: {name}; check the path")
        check_regular(name)
    return COCO_CLASSES if name in WEIGHTS else None


def _detector_name(name_or_path: str | PathLike[str]) -> str:
    """Return a name as it is written in tables, and the path of a file as it is."""
    name = fspath(name_or_path)
    check("://" not in name, "detector", "a file on this machine, or a name", f"{name}; download it")
    if name.endswith((".onnx", ".cfg")):
        return name
    alone = f"weights only; give 'x.cfg' with weights='{name}'"
    check(not name.endswith(".weights"), "detector", "a cfg and its weights", alone)
    pickled = (
        f"{name}; export the model to ONNX, for Ultralytics with: yolo export model={name} format=onnx; for other "
        f"modules with: torch.onnx.export(model, image, '{Path(name).stem}.onnx'). A state dict of a torchvision model "
        f"is read as 'torchvision:MODEL' with weights='{name}' and classes="
    )
    safe = "a file that can be read without running code from it"
    check(not name.endswith((".pt", ".pth")), "detector", safe, pickled)
    lower = name.lower()
    way = f"its name; export it with: yolo export model={name}.pt format=onnx"
    check(_EXPORTED.fullmatch(lower) is None, "detector", f"an ONNX file of {name}", way)
    read = Path(lower).suffix not in _OTHER_FORMATS
    check(read, "detector", "an ONNX file, a Darknet cfg or a name", f"{name}; export the model to ONNX")
    if lower.startswith(("torchvision:", "hf:")):
        return lower if lower[0] == "t" else f"hf:{name[3:]}"
    return lower if lower in WEIGHTS else lookup(name, WEIGHTS, "detector")


def load_yolo(
    name_or_cfg: str,
    *,
    weights: str | PathLike[str] | None = None,
    classes: Sequence[str] | None = None,
    input_size: int | tuple[int, int] | None = None,
    stride: int | None = 32,
    runtime: Runtime = "auto",
    dtype: torch.dtype = torch.float32,
) -> YoloV3:
    """Load YOLOv3, YOLOv3-tiny, YOLOv3-spp or a network from your own cfg, with trained weights."""
    if name_or_cfg.endswith(".cfg"):
        if weights is None:
            raise InputError(f"weights: expected the path of the weights of {name_or_cfg!r}, got None")
        name, sections = Path(name_or_cfg).stem, read_cfg(name_or_cfg)
    else:
        name = lookup(name_or_cfg, ARCHITECTURES, "detector")
        sections = ARCHITECTURES[name]()
    network = Darknet(sections).to(dtype).requires_grad_(False)
    digest = network.read_weights(fetch(name) if weights is None else weights)
    network.to(memory_format=torch.channels_last)
    detector = YoloV3(
        network,
        COCO_CLASSES if classes is None else tuple(classes),
        name=name,
        input_size=(input_size, input_size) if isinstance(input_size, int) else input_size,
        stride=stride,
        digest=digest,
        runtime=runtime,
    )
    return detector.eval()


def given_names(classes: Any) -> tuple[str, ...]:
    """Class names in the order of the scores: of a list, a text with commas, the lines of a file, or by numbers."""
    expected = "names in the order of the scores, in a list"
    if isinstance(classes, str | PathLike):
        text = fspath(classes)
        if isinstance(classes, PathLike) or Path(text).suffix in (".txt", ".names") or Path(text).is_file():
            return tuple(line.strip() for line in read_text(text).splitlines() if line.strip())
        return tuple(name.strip() for name in text.split(","))
    if isinstance(classes, Mapping):
        known = {str(number): name for number, name in classes.items()}
        numbers = [str(number) for number in range(len(known))]
        check({*numbers} == {*known}, "classes", f"{expected}, or by numbers from 0", f"numbers {[*known][:5]}")
        return tuple(known[number] for number in numbers)
    check(not isinstance(classes, Set), "classes", expected, f"a {type(classes).__name__}, which has no order")
    return tuple(classes)
