"""Loading of detectors by name, file or model: `load_detector`."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import fields, replace
from inspect import Parameter, signature
from os import PathLike, fspath
from pathlib import Path
from typing import Any, cast

import torch
from torch import nn

from semfov.detection.class_names import COCO_CLASSES, names_in_order
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
from semfov.errors import DataError, InputError, check, check_device, check_is_device, check_options, lookup, type_of
from semfov.io.files import check_regular, read_text

_EXPORTED = re.compile(r"(yolo(v?([5-9]|1\d|26)|world|-nas|e-)[a-z0-9_-]*|rt-?detr[a-z0-9_-]*)")
"""Names of models of Ultralytics, of which there are files of Python's pickle."""

_OTHER_FORMATS = (".tflite", ".engine", ".trt", ".xml", ".bin", ".pb", ".h5", ".keras", ".mlmodel", ".safetensors")
"""Ends of the names of models in formats that are not read."""

_FILES = (".onnx", ".cfg")
"""Ends of the names of files that are read; other names are those of published detectors, or of a library."""

_Loader = Callable[..., Detector]
"""A function that makes a detector of a name or a model, with options of its own."""

_SELECTING = [field.name for field in fields(Selection)]
_COMMON = ["background", "device", *_SELECTING]  # options of all detectors

_WRAPPERS: dict[str, _Loader] = {
    "torchvision.models.detection.": TorchvisionDetector,
    "transformers.models.": TransformersDetector,
    "ultralytics.": UltralyticsDetector,
}
"""Classes of detectors that hold a module (in memory, not a copy), by the package of its class or of its bases."""

_LIBRARIES: dict[str, _Loader] = {"torchvision": TorchvisionDetector.load, "hf": TransformersDetector.load}
"""Loaders by what stands before the colon of a name."""

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
        return _load(_loader_of(name), name, name, options)
    return _load(_wrapper_of(model), model, type_of(model), options)


def _loader_of(name: str) -> _Loader:
    """Find the loader of a detector by its name or its file."""
    file = WEIGHTS[name].file if name in WEIGHTS else name
    if file.endswith(".onnx"):
        return load_onnx
    library, _, _ = name.partition(":")
    return _LIBRARIES.get(library, load_yolo)


def _wrapper_of(model: nn.Module) -> _Loader:
    """Find the class of detectors that hold a model of another library."""
    for package, wrapper in _WRAPPERS.items():
        if any(f"{kind.__module__}.".startswith(package) for kind in type(model).__mro__):
            return wrapper
    kind = f"{type(model).__module__}.{type(model).__qualname__}"
    remedy = f"{_hint_of_inner(model)}write a class with the method propose (semfov.Detector), or export it to ONNX"
    raise InputError(f"detector: expected a model of torchvision, transformers or Ultralytics, got {kind}; {remedy}")


def _hint_of_inner(model: nn.Module) -> str:
    """Write where in a model another one is that it wraps, `""` if there is none."""
    for name in _INNER:
        inner = getattr(model, name, None)
        if isinstance(inner, nn.Module):
            return f"give the {type(inner).__name__} in it, which is its .{name}; or "
    return ""


def _load(load: _Loader, model: str | nn.Module, description: str, options: dict[str, Any]) -> Detector:
    """Call a loader with options that it has, and set those of all detectors.

    Args:
        load: the loader.
        model: the name or the model that it takes.
        description: what messages call the model.
        options: options of the loader, and of all detectors.
    """
    names_of_loader = _options_of(load)
    check_options(options, [*names_of_loader, *_COMMON], f"semfov.load_detector for {description}")
    # What is wrong is reported before a network is loaded.
    if options.get("classes") is not None:
        options = {**options, "classes": given_names(options["classes"])}
    if "device" in options:
        check_is_device(options["device"])
    selection = _part(options, _SELECTING)
    Selection(**selection)
    detector = load(model, **_part(options, names_of_loader))
    # What is not given stays as the loader has set it, such as `per_class` in the settings of an ONNX file.
    detector.selection = replace(detector.selection, **selection)
    if options.get("background") is not None:
        detector.background = options["background"]
    device = options.get("device")
    if device is None or "device" in names_of_loader:
        return detector
    # Tensors on `meta` have no values, so a device cannot be tried out there.
    if torch.device(device).type != "meta":
        check_device(device)
    return detector.to(device)


def _part(options: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Take the options of some names."""
    return {name: value for name, value in options.items() if name in names}


def _options_of(load: _Loader) -> list[str]:
    """List the names of the options that a loader has of its own."""
    parameters = signature(load).parameters.values()
    return [parameter.name for parameter in parameters if parameter.kind is Parameter.KEYWORD_ONLY]


def loader_options() -> list[str]:
    """List the names of the options of `load_detector` for any detector.

    Returns:
        The names, some of them several times.
    """
    loaders: list[_Loader] = [load_yolo, load_onnx, *_LIBRARIES.values(), *_WRAPPERS.values()]
    names = list(_COMMON)
    for load in loaders:
        names += _options_of(load)
    return names


def check_detector(name_or_path: str | PathLike[str]) -> tuple[str, ...] | None:
    """Check without loading it that a detector exists.

    Args:
        name_or_path: its name, or the path of its `.onnx` or `.cfg` file.

    Returns:
        The names of its classes where they are known without loading it: those of published detectors.

    Raises:
        InputError: the name is unknown.
        DataError: there is no such file.
    """
    name = _detector_name(name_or_path)
    if name.endswith(_FILES):
        if not Path(name).exists():
            raise DataError(f"detector: no such file: {name}; check the path")
        check_regular(name)
    return COCO_CLASSES if name in WEIGHTS else None


def _detector_name(name_or_path: str | PathLike[str]) -> str:
    """Return a name as it is written in tables, and the path of a file as it is."""
    name = fspath(name_or_path)
    check(bool(Path(name).name), "detector", "a name or a file", repr(name))
    check("://" not in name, "detector", "a file on this machine, or a name", f"{name}; download it")
    if name.endswith(_FILES):
        return name
    _check_has_loader(name)
    lower = name.lower()
    if lower in WEIGHTS or lower.startswith("torchvision:"):
        return lower
    if lower.startswith("hf:"):
        return f"hf:{name[3:]}"  # names of the hub keep their case
    return lookup(name, WEIGHTS, "detector")


def _check_has_loader(name: str) -> None:
    """Raise `InputError` for files of other programs, with the call that makes one to load."""
    weights_alone = f"weights only; give 'x.cfg' with weights='{name}'"
    check(not name.endswith(".weights"), "detector", "a cfg and its weights", weights_alone)
    exported = Path(name).with_suffix(".onnx")
    found = f"give {str(exported)!r}, which lies beside it, or " if exported.is_file() else ""
    pickled = (
        f"{name}; {found}export the model to ONNX, for Ultralytics with: yolo export model={name} format=onnx (pip "
        f"install 'semfov[ultralytics]'); for other "
        f"modules with: torch.onnx.export(model, image, '{Path(name).stem}.onnx'). A state dict of a torchvision model "
        f"is read as 'torchvision:MODEL' with weights='{name}' and classes="
    )
    safe = "a file that can be read without running code from it"
    check(not name.endswith((".pt", ".pth")), "detector", safe, pickled)
    lower = name.lower()
    export = f"its name; export it with: yolo export model={name}.pt format=onnx"
    check(_EXPORTED.fullmatch(lower) is None, "detector", f"an ONNX file of {name}", export)
    other_format = Path(lower).suffix in _OTHER_FORMATS
    check(not other_format, "detector", "an ONNX file, a Darknet cfg or a name", f"{name}; export the model to ONNX")


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
    """Load YOLOv3, YOLOv3-tiny, YOLOv3-spp or a network from your own cfg, with trained weights.

    Args:
        name_or_cfg: its name, or the path of its cfg.
        weights: the file of its weights; None fetches those of a published network.
        classes: names of the classes in the order of the scores, without background; None for COCO's.
        input_size: side, or `(width, height)`, of the canvas in pixels; None for the one in the cfg.
        stride: pad the canvas only to a multiple of this number of pixels; None pads it to `input_size`.
        runtime: `torch`, `onnxruntime`, or `auto` for the faster one where both give the same.
        dtype: precision of the network.

    Returns:
        The detector.

    Raises:
        InputError: the name is unknown, or an option does not fit the network.
        DataError: the cfg or the weights are damaged, or cannot be downloaded.
    """
    if name_or_cfg.endswith(".cfg"):
        if weights is None:
            raise InputError(f"weights: expected the path of the weights of {name_or_cfg!r}, got None")
        name = Path(name_or_cfg).stem
        sections = read_cfg(name_or_cfg)
    else:
        name = lookup(name_or_cfg, ARCHITECTURES, "detector")
        sections = ARCHITECTURES[name]()
    network = Darknet(sections).to(dtype).requires_grad_(False)
    weights_file = fetch(name) if weights is None else weights
    digest = network.read_weights(weights_file)
    # Convolutions on a CPU are faster in this order of memory.
    network.to(memory_format=torch.channels_last)
    names = COCO_CLASSES if classes is None else tuple(classes)
    if isinstance(input_size, int):
        input_size = input_size, input_size
    detector = YoloV3(
        network,
        names,
        name=name,
        input_size=input_size,
        stride=stride,
        digest=digest,
        runtime=runtime,
    )
    return detector.eval()


def given_names(classes: object) -> tuple[str, ...]:
    """Read class names in one of the forms in which users give them.

    Args:
        classes: a list in the order of the scores, a text with commas, the path of a file with a name a line, or a
            mapping from numbers, as Ultralytics has it.

    Returns:
        The names in the order of the scores.

    Raises:
        InputError: their order is not known.
        DataError: there is no such file.
    """
    expected = "names in the order of the scores, in a list"
    if isinstance(classes, str | PathLike):
        return _names_in_text(classes)
    if isinstance(classes, Mapping):
        names: list[str] | None = names_in_order(classes)
        if names is None:
            numbers = [str(number) for number in classes]
            raise InputError(f"classes: expected {expected}, or by numbers from 0, got numbers {numbers[:5]}")
        return tuple(names)
    check(not isinstance(classes, Set), "classes", expected, f"{type_of(classes)}, which has no order")
    return tuple(cast(Iterable[str], classes))


def _names_in_text(text: str | PathLike[str]) -> tuple[str, ...]:
    """Read class names in a text with commas, or in a file with a name a line."""
    words = fspath(text)
    # A list that is missing is read all the same, as the error says more than a class of that name would.
    is_list = isinstance(text, PathLike) or Path(words).suffix in (".txt", ".names")
    if is_list or Path(words).is_file():
        lines = map(str.strip, read_text(words).splitlines())
        return tuple(filter(None, lines))
    return tuple(map(str.strip, words.split(",")))
