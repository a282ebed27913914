"""Settings of an experiment from a folder of fitted models."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import TypeVar

from eval.comparison.settings import ComparedConfig, sensor_settings
from semfov.errors import InputError, check
from semfov.eye import Eye
from semfov.gaze.acquisition.base import FUNCTIONS
from semfov.model_folder import ModelFolder
from semfov.runs.config import DetectorConfig, PolicyConfig
from semfov.runs.presets import AGENT, resolve

_Config = TypeVar("_Config", bound=ComparedConfig)


def with_models(config: _Config) -> _Config:
    """Complete settings with the detector, sensor, grid and models of the folder that `models` names.

    If the settings also give a detector or weights, these are the new locations of the folder's files. The preset
    `recommended` stands for the policy of the folder's agent. Default policies that need a model that the folder lacks
    are left out.
    """
    if config.models is None:
        return config
    folder = ModelFolder(config.models)
    for name in ("model", "search_model", "map_model"):
        value = getattr(config.belief, name)
        check(value is None, f"belief.{name}", "null, since models defines it", value)
    observation = folder.file("observation")
    columns, rows = folder.manifest.grid
    belief = replace(
        config.belief,
        columns=columns,
        rows=rows,
        model=_text(observation),
        search_model=_text(folder.file("search")),
        map_model=None if observation is None else str(config.models),
    )
    config = replace(
        config,
        detector=_detector_of(folder, config.detector),
        sensor=sensor_settings(folder.manifest.sensor),
        belief=belief,
        policies=_policies_of(folder, config),
    )
    return config.complete(folder)


def _policies_of(folder: ModelFolder, config: ComparedConfig) -> tuple[str | PolicyConfig, ...]:
    """Choose the policies that a folder has the models for.

    Raises:
        InputError: a policy that the settings name needs a model that the folder lacks.
    """
    are_default = config.policies == type(config)().policies
    chosen = []
    for name in config.policies:
        policy = _recommended_policy(folder, config) if name == "recommended" else name
        missing = next((part for part in _needs(policy, config) if folder.file(part) is None), None)
        if missing is None:
            chosen.append(policy)
        elif not are_default:
            parts = folder.manifest.parts
            why = parts[missing].why if missing in parts else "not fitted"
            raise InputError(
                f"policies: {policy!r} needs the model {missing!r}, which the folder {config.models} lacks: {why}"
            )
    return tuple(chosen)


def _detector_of(folder: ModelFolder, settings: DetectorConfig) -> DetectorConfig:
    """Return the settings of a folder's detector; name and weights in `settings` are the new locations of its files."""
    moved = None if settings.name == DetectorConfig().name else settings.name
    source, options = folder.detector_source(moved, settings.weights)
    names = {field.name for field in fields(DetectorConfig)}
    options = {name: value for name, value in options.items() if name in names}
    if options.get("classes") is not None:
        options["classes"] = tuple(options["classes"])
    if "weights" in options:
        options["weights"] = Path(options["weights"])
    return DetectorConfig(name=source, **{"background": None, **options})


def _recommended_policy(folder: ModelFolder, config: ComparedConfig) -> str | PolicyConfig:
    """Return the policy that the agent of a folder uses."""
    if config.task == "exploration":
        return PolicyConfig("closer-look", "learned") if folder.file("observation") else "random-raw"
    return AGENT if folder.used("search") else "non-predictive-raw"


def _needs(choice: str | PolicyConfig, config: ComparedConfig) -> list[str]:
    """Parts of the folder that a policy needs."""
    policy = resolve(choice, config.task)
    if policy.scores == "learned":
        return ["search"] if config.task == "search" else ["observation"]
    model = policy.policy in FUNCTIONS and FUNCTIONS[policy.policy].needs_model
    return ["observation"] if model or policy.scores == "calibrated" else []


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


_Made = TypeVar("_Made")


def if_shipped(
    make: Callable[[str | None, Eye], _Made],
    name: str | None,
    eye: Eye,
    missing: Callable[[str], object] = lambda reason: None,
) -> _Made | None:
    """Load the model that the settings name, or else the one shipped for the eye; None where none is shipped."""
    try:
        return make(name, eye)
    except InputError as error:
        if name is not None:
            raise
        missing(str(error))
        return None
