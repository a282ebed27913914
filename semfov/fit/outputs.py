"""The outputs of every fit: a model with metadata about the training, a report, the settings and measures as JSON."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from torch import Tensor

from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.fit.settings import FitOnLooksConfig
from semfov.io.files import inside, write_text
from semfov.io.pretrained import Pretrained
from semfov.runs.config import WHERE
from semfov.runs.looking import Looking
from semfov.runs.scene_run import finish

_Model = TypeVar("_Model", bound=Pretrained)


def training_of(config: Any, scenes: Scenes, *besides: str) -> dict[str, Any]:
    """Build the metadata of a model about its training: the photographs, and the settings that the model depends on.

    The settings of detector and sensor are left out, because `Eye.settings()` provides them. Paths are left out too.
    """
    left_out = {*WHERE, "data", "detector", "sensor", *besides}
    settings = {name: value for name, value in config.plain().items() if name not in left_out}
    return {"data": scenes.fingerprint, "training": settings}


def model_path(config: Any, detector: str) -> Path:
    """Return the file of a fitted model in `config.out`, named after the settings' `name` or else the detector."""
    return inside(config.out, f"{config.name or detector}.safetensors")


def write_outputs(config: Any, report: str, figures: tuple[str, str], model: Path | None = None) -> None:
    """Print the report, write it with the settings and the measures to `config.out`, and list the written files."""
    files = {"report.md": report, "config.yaml": config.yaml(), figures[0]: figures[1]}
    print(report)
    for name, text in files.items():
        write_text(inside(config.out, name), text)
    written = [*([] if model is None else [model]), *(config.out / name for name in files)]
    print("written:", *(f"  {path}" for path in written), sep="\n")


class Fit(NamedTuple, Generic[_Model]):
    """The result of a fit."""

    model: _Model
    judged: list[dict[str, float]]
    trained: int
    held_out: int
    report: str


def split(scene: Tensor, holdout: int) -> Tensor:
    """Select the examples to hold out; scene `(E,)` → `(E,)`."""
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(
            f"data: expected examples both to train on and to hold out, got {len(scene)}, all of one kind; give more "
            "photographs"
        )
    return held_out


def fit_and_write(config: FitOnLooksConfig, fit: Callable[[Any, Looking], Fit[Any]]) -> None:
    """Look from every cell, fit, and write the model, the report, the settings and the measures."""
    run = Looking(config)
    finish(run, "looking")
    fitted = fit(config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, ("judged.json", json.dumps(fitted.judged, indent=2) + "\n"), path)
