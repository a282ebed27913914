"""What fits on the looks of whole photographs have in common: settings, what is held out, and what is written."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

from torch import Tensor

from semfov.errors import DataError
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.parallel import rank
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Side, Workers
from semfov.io.pretrained import Pretrained
from semfov.training.evidence_examples import LookingRun, looking
from semfov.training.outputs import model_path, write_outputs

Model = TypeVar("Model", bound=Pretrained)


@dataclass(frozen=True)
class FitOnLooksConfig(Settings):
    """Base of the settings of fits on looks from every cell of photographs.

    Args:
        data: photographs to learn from.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's).
        columns: cells in a row.
        rows: cells in a column.
        holdout: every n-th photograph is kept out and used to judge.
        looks: of an episode.
        astray: share of the fixations that are drawn at random, so that all cells are learned from.
        steps: steps of training.
        batch: examples in a step.
        rate: highest learning rate.
        seed: of the choice of classes, first parameters and training.
        out: folder for the model and the report.
        cache: folder for what was seen from every cell, shared with the evaluations (None: the user's cache).
        workers: processes that look (None: one for each CPU core).
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
    """What a fit gives.

    Attributes:
        model: fitted to the photographs that were not held out.
        judged: figures on those that were, after some looks.
        trained: examples that it was trained on.
        held_out: examples that it was judged on.
        report: the figures as Markdown.
    """

    model: Model
    judged: list[dict[str, float]]
    trained: int
    held_out: int
    report: str


def split(scene: Tensor, holdout: int) -> Tensor:
    """Which examples are held out, `(E,)` boolean: those of every so many-th photograph.

    Args:
        scene: `(E,)`, index of the photograph of each example.
        holdout: every n-th photograph is held out, the first among them.

    Raises:
        DataError: all are held out, or none is.
    """
    held_out = scene % holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(f"data: too few photographs to train and to judge by ({len(scene)} examples); give more")
    return held_out


def fit_and_write(config: FitOnLooksConfig, fit: Callable[[Any, LookingRun], Fit[Any]]) -> None:
    """Look from every cell, fit, and write model, report, settings and figures.

    Args:
        config: settings of the fit.
        fit: makes the model from the settings and a run that has looked.
    """
    run = looking(config)
    if rank() > 0:
        return
    fitted = fit(config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, ("judged.json", json.dumps(fitted.judged, indent=2) + "\n"), path)
