"""Fit a foveal observation model to labelled detections, and report on it."""

import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.eye import Eye
from semfov.fit.detector_report import Difference, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.training import split
from semfov.metrics.calibration import calibration, surprisal
from semfov.observation import DirichletStatistics, FovealObservationModel, MissCounts, fit_discriminative
from semfov.runs.samples import Samples, all_cells
from semfov.viz import plot_reliability, save_figure
from semfov.zoom.eye import WindowEye

_CellsOfLook = Callable[[tuple[int, int], Tensor], tuple[Grid, Tensor, Tensor]]
"""Maps an image's size and a fixation to a grid for counting misses, to the distance of each cell from the fixation
`(X·Y,)` (for windows, the octaves of reduction), and to which cells the look shows, `(X·Y,)`."""


def fit_published(
    eye: Eye | WindowEye, scenes: Scenes, statistics: DirichletStatistics, edges: Sequence[float], **options: Any
) -> FovealObservationModel:
    """Fit Dirichlet distributions to the scores of each class and level; those with few detections are shrunk."""
    model = FovealObservationModel.identity(eye.detector.classes, edges)
    samples, data = int(statistics.count.sum()), scenes.fingerprint
    with warnings.catch_warnings():
        # The report lists the levels that take the parameters of another level.
        warnings.simplefilter("ignore", UserWarning)
        return model.fit(statistics, **options, **eye.settings(), samples=samples, data=data).eval()


def statistics_of(edges: Sequence[float], classes: Sequence[str], shards: Iterable[Samples]) -> DirichletStatistics:
    """Sum the sufficient statistics of detections by class and level, shard by shard."""
    model = FovealObservationModel.identity(classes, edges)
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

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = {name: getattr(self.config, name) for name in ("fixations", "holdout", "seed")}
        self.tasks = {"fitting": 1 + 0.1 * len(self.run.scenes)}

    def fit(self) -> PartResult:
        """Fit the model, and compare its posteriors of the true class with those of raw scores."""
        config, run, samples = self.config, self.run, self.inputs.samples
        holdout, edges = self.settings["holdout"], config.sensor.level_edges()
        held_out = split(samples.scene, holdout)
        judged, fitted = samples[held_out], samples[~held_out]
        statistics = statistics_of(edges, run.eye.detector.classes, [fitted])
        noted = {"expected": "empirical", "fixations": config.fixations, "seed": config.seed}
        start = fit_published(run.eye, run.scenes, statistics, edges, **noted)
        model = fit_discriminative(start, fitted.scores, fitted.distance, fitted.labels)
        fitted_on = {index for index in range(len(run.scenes)) if index % holdout}
        misses = count_misses(run.scenes, samples, fitted_on, model.edges, partial(all_cells, cells=config.cells))
        model.miss_rate = misses.rates().to(model.edges)
        raw = FovealObservationModel.identity(run.scenes.classes, edges).eval()
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
            f"{figures['raw'].nll:.3f}; {gain.in_words('nats gained')}"
        )
        figure = plot_reliability({name: (p, judged.labels) for name, p in posteriors.items()})
        save_figure(figure, self.config.out / "reliability.png")
        report = section(
            f"Predicted probability of the true class of a detection: fitted on {len(samples) - len(judged)} "
            f"detections, evaluated on {len(judged)} detections in {len(photographs)} held-out photographs.",
            rows,
        )
        return PartResult(self.write("observation", model, gain.better, why), report, ["reliability.png"])
