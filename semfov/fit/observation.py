"""Fit a foveal observation model to labelled detections, and report on it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.eye import Eye
from semfov.fit.detector_report import Difference, in_words, section
from semfov.fit.outputs import split
from semfov.fit.part import IOU, PartFit, PartInputs, PartResult
from semfov.fit.settings import FitConfig
from semfov.metrics.calibration import calibration, surprisal
from semfov.observation import MissCounts, fit_discriminative
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.mle import Method
from semfov.observation.statistics import DirichletStatistics
from semfov.runs.samples import Samples, all_cells
from semfov.runs.settings import Count, Positive, Range, Share, Weight, Whole
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure
from semfov.zoom.eye import WindowEye

_CellsOfLook = Callable[[tuple[int, int], Tensor], tuple[Grid, Tensor, Tensor]]
"""Maps an image's size and a fixation to a grid for counting misses, to the distance of each cell from the fixation
`(X·Y,)` (for windows, the octaves of reduction), and to which cells the look shows, `(X·Y,)`."""


@dataclass(frozen=True)
class FitObservationConfig(FitConfig):
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
            with the fovea. A sensor with steps of acuity has its own levels, one for each step.
        minimum: number of objects that a level needs. A level with fewer takes the parameters of the next inner level
            (0: no level does).
        shrinkage: weight of a class's other levels in each of its levels, as a number of detections. It stabilises
            levels with few detections.
        enough: a class with at least so many detections at a level is fitted there by maximum likelihood alone, as
            published, without shrinkage (None: shrinkage everywhere).
        holdout: one in every n photographs is held out for the evaluation.
        iou: least overlap (IoU) at which a detection counts as showing an object.
        most: number of detections that are in memory at most, about; they are drawn evenly from all. The discriminative
            fit and the report are from these, the published fits are from all.
        seed: seed of the fixations.
        shard: number of photographs in a unit of work. An interrupted run loses at most one unit for each worker.
        out: folder for the model, the report and the figures.
        cache: folder for the labelled detections (None: `out`).
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
    iou: Share = IOU
    most: Count = 1_000_000
    shard: Count = 32
    out: Path = Path("runs/fit_fom")

    @property
    def edges(self) -> list[float]:
        """Borders between the levels, in units of the image's longer side, or in octaves for mosaics."""
        if self.mosaics:
            return [n - 0.5 for n in range(1, self.levels)]
        own = self.sensor.kind.borders(self.sensor.whole())
        if own is not None:
            # Farther away than the longer side there is hardly anything.
            return [edge / self.sensor.reference for edge in own if edge < self.sensor.reference]
        step = self.width / 100.0 * self.sensor.fovea
        return [step * n for n in range(1, self.levels)]


def fit_model(
    config: FitObservationConfig,
    eye: Eye | WindowEye,
    scenes: Scenes,
    statistics: DirichletStatistics,
    samples: Samples,
) -> FovealObservationModel:
    """Fit the model with the method in the settings."""
    if config.method != "discriminative":
        return fit_published(config, eye, scenes, statistics, config.method)
    start = fit_published(config, eye, scenes, statistics, "newton", expected="empirical")
    return fit_discriminative(start, samples.scores, samples.distance, samples.labels)


def fit_published(
    config: FitObservationConfig,
    eye: Eye | WindowEye,
    scenes: Scenes,
    statistics: DirichletStatistics,
    method: Method,
    **options: Any,
) -> FovealObservationModel:
    """Fit Dirichlet distributions to the scores of each class and level.

    A pair of class and level with enough detections is fitted by maximum likelihood, as published. Others are shrunk.
    """
    model = FovealObservationModel.identity(eye.detector.classes, config.edges)
    with warnings.catch_warnings():
        # The report lists the levels that take the parameters of another level.
        warnings.simplefilter("ignore", UserWarning)
        return model.fit(
            statistics,
            method=method,
            minimum=config.minimum,
            shrinkage=config.shrinkage,
            enough=config.enough,
            **options,
            **eye.settings(),
            samples=int(statistics.count.sum()),
            data=scenes.fingerprint,
            fixations=config.fixations,
            seed=config.seed,
        ).eval()


def statistics_of(
    config: FitObservationConfig, classes: Sequence[str], shards: Iterable[Samples]
) -> DirichletStatistics:
    """Sum the sufficient statistics of detections by class and level, shard by shard."""
    model = FovealObservationModel.identity(classes, config.edges)
    components, levels = model.alpha.shape[:2]
    statistics = DirichletStatistics((components, levels), components, epsilon=model.epsilon)
    for samples in shards:
        statistics.update(samples.scores, (samples.labels, model.level(samples.distance)))
    return statistics


def count_misses(
    photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, cells: _CellsOfLook
) -> MissCounts:
    """Count cells without any detection over all looks at some photographs; edges `(N-1,)`."""
    counts = torch.bincount(samples.look, minlength=len(samples.scenes)).tolist()
    misses = MissCounts(samples.scores.shape[-1], len(edges) + 1)
    for look, boxes in enumerate(samples.boxes.split(counts)):
        index = int(samples.scenes[look])
        if index not in scenes:
            continue
        annotation = photographs.annotation(index)
        grid, distance, in_view = cells(annotation.size, samples.fixations[look])
        level = torch.bucketize(distance, edges)[in_view]
        detected, objects = grid.footprint(boxes).any(0), grid.footprint(annotation.boxes)
        misses.update(detected[in_view], objects[:, in_view], annotation.labels, level)
    return misses


class ObservationFit(PartFit):
    """Fit the observation model with its miss rates."""

    name: ClassVar[str] = "observation"
    settings: FitObservationConfig

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = inputs.settings(FitObservationConfig)
        self.tasks = {"fitting": 1 + 0.1 * len(self.run.scenes)}

    def fit(self) -> PartResult:
        """Fit the model, and compare its posteriors of the true class with those of raw scores."""
        config, run, samples = self.settings, self.run, self.inputs.samples
        held_out = split(samples.scene, config.holdout)
        judged = samples[held_out]
        fitted = samples[~held_out]
        statistics = statistics_of(config, run.eye.detector.classes, [fitted])
        model = fit_model(config, run.eye, run.scenes, statistics, fitted)
        fitted_on = {index for index in range(len(run.scenes)) if index % config.holdout}
        cells = partial(all_cells, cells=self.config.cells)
        misses = count_misses(run.scenes, samples, fitted_on, model.edges, cells)
        model.miss_rate = misses.rates().to(model.edges)
        raw = FovealObservationModel.identity(run.scenes.classes, config.edges).eval()
        with torch.inference_mode():
            posteriors = {
                name: m.calibrate(judged.scores, judged.distance) for name, m in (("raw", raw), ("fitted", model))
            }
        cost = {name: surprisal(p.double().gather(1, judged.labels[:, None])[:, 0]) for name, p in posteriors.items()}
        photographs = judged.scene.unique().tolist()
        means = {
            name: torch.stack([each[judged.scene == scene].mean() for scene in photographs]).numpy()
            for name, each in cost.items()
        }
        gain = Difference.of(means["raw"], means["fitted"])
        figures = {name: calibration(p, judged.labels) for name, p in posteriors.items()}
        rows = [["scores", "NLL", "Brier", "ECE", "accuracy"]]
        rows += [
            [name, f"{f.nll:.3f}", f"{f.brier:.3f}", f"{f.ece:.3f}", f"{f.accuracy:.3f}"] for name, f in figures.items()
        ]
        why = (
            f"negative log likelihood of the true class {figures['fitted'].nll:.3f}, with raw scores "
            f"{figures['raw'].nll:.3f}; {in_words(gain, 'nats gained')}"
        )
        figure = plot_reliability({name: (p, judged.labels) for name, p in posteriors.items()})
        save_figure(figure, self.config.out / "reliability.png")
        report = section(
            f"Predicted probability of the true class of a detection: fitted on {len(samples) - len(judged)} "
            f"detections, evaluated on {len(judged)} detections in {len(photographs)} held-out photographs.",
            rows,
        )
        return PartResult(self.write(model, gain.better, why), report, ["reliability.png"])
