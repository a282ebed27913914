"""Settings for fitting the verification of targets."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.runs.config import DataConfig, DetectorConfig, SensorConfig
from semfov.runs.settings import Count, Name, Positive, Range, Seed, Settings, Share, Side


@dataclass(frozen=True)
class FitVerificationConfig(Settings):
    """Fit the verification of targets.

    Args:
        data: photographs to learn from.
        detector: the detector that processes the foveated views and the closer looks.
        sensor: the foveal sensor.
        target_model: learned target evidence, by name or file (None: the one for the detector and the sensor).
        fitted: number of photographs that this evidence was fitted to (`--data.limit` of `train.fit_search` with
            `--data.min_instances 2`); those from which it learned are left out here (None: none is left out).
        name: name of the model (None: the detector's name).
        columns: columns of the grid.
        rows: rows of the grid.
        classes: maximum number of present classes to search for in each photograph.
        absent: maximum number of absent classes to search for (None: as many as present ones).
        max_target_area: classes that cover a larger share of the image are not searched for.
        looks: number of looks in a search.
        place: least probability of a cell that is worth a closer look.
        give_up: least probability of a cell that is worth a fixation.
        false_alarms: maximum share of absent targets that may be reported as found; it determines `confirm`.
        folds: number of parts of the photographs; each part is evaluated with a model that is fitted to the others.
        seed: seed of the choice of classes and of the first fixations.
        out: folder for the model and the report.
        cache: folder for the looks at the photographs, so that an interrupted fit continues (None: the user's cache).
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    target_model: str | None = None
    fitted: Count | None = None
    name: Name | None = None
    columns: Side = 10
    rows: Side = 10
    classes: Count = 2
    absent: Count | None = None
    max_target_area: Positive = 0.2
    looks: Annotated[int, Range(2, 10_000)] = 12
    place: Share = 0.2
    give_up: Share = 0.2
    false_alarms: Share = 0.01
    folds: Annotated[int, Range(2, 1000)] = 5
    seed: Seed = 0
    out: Path = Path("runs/fit_verification")
    cache: Path | None = None
