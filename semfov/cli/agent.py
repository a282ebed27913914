"""The agent and the classes in the options of a command, checked as far as possible before loading."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from semfov.agent import ActivePerception
from semfov.cli.options import DEFAULT_DETECTOR, AgentKind, AgentOptions, DetectorOptions
from semfov.data.classes import known_class
from semfov.detection.load import check_detector, given_names
from semfov.detection.onnx_file import write_settings
from semfov.detection.weights import WEIGHTS
from semfov.errors import InputError, check, check_device
from semfov.io.manifest import Manifest
from semfov.model_folder import open_model


def detector_classes(options: AgentOptions) -> tuple[str, ...] | None:
    """Find the names of the detector's classes before it is loaded.

    Args:
        options: the options of a command.

    Returns:
        The names, or None where they are known only after it is loaded.

    Raises:
        InputError: there is no such detector, it has classes of its own, or the weights are of another kind.
    """
    names = detector_options(options).get("classes")
    if options.models_folder is not None:
        return Manifest.read(options.models_folder).classes
    detector = detector_of(options)
    classes = check_detector(detector)
    if classes is not None and names is not None:
        expected = f"none for {detector}, which has its own; `semfov find --target CLASS` looks for one of them"
        raise InputError(f"classes: expected {expected}, got {', '.join(names)}")
    _check_kind_of_weights(options.weights, detector)
    return names if classes is None else classes


def _check_kind_of_weights(weights: Path | None, detector: str) -> None:
    """Raise `InputError` for a file of ONNX as the weights of a registered detector that takes those of Darknet."""
    registered = WEIGHTS.get(detector.lower())
    if registered is None or weights is None or weights.suffix != ".onnx":
        return
    expected = f"Darknet weights for {detector}; an ONNX file is a detector of its own, --detector FILE"
    check(registered.file.endswith(".onnx"), "weights", expected, weights)


def detector_of(options: AgentOptions) -> str:
    """Return the detector's name: from the options, from the file of a fitted model, or the default.

    Args:
        options: the options of a command.

    Returns:
        Its name or file.
    """
    if options.detector is not None:
        return options.detector
    if options.model_file is None:
        return DEFAULT_DETECTOR
    fitted_to = open_model(options.model_file).metadata.get("detector", {})
    return str(fitted_to.get("name", DEFAULT_DETECTOR))


def note_of_detector(options: AgentOptions) -> str:
    """Say which detector the file of a model names in place of the default; empty where it is given, or is that one.

    Args:
        options: the options of a command.
    """
    detector = detector_of(options)
    is_said = detector in (options.detector, DEFAULT_DETECTOR)
    return "" if is_said else f"the detector is {detector}, to which {options.models} was fitted\n"


def detector_options(options: DetectorOptions) -> dict[str, Any]:
    """Take the options of `load_detector`.

    Args:
        options: the options of a command.

    Returns:
        Those that are given, by the names that they have in Python.

    Raises:
        InputError: PyTorch has no such device, or the file of names cannot be read.
    """
    check_device(options.device)
    # A flag that is not given leaves the choice to the detector's own settings.
    values = {
        "weights": options.weights,
        "device": options.device,
        "classes": _names_of_classes(options),
        "per_class": options.per_class or None,
        "head": options.head,
        "input_size": options.input_size,
        "logits": options.logits or None,
        "preprocessing": options.colour and {"channels": options.colour},
    }
    return {name: value for name, value in values.items() if value is not None}


def _names_of_classes(options: DetectorOptions) -> tuple[str, ...] | None:
    """Take the names of the classes from the options, or from the text file that they name; None for none."""
    names = options.classes
    if names is None or len(names) != 1 or not Path(names[0]).is_file():
        return names
    return given_names(names[0])


_OF_ONNX = "head", "colour", "input_size", "logits", "remember"
"""Options of ONNX files alone."""


def check_onnx_options(options: DetectorOptions, detector: str) -> None:
    """Raise `InputError` if an option of ONNX files is given for a detector that is no ONNX file.

    Args:
        options: the options of a command.
        detector: name or file of the detector.
    """
    registered = WEIGHTS.get(detector.lower())
    file = detector if registered is None else registered.file
    expected = "none for a detector that is no ONNX file"
    for name in _OF_ONNX:
        # Settings are remembered beside a file of one's own.
        file_of_option = detector if name == "remember" else file
        if getattr(options, name):
            check(file_of_option.endswith(".onnx"), name, expected, detector)


def remember(options: DetectorOptions, detector: str) -> Path | None:
    """Write the settings that the options give beside the detector's file, if they ask for it.

    Args:
        options: the options of a command.
        detector: the detector's file.

    Returns:
        The file that was written; None for none.
    """
    if not options.remember:
        return None
    return write_settings(Path(detector), detector_options(options))


def make_agent(options: AgentOptions) -> ActivePerception:
    """Make the agent that the options name, on the device that they name.

    Args:
        options: the options of a command.

    Returns:
        The agent, ready for use.
    """
    device = options.device or "cpu"
    detector = detector_of(options)
    if options.models_folder is None:
        check_onnx_options(options, detector)
    agent = _load_agent(options, detector_options(options))
    remember(options, detector)
    if options.half:
        agent = agent.half()
        if torch.device(device).type == "cpu":
            warnings.warn(
                "half: numbers of 16 bits make a processor several times slower; leave it out, or give device='cuda'",
                stacklevel=2,
            )
    return agent if options.device is None else agent.to(device)


def _load_agent(options: AgentOptions, loading: dict[str, Any]) -> ActivePerception:
    """Load the agent that the options name.

    Args:
        options: the options of a command.
        loading: options of `load_detector`.

    Returns:
        The agent.
    """
    if options.models is not None:
        return _load_models(options, options.models, loading)
    detector = detector_of(options)
    if options.agent == "recommended":
        expected = "gradual with --agent recommended, whose models are fitted for it"
        check(options.sensor in (None, "gradual"), "sensor", expected, options.sensor)
        return ActivePerception.recommended(detector, **loading)
    make = ActivePerception.published if options.agent == "published" else ActivePerception.raw
    return make(detector, sensor=options.sensor or "published", **loading)


def _load_models(options: AgentOptions, models: Path, loading: dict[str, Any]) -> ActivePerception:
    """Load an agent from a folder of models, or the file of one, which say what their detector is."""
    kinds: tuple[AgentKind, ...] = ("recommended", "published")
    expected = "recommended or published with --models FOLDER"
    if options.model_file is not None:
        kinds = ("recommended",)
        expected = "recommended with --models FILE, which takes the place of a shipped model"
    check(options.agent in kinds, "agent", expected, options.agent)
    if options.detector is not None:
        # The file of the detector is elsewhere now.
        loading = {"detector": options.detector, **loading}
    load = ActivePerception.published if options.agent == "published" else ActivePerception.from_pretrained
    return load(models, **loading)


def several_classes(text: str | None, classes: Sequence[str] | None) -> list[str] | None:
    """Read the classes that a text names, with commas between them.

    Args:
        text: the text; None or `all` for all classes.
        classes: the detector's classes, by which names are checked; None where they are not known yet.

    Returns:
        The names; None for all classes.

    Raises:
        InputError: a class is unknown, or none is named.
    """
    if text is None or text == "all":
        return None
    names = [name.strip() for name in text.split(",") if name.strip()]
    check(bool(names), "target", "a class, or several with commas", repr(text))
    return names if classes is None else [known_class(name, classes, "target") for name in names]
