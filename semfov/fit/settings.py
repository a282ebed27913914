"""The settings that fits have in common."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.runs.config import DataConfig, SensorConfig, WorkConfig
from semfov.runs.settings import Count, Positive, Range, Seed, Share, Side, SingleName


@dataclass(frozen=True)
class FitConfig(WorkConfig):
    """Base of the settings of fits to a detector's looks at annotated photographs.

    Args:
        data: photographs to learn from (by default all of them, however many objects they have).
        detector: the detector that processes the foveated views.
        sensor: the foveal sensor.
        seed: seed of all random choices.
        name: name of the model (None: the detector's name).
        out: folder for the model and the report.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    sensor: SensorConfig = field(default_factory=SensorConfig)
    seed: Seed = 0
    name: SingleName | None = None


@dataclass(frozen=True)
class FitOnLooksConfig(FitConfig):
    """Base of the settings of fits on looks from every cell of photographs.

    Args:
        data: photographs to learn from.
        columns: columns of the grid.
        rows: rows of the grid.
        holdout: one in every n photographs is held out for the evaluation.
        looks: number of looks in a training episode.
        astray: share of the fixations in training that are drawn at random, so that the model learns from all cells.
        steps: number of training steps.
        batch: number of examples in a step.
        rate: highest learning rate.
        seed: seed of the choice of classes, the initial parameters and the training.
        cache: folder for the detections from every cell, shared with the evaluations (None: the user's cache).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=2, max_target_area=None))
    columns: Side = 10
    rows: Side = 10
    holdout: Annotated[int, Range(2, 10**9)] = 5
    looks: Annotated[int, Range(2, 10_000)] = 16
    astray: Share = 0.3
    steps: Count = 500
    batch: Count = 48
    rate: Positive = 5e-3
    out: Path = Path("runs/fit")
