"""The agent and the classes that the options name, with what can be checked before anything is loaded."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from semfov.agent import ActivePerception
from semfov.cli.options import AgentOptions, DetectorOptions
from semfov.data.classes import class_index
from semfov.detection.load import check_detector, given_names
from semfov.detection.onnx_file import write_settings
from semfov.detection.weights import WEIGHTS
from semfov.errors import check, check_device
from semfov.io.manifest import Manifest
from semfov.sensor import SENSORS, Foveation


def detector_classes(options: AgentOptions) -> tuple[str, ...] | None:
    """Names of the detector's classes, or None where they are known only after it is loaded."""
    given = detector_options(options).get("classes")
    if options.models is not None:
        return Manifest.read(options.models).classes
    classes, weights = check_detector(options.detector), options.weights
    named = f"none for {options.detector}, which has its own; `semfov find --target CLASS` looks for one of them"
    check(given is None or classes is None, "classes", named, given and ", ".join(given))
    classes = classes or given
    own = WEIGHTS.get(options.detector.lower())
    mixed = weights is not None and weights.suffix == ".onnx" and own is not None and not own.file.endswith(".onnx")
    expected = f"Darknet weights for {options.detector}; an ONNX file is a detector of its own, --detector FILE"
    check(not mixed, "weights", expected, weights)
    return classes


def detector_options(options: DetectorOptions) -> dict[str, Any]:
    """What the options give to `load_detector`: among them a device that PyTorch has, and names or a file of them."""
    check_device(options.device)
    names = options.classes
    if names is not None and len(names) == 1 and Path(names[0]).is_file():
        names = given_names(names[0])
    given = {
        "weights": options.weights,
        "device": options.device,
        "classes": names,
        "per_class": options.per_class or None,
        "head": options.head,
        "input_size": options.input_size,
        "logits": options.logits or None,
        "preprocessing": options.colour and {"channels": options.colour},
    }
    return {name: value for name, value in given.items() if value is not None}


_OF_ONNX = "head", "colour", "input_size", "logits", "remember"
"""Options of ONNX files alone."""


def check_onnx_options(options: DetectorOptions, detector: str) -> None:
    """Raise `InputError` where an option of ONNX files is given for a detector that is none."""
    known = WEIGHTS.get(detector.lower())
    is_file = detector.endswith(".onnx")
    onnx = is_file or (known is not None and known.file.endswith(".onnx"))
    for name in _OF_ONNX:
        fits = is_file if name == "remember" else onnx
        check(fits or not getattr(options, name), name, "none for a detector that is no ONNX file", detector)


def remember(options: DetectorOptions, detector: str) -> Path | None:
    """Write the settings that the options give beside the detector's file, if they ask for it; returns the file."""
    if not options.remember:
        return None
    return write_settings(Path(detector), detector_options(options))


def make_agent(options: AgentOptions) -> ActivePerception:
    """The agent that the options name, on the device that they name."""
    device = options.device
    if options.models is None:
        check_onnx_options(options, options.detector)
    agent = _load_agent(options, detector_options(options))
    remember(options, options.detector)
    if options.half:
        agent = agent.half()
        if torch.device(device or "cpu").type == "cpu":
            warnings.warn(
                "half: numbers of 16 bits make a processor several times slower; leave it out, or give device='cuda'",
                stacklevel=2,
            )
    return agent if device is None else agent.to(device)


def _load_agent(options: AgentOptions, loaded: dict[str, Any]) -> ActivePerception:
    """The agent that the options name, with options of `load_detector`."""
    if options.models is not None:
        check(options.agent != "raw", "agent", "recommended or published with --models", options.agent)
        moved = loaded if options.detector == AgentOptions.detector else {"detector": options.detector, **loaded}
        own = ActivePerception.published if options.agent == "published" else ActivePerception.from_pretrained
        return own(options.models, **moved)
    if options.agent == "recommended":
        sensor = SENSORS[options.sensor or "gradual"]
        kind = sensor.make.__name__
        check(sensor.make is Foveation, "sensor", "a Foveation, since models are shipped for no other sensor", kind)
        shape: dict[str, Any] = {name: sensor.settings[name] for name in ("sigma", "growth")}
        return ActivePerception.recommended(options.detector, **shape, **loaded)
    make = ActivePerception.published if options.agent == "published" else ActivePerception.raw
    return make(options.detector, sensor=options.sensor or "published", **loaded)


def several_classes(text: str | None, classes: Sequence[str] | None) -> list[str] | None:
    """The classes that a text names, with commas between them; None for all."""
    if text is None or text == "all":
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    check(bool(names), "target", "a class, or several with commas", repr(text))
    return names if classes is None else [classes[class_index(name, classes, "target") - 1] for name in names]
