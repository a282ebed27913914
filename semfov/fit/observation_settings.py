"""Settings for fitting a foveal observation model."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from semfov.fit.settings import FovealFitConfig, NameConfig
from semfov.runs.config import WorkConfig
from semfov.runs.settings import Count, Positive, Range, Share, Weight, Whole


@dataclass(frozen=True)
class FitObservationConfig(FovealFitConfig, NameConfig, WorkConfig):
    """Fit p(scores | class, distance to the fovea) on photographs with boxes.

    Args:
        data: photographs to fit on (by default all of them, however many objects they have).
        method: how the model is fitted. `newton`, `fixed_point` (both by Minka; the paper does not say which it uses)
            and `gradient` maximise the likelihood of the scores, for classes and levels with `enough` detections.
            `discriminative` maximises the posterior probability of the true class instead, which is the quantity that
            calibration is about.
        mosaics: number of mosaics of 8 × 6 photographs to look at in windows, for pictures larger than the detector's
            input (0: photographs, through the fovea). The levels are then octaves by which the picture is reduced, and
            `width` and `sensor` are ignored.
        fixations: random fixations in each photograph, or windows of a mosaic at each magnification.
        levels: number of levels of distance. Each is `width` wide; the last one has no upper limit.
        width: width of a level for a fovea of 100 pixels, in pixels of an image whose longer side is 640. It is scaled
            with the fovea.
        minimum: number of objects that a level needs. A level with fewer takes the parameters of the next inner level
            (0: no level does).
        shrinkage: weight of a class's other levels in each of its levels, as a number of detections. It stabilises
            levels with few detections.
        enough: a class with at least so many detections at a level is fitted there by maximum likelihood alone, as
            published, without shrinkage (None: shrinkage everywhere).
        holdout: one in every n photographs is held out for the evaluation.
        iou: least overlap (IoU) at which a detection counts as showing an object.
        seed: seed of the fixations.
        shard: number of photographs in a unit of work. An interrupted run loses at most one unit for each worker.
        out: folder for the model, the report and the figures.
        cache: folder for the labelled detections (None: `out`).
        workers: number of processes (None: one for each CPU core).
    """

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
    shard: Count = 32
    out: Path = Path("runs/fit_fom")

    @property
    def edges(self) -> list[float]:
        """Borders between the levels, in units of the image's longer side, or in octaves for mosaics."""
        if self.mosaics:
            return [n - 0.5 for n in range(1, self.levels)]
        step = self.width / 100.0 * self.sensor.fovea
        return [step * n for n in range(1, self.levels)]
