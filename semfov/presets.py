"""Preset agents: eye, observers and policies by the name of a detector or of a folder of models.

Each function returns the arguments of `semfov.ActivePerception`. The class methods `recommended`, `published`
and `raw` document the parameters.
"""

from collections.abc import Callable
from inspect import signature
from os import PathLike, fspath
from typing import Any

from semfov.belief.grid import check_cells
from semfov.belief.observers import Semantic, SemanticMap, SemanticSearch
from semfov.belief.verification import Verification
from semfov.detection.load import DetectorLike, load_detector, loader_options
from semfov.errors import InputError, check, lookup
from semfov.eye import Eye
from semfov.gaze.policies import Policy
from semfov.io.compatibility import searching_for, trained_for
from semfov.io.pretrained import shipped_model
from semfov.model_folder import open_folder, open_model
from semfov.observation.foveal import FovealObservationModel
from semfov.sensor.named import SENSORS, named_sensor
from semfov.zoom import GlimpseEvidence

PUBLISHED_SENSORS = tuple(name for name, named in SENSORS.items() if named.published)
"""Named sensors of the paper; observation models fitted by maximum likelihood are shipped for them."""


def option_names(make: Callable[..., dict[str, Any]]) -> list[str]:
    """List the options of a preset's constructor, which include the options of `load_detector`."""
    passed_on = [
        parameter.name
        for parameter in signature(make).parameters.values()
        if parameter.kind not in (parameter.POSITIONAL_ONLY, parameter.VAR_KEYWORD)
    ]
    # The constructors have a `name` of their own.
    return [*passed_on, *(name for name in loader_options() if name not in ("name", "options"))]


def recommended_arguments(name: DetectorLike, /, grid: tuple[int, int], **options: Any) -> dict[str, Any]:
    """Make the arguments of `ActivePerception.recommended`, the agent with learned observation models."""
    check_cells(grid)
    detector = load_detector(name, **options)
    eye = Eye(named_sensor("gradual"), detector)
    source = fspath(name) if isinstance(name, str | PathLike) else detector.name
    fitted = shipped_model(FovealObservationModel, searching_for(detector.name), detector.name, source)
    return {
        "eye": eye,
        "search": (SemanticSearch(FovealObservationModel.from_pretrained(fitted)), Policy("non-predictive")),
        "explore": (
            SemanticMap(FovealObservationModel.from_pretrained(trained_for(detector.name, growth=2))),
            Policy("closer-look", fovea=eye.sensor.width(eye.sensor.settings()) / eye.reference),
        ),
        "verification": Verification.if_shipped(detector.name),
        "windows": GlimpseEvidence.if_shipped(detector.name),
        "grid": grid,
    }


def model_file_arguments(
    path: str | PathLike[str],
    /,
    *,
    detector: DetectorLike | None = None,
    grid: tuple[int, int] = (10, 10),
    **options: Any,
) -> dict[str, Any]:
    """Make the arguments of the recommended agent, with the model in a file instead of a shipped one."""
    model = open_model(path)
    if detector is None:
        detector = model.metadata.get("detector", {}).get("name")
    if detector is None:
        expected = "the detector that the model was fitted to, which its file does not name"
        raise InputError(f"detector: expected {expected}, got None")
    arguments = recommended_arguments(detector, grid, **options)
    if isinstance(model, GlimpseEvidence):
        return {**arguments, "windows": model}
    if isinstance(model, Verification):
        observer, _ = arguments["search"]
        model.check_searching(observer.model)
        return {**arguments, "verification": model}
    if model.presence is None:  # it was not fitted to searches
        _, policy = arguments["explore"]
        return {**arguments, "explore": (SemanticMap(model), policy)}
    verification = arguments["verification"]
    if verification is not None:
        verification.check_searching(model)
    return {**arguments, "search": (SemanticSearch(model), Policy("non-predictive"))}


def published_model(detector: str, sensor: str, threshold: float) -> str:
    """Return the name of the shipped observation model for `ActivePerception.published`.

    Args:
        detector: name of the detector.
        sensor: name of the published sensor.
        threshold: score threshold of the detector, at which the wide fovea has models of its own.

    Returns:
        The name of the model.
    """
    name = f"{detector}-{sensor}"
    at_threshold = f"{name}-{threshold:g}"
    is_shipped = (FovealObservationModel.shipped / f"{at_threshold}.safetensors").is_file()
    return at_threshold if is_shipped else name


def published_arguments(
    name: str | PathLike[str], /, sensor: str | None, search: str, calibrated: bool, **options: Any
) -> dict[str, Any]:
    """Make the arguments of `ActivePerception.published`, from a detector's name or a folder of models."""
    lookup(search, ["predictive", "non-predictive"], "published search policy")
    folder = open_folder(name)
    if folder is not None:
        check(sensor is None, "sensor", "None with a folder of models, which has its own sensor", sensor)
        eye = folder.eye(**options)
        model = folder.observation()
        grid = folder.manifest.grid
    else:
        fovea = lookup(sensor or "published", PUBLISHED_SENSORS, "published sensor")
        grid = (10, 10)
        eye = Eye(named_sensor(fovea), load_detector(name, **options))
        fitted = published_model(eye.detector.name, fovea, eye.detector.selection.threshold)
        found = shipped_model(FovealObservationModel, fitted, eye.detector.name, fspath(name))
        model = FovealObservationModel.from_pretrained(found)
    observer = Semantic(len(eye.detector.classes) + 1, model if calibrated else None)
    policy = Policy("predictive", model) if search == "predictive" else Policy("non-predictive")
    return {"eye": eye, "search": (observer, policy), "explore": (observer, Policy("kl", model)), "grid": grid}


def raw_arguments(name: DetectorLike, /, sensor: str, **options: Any) -> dict[str, Any]:
    """Make the arguments of `ActivePerception.raw`: scores are likelihoods, and explorations are random."""
    eye = Eye(named_sensor(sensor), load_detector(name, **options))
    observer = Semantic(len(eye.detector.classes) + 1)
    search = (observer, Policy("non-predictive"))
    return {"eye": eye, "search": search, "explore": (observer, Policy("random")), "photographs": True}
