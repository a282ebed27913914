"""The common frame of fits on looks from every cell: their settings, the held-out photographs and their outputs."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

from torch import Tensor

from semfov.errors import DataError
from semfov.fit.outputs import model_path, write_outputs
from semfov.io.pretrained import Pretrained
from semfov.runs.config import DataConfig, DetectorConfig, SensorConfig
from semfov.runs.looking import Looking, looking_of
from semfov.runs.scene_run import finish
from semfov.runs.settings import Count, Name, Positive, Range, Seed, Settings, Share, Side, Workers
from semfov.runs.workers import rank

Model = TypeVar("Model", bound=Pretrained)


@dataclass(frozen=True)
class FitOnLooksConfig(Settings):
    """Base of the settings of fits on looks from every cell of photographs.

    Args:
        data: photographs to learn from.
        detector: the detector that processes the foveated views.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's name).
        columns: columns of the grid.
        rows: rows of the grid.
        holdout: one in every n photographs is held out for the evaluation.
        looks: number of looks in a training episode.
        astray: share of the fixations in training that are drawn at random, so that the model learns from all cells.
        steps: number of training steps.
        batch: number of examples in a step.
        rate: highest learning rate.
        seed: seed of the choice of classes, the initial parameters and the training.
        out: folder for the model and the report.
        cache: folder for the detections from every cell, shared with the evaluations (None: the user's cache).
        workers: number of processes that look (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=2, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    name: Name | None = None
    columns: Side = 10
    rows: Side = 10
    holdout: Annotated[int, Range(2, 10**9)] = 5
    looks: Annotated[int, Range(2, 10_000)] = 16
    astray: Share = 0.3
    steps: Count = 500
    batch: Count = 48
    rate: Positive = 5e-3
    seed: Seed = 0
    out: Path = Path("runs/fit")
    cache: Path | None = None
    workers: Workers | None = None


@dataclass(frozen=True)
class Fit(Generic[Model]):
    """The result of a fit.

    Attributes:
        model: the model, fitted to the photographs that are not held out.
        judged: measures on the held-out photographs after some looks.
        trained: number of training examples.
        held_out: number of held-out examples.
        report: the measures as Markdown.
    """

    model: Model
    judged: list[dict[str, float]]
    trained: int
    held_out: int
    report: str


def split(scene: Tensor, holdout: int) -> Tensor:
    """Select the examples to hold out.

    Args:
        scene: `(E,)`, index of the photograph of each example.
        holdout: one in every n photographs is held out, beginning with the first.

    Returns:
        Whether each example is held out, `(E,)` boolean.

    Raises:
        DataError: all examples are held out, or none is.
    """
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(
            "data: expected examples both to train on and to hold out, got all of one kind "
            f"({len(scene)} examples); give more photographs"
        )
    return held_out


def fit_and_write(config: FitOnLooksConfig, fit: Callable[[Any, Looking], Fit[Any]]) -> None:
    """Look from every cell, fit, and write the model, the report, the settings and the measures.

    Args:
        config: settings of the fit.
        fit: makes the model from the settings and the finished looks.
    """
    run = looking_of(config)
    finish(run, "looking")
    if rank() > 0:
        return
    fitted = fit(config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, ("judged.json", json.dumps(fitted.judged, indent=2) + "\n"), path)
