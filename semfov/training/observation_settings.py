"""Settings of the fit of a foveal observation model."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Weight, Whole, Workers


@dataclass(frozen=True)
class FitConfig(Settings):
    """Fit p(scores | class, distance to the fovea) on photographs with boxes.

    Args:
        data: photographs to fit on (all of them: no selection by number of objects).
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's).
        method: `newton`, `fixed_point` (both Minka's; the paper does not say which) and `gradient` maximise the
            likelihood, where `enough` lets them;
            `discriminative` trains the posterior of the class itself, which is what calibration needs.
        mosaics: mosaics of 8 × 6 photographs to look at in windows, for pictures larger than the detector's input
            (0: photographs, through the fovea). Levels are then octaves that the picture is reduced by, and `width` and
            `sensor` are of no account.
        fixations: random fixations in each photograph; of a mosaic, windows at each magnification.
        levels: levels of distance, each `width` wide and the last one open.
        width: width of a level for a fovea of 100 pixels, in pixels of an image whose longer side is 640; it grows
            with the fovea.
        minimum: objects that a level needs, or it takes the parameters of its inner neighbour (0: none does).
        shrinkage: detections of a class's other levels that a level is given, so that few do not decide.
        enough: detections of a class at a level from which that cell is not shrunk, but fitted by maximum likelihood
            alone, as published (None: all are shrunk).
        holdout: every n-th photograph is kept out of the fit and used to judge it.
        iou: overlap from which a detection shows an object.
        seed: of the fixations.
        shard: photographs in a unit of work; a run that is stopped loses no more than one for each worker.
        out: folder for the model, the report and the figures.
        cache: folder for the labelled detections (None: `out`).
        workers: processes (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    name: Name | None = None
    method: Literal["newton", "fixed_point", "gradient", "discriminative"] = "discriminative"
    mosaics: Whole = 0
    fixations: Count = 8
    levels: Annotated[int, Range(1, 1000)] = 8
    width: Positive = 50.0
    minimum: Whole = 100
    shrinkage: Weight = 10.0
    enough: Whole | None = None
    holdout: Annotated[int, Range(2, 10**9)] = 10
    iou: Share = 0.5
    seed: Seed = 0
    shard: Count = 32
    out: Path = Path("runs/fit_fom")
    cache: Path | None = None
    workers: Workers | None = None

    @property
    def edges(self) -> list[float]:
        """Borders between the levels, in longer sides of the image; of mosaics, in octaves."""
        if self.mosaics:
            return [n - 0.5 for n in range(1, self.levels)]
        step = self.width / 100.0 * self.sensor.fovea
        return [step * n for n in range(1, self.levels)]
