"""Fit a foveal observation model to labelled detections, and report on it."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.eye import Eye
from semfov.fit.cells import MOST_PHOTOGRAPHS, fit_cells, mean_map_loss
from semfov.fit.detector_report import Difference, section
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.samples import AnnotatedLooks, Samples, all_cells, annotated_looks
from semfov.fit.training import split
from semfov.metrics.calibration import Calibration, calibration, surprisal
from semfov.metrics.episodes import FloatArray
from semfov.observation import DirichletStatistics, FovealObservationModel, MissCounts, fit_discriminative
from semfov.viz import plot_reliability, save_figure
from semfov.zoom.eye import WindowEye

_CellsOfLook = Callable[[tuple[int, int], Tensor], tuple[Grid, Tensor, Tensor]]
"""Maps an image's size and a fixation to a grid for counting misses, to the distance of each cell from the fixation
`(X·Y,)` (for windows, the octaves of reduction), and to which cells the look shows, `(X·Y,)`."""


def fit_published(
    eye: Eye | WindowEye,
    scenes: Scenes,
    statistics: DirichletStatistics,
    edges: Sequence[float],
    **options: Any,
) -> FovealObservationModel:
    """Fit Dirichlet distributions to the scores of each class and level; those with few detections are shrunk.

    Args:
        eye: the eye that made the detections; its settings are saved with the model.
        scenes: the photographs; their digest is saved with the model.
        statistics: sufficient statistics of the detections.
        edges: borders between the levels.
        options: options of `FovealObservationModel.fit`, and JSON values to save with the model.

    Returns:
        The model, in `eval` mode.
    """
    model = FovealObservationModel.identity(eye.detector.classes, edges)
    samples = int(statistics.count.sum())  # saved with the model
    with warnings.catch_warnings():
        # The report lists the levels that take the parameters of another level.
        warnings.simplefilter("ignore", UserWarning)
        model = model.fit(statistics, **options, **eye.settings(), samples=samples, data=scenes.fingerprint)
    return model.eval()


def statistics_of(edges: Sequence[float], classes: Sequence[str], shards: Iterable[Samples]) -> DirichletStatistics:
    """Sum the sufficient statistics of detections by class and level, shard by shard.

    Args:
        edges: borders between the levels.
        classes: names of the K classes.
        shards: labelled detections.

    Returns:
        The statistics, of shape `(K+1, N)`.
    """
    model = FovealObservationModel.identity(classes, edges)
    components, levels = model.alpha.shape[:2]
    statistics = DirichletStatistics((components, levels), components, epsilon=model.epsilon)
    for samples in shards:
        statistics.update(samples.scores, (samples.labels, model.level(samples.distance)))
    return statistics


def count_misses(
    photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, cells: _CellsOfLook
) -> MissCounts:
    """Count cells without any detection over all looks at some photographs.

    Args:
        photographs: all photographs.
        samples: labelled detections, with the looks that they come from.
        scenes: numbers of the photographs that count.
        edges: `(N-1,)`, borders between the levels.
        cells: gives the cells that a look shows.

    Returns:
        The counts by class and level.
    """
    misses = MissCounts(samples.scores.shape[-1], len(edges) + 1)
    # The last looks may have no detections, and miss objects all the same.
    detections = torch.bincount(samples.look, minlength=len(samples.scenes)).tolist()
    for look, boxes in enumerate(samples.boxes.split(detections)):
        index = int(samples.scenes[look])
        if index not in scenes:
            continue
        annotation = photographs.annotation(index)
        grid, distance, in_view = cells(annotation.size, samples.fixations[look])
        level = torch.bucketize(distance, edges)[in_view]
        detected = grid.footprint(boxes).any(0)
        objects = grid.footprint(annotation.boxes)
        misses.update(detected[in_view], objects[:, in_view], annotation.labels, level)
    return misses


class ObservationFit(PartFit):
    """Fit the observation model with its miss rates."""

    settings: dict[str, int]

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = {name: getattr(self.config, name) for name in ("fixations", "holdout", "seed")}
        self.tasks = {"fitting": 1 + 0.1 * len(self.run.scenes)}

    def fit(self) -> PartResult:
        """Fit the model, and compare its posteriors of the true class with those of raw scores."""
        samples = self.inputs.samples
        held_out = split(samples.scene, self.settings["holdout"])
        judged = samples[held_out]
        model = self._fit_model(samples, samples[~held_out])
        raw = FovealObservationModel.identity(self.run.scenes.classes, self._edges).eval()
        losses = self._fit_maps(samples, {"raw": raw, "calibrated": model})
        with torch.inference_mode():
            posteriors = {
                "raw": raw.calibrate(judged.scores, judged.distance),
                "fitted": model.calibrate(judged.scores, judged.distance),
            }
        diagram = plot_reliability({name: (posterior, judged.labels) for name, posterior in posteriors.items()})
        save_figure(diagram, self.config.out / "reliability.png")
        figures = {name: calibration(posterior, judged.labels) for name, posterior in posteriors.items()}
        gain, why = _compare(posteriors, figures, judged)
        part = self.write("observation", model, gain.better, why, map=_map_settings(raw, losses))
        return PartResult(part, _report(figures, len(samples) - len(judged), judged), ["reliability.png"])

    def _fit_maps(self, samples: Samples, models: Mapping[str, FovealObservationModel]) -> dict[str, float]:
        """Fit what looks say about cells with each model; returns the loss of its maps of held-out photographs."""
        photographs = self._annotated(samples, self.inputs.training)
        judged = self._annotated(samples, self.inputs.held_out)
        for model in models.values():
            fit_cells(model, photographs, seed=self.settings["seed"])
        # Of few photographs those that are held out may show no object.
        return {name: mean_map_loss(model, judged or photographs) for name, model in models.items()}

    def _annotated(self, samples: Samples, photographs: Iterable[int]) -> list[AnnotatedLooks]:
        """List the looks at the first photographs with objects."""
        looks = ((index, *samples.looks_at(index)) for index in photographs)
        return [*islice(annotated_looks(self.run.scenes, looks, self.config.cells), MOST_PHOTOGRAPHS)]

    @property
    def _edges(self) -> list[float]:
        return self.config.sensor.level_edges()

    def _fit_model(self, samples: Samples, training: Samples) -> FovealObservationModel:
        """Fit scores and miss rates to the detections in the photographs that are not held out."""
        run = self.run
        statistics = statistics_of(self._edges, run.eye.detector.classes, [training])
        options = {"expected": "empirical", "fixations": self.config.fixations, "seed": self.config.seed}
        start = fit_published(run.eye, run.scenes, statistics, self._edges, **options)
        model = fit_discriminative(start, training.scores, training.distance, training.labels)
        cells = partial(all_cells, cells=self.config.cells)
        misses = count_misses(run.scenes, samples, {*self.inputs.training}, model.edges, cells)
        model.miss_rate = misses.rates().to(model.edges)
        return model


def _compare(
    posteriors: Mapping[str, Tensor], figures: Mapping[str, Calibration], judged: Samples
) -> tuple[Difference, str]:
    """Compare the costs of fitted and of raw posteriors; the difference, and the sentence about it."""
    gain = Difference.of(_mean_costs(posteriors["raw"], judged), _mean_costs(posteriors["fitted"], judged))
    return gain, (
        f"negative log likelihood of the true class {figures['fitted'].nll:.3f}, with raw scores "
        f"{figures['raw'].nll:.3f}; {gain.in_words('nats gained')}"
    )


def _map_settings(raw: FovealObservationModel, losses: Mapping[str, float]) -> dict[str, object]:
    """Say by which scores the agent maps, those with the lower loss, and what raw scores say about cells."""
    return {
        "scores": min(losses, key=losses.__getitem__),
        "raw_cell": raw.log_cell.detach().exp().tolist(),
        "why": f"negative log of what a cell holds {losses['calibrated']:.3f} with calibrated scores, "
        f"{losses['raw']:.3f} with raw ones",
    }


def _report(figures: Mapping[str, Calibration], fitted: int, judged: Samples) -> str:
    """Write the section about the posteriors, of a model that was fitted to so many detections."""
    rows = [["scores", "NLL", "Brier", "ECE", "accuracy"]]
    for name, figure in figures.items():
        measures = (figure.nll, figure.brier, figure.ece, figure.accuracy)
        rows.append([name, *(f"{measure:.3f}" for measure in measures)])
    return section(
        f"Predicted probability of the true class of a detection: fitted on {fitted} "
        f"detections, evaluated on {len(judged)} detections in {len(judged.scene.unique())} held-out photographs.",
        rows,
    )


def _mean_costs(posterior: Tensor, judged: Samples) -> FloatArray:
    """Average the surprisal of the true class in each photograph, `(P,)`; posterior `(M, K+1)`."""
    cost = surprisal(posterior.double().gather(1, judged.labels[:, None])[:, 0])
    return torch.stack([cost[judged.scene == scene].mean() for scene in judged.scene.unique().tolist()]).numpy()
