"""Settings of the evaluation of calibration."""

from dataclasses import dataclass, field
from pathlib import Path

from semfov.runs.config import DataConfig, SensorConfig, WorkConfig
from semfov.runs.settings import Count, Seed, Share, Side


@dataclass(frozen=True)
class CalibrationConfig(WorkConfig):
    """Evaluate how well scores, and beliefs about a target, agree with the annotated objects.

    Args:
        data: photographs to evaluate on, by default all of them.
        detector: the detector, which is applied to each foveated view.
        sensor: the foveal sensor.
        model: fitted observation model, by name or file (None: the one shipped for the detector and sensor).
        fixations: number of random fixations in each photograph.
        iou: smallest intersection over union at which a detection matches an object.
        seed: random seed of the fixations and of the searches.
        beliefs: evaluate beliefs, too, for which every cell of every photograph is fixated once.
        grid: `[columns, rows]` of the grid of the beliefs.
        target_model: learned target evidence, by name or file (None: the one shipped for the detector and sensor).
        map_model: learned map, by name or file (None: the one shipped for the detector and sensor).
        target_area: a class is searched for only if its boxes cover at most this share of the image.
        out: folder for the tables and the figures.
        cache: folder for the labelled detections and for the stored detections from every cell (None: `out` for the
            former, the user's cache for the latter).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    sensor: SensorConfig = field(default_factory=SensorConfig)
    model: str | None = None
    fixations: Count = 6
    iou: Share = 0.5
    seed: Seed = 0
    beliefs: bool = True
    grid: tuple[Side, Side] = (10, 10)
    target_model: str | None = None
    map_model: str | None = None
    target_area: Share = 0.2
    out: Path = Path("runs/calibration")
