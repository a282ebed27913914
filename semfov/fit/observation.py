"""Fit a foveal observation model to labelled detections, and report on it."""

from __future__ import annotations

import json
import platform
import sys
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.fit.comparison import Difference
from semfov.fit.detector_report import in_words, section
from semfov.fit.outputs import model_path, split
from semfov.fit.parts.base import IOU, PartFit, PartResult
from semfov.fit.settings import FitConfig
from semfov.io.code import commit
from semfov.io.files import write_text
from semfov.io.tables import csv_text
from semfov.metrics.calibration import Calibration, calibration, surprisal
from semfov.observation import MissCounts, fit_discriminative
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.mle import Method
from semfov.observation.statistics import DirichletStatistics
from semfov.runs.looking import Looking
from semfov.runs.samples import CellsOfLook, Sampler, Samples, all_cells, collect_samples
from semfov.runs.settings import Count, Positive, Range, Share, Weight, Whole
from semfov.runs.tables import table
from semfov.runs.zoom_samples import MosaicSampler
from semfov.version import __version__
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure


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


def fit_fom(config: FitObservationConfig) -> None:
    """Collect labelled detections, fit the model, evaluate it on held-out photographs, and write all results."""
    folder, kind = (config.cache or config.out) / "samples", MosaicSampler if config.mosaics else Sampler
    sampler = collect_samples(config, folder, "looking", kind)
    samples = sampler.drawn(config.most)
    held_out = split(samples.scene, config.holdout)
    training = (shard[shard.scene % config.holdout != 0] for shard in sampler.by_shard())
    statistics = _statistics_of(config, sampler, training)
    model = _fit_model(config, sampler, statistics, samples[~held_out])
    fitted_on = {index for index in range(len(sampler.scenes)) if index % config.holdout != 0}
    counts = (
        _count_misses(sampler.scenes, shard, fitted_on, model.edges, sampler.cells) for shard in sampler.by_shard()
    )
    misses = MissCounts.merge(counts, len(model.classes) + 1, len(model.edges) + 1)
    model.miss_rate = misses.rates().to(model.edges)
    if config.mosaics:
        model.metadata["cells"] = misses.total.sum(1).tolist()
    path = model_path(config, sampler.eye.detector.name)
    model.save(path)
    edges, classes = config.edges, sampler.eye.detector.classes
    models = {"raw scores": FovealObservationModel.identity(classes, edges).eval()}
    methods: tuple[Method, ...] = ("newton", "fixed_point", "gradient")
    for method in methods:
        models[f"Dirichlet, {method}"] = _fit_published(config, sampler, statistics, method)
    models["Dirichlet with class prior"] = _fit_published(config, sampler, statistics, "newton", prior=True)
    models["the same, tempered 0.1"] = _fit_published(config, sampler, statistics, "newton", prior=True, tempering=0.1)
    if config.method == "discriminative":
        models["discriminative"] = model
    written = _write_report(config, model, models, samples[held_out])
    print("written:")
    for file in [path, *written]:
        print(f"  {file}")


_Looker = Sampler | Looking
"""The source of the detections: random looks, or looks from every cell."""


def _fit_model(
    config: FitObservationConfig, sampler: _Looker, statistics: DirichletStatistics, samples: Samples
) -> FovealObservationModel:
    """Fit the model with the method in the settings."""
    if config.method != "discriminative":
        return _fit_published(config, sampler, statistics, config.method)
    start = _fit_published(config, sampler, statistics, "newton", expected="empirical")
    return fit_discriminative(start, samples.scores, samples.distance, samples.labels)


def _fit_published(
    config: FitObservationConfig,
    sampler: _Looker,
    statistics: DirichletStatistics,
    method: Method,
    **options: Any,
) -> FovealObservationModel:
    """Fit Dirichlet distributions to the scores of each class and level.

    A pair of class and level with enough detections is fitted by maximum likelihood, as published. Others are shrunk.
    """
    classes = sampler.eye.detector.classes
    model = FovealObservationModel.identity(classes, config.edges)
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
            **sampler.eye.settings(),
            samples=int(statistics.count.sum()),
            data=sampler.scenes.fingerprint,
            fixations=config.fixations,
            seed=config.seed,
        ).eval()


def _statistics_of(config: FitObservationConfig, sampler: _Looker, shards: Iterable[Samples]) -> DirichletStatistics:
    """Sum the sufficient statistics of detections by class and level, shard by shard."""
    model = FovealObservationModel.identity(sampler.eye.detector.classes, config.edges)
    components, levels = model.alpha.shape[:2]
    statistics = DirichletStatistics((components, levels), components, epsilon=model.epsilon)
    for samples in shards:
        statistics.update(samples.scores, (samples.labels, model.level(samples.distance)))
    return statistics


def _count_misses(
    photographs: Scenes, samples: Samples, scenes: set[int], edges: Tensor, cells: CellsOfLook
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


_Models = dict[str, FovealObservationModel]


def _write_report(
    config: FitObservationConfig,
    model: FovealObservationModel,
    models: _Models,
    judged: Samples,
) -> list[Path]:
    """Evaluate the models (the fitted one last) on held-out samples, print the tables, and write all files."""
    with torch.inference_mode():
        predictions = {name: m.calibrate(judged.scores, judged.distance) for name, m in models.items()}
        likelihood = {
            name: float(m.log_likelihood(judged.scores, judged.distance).gather(1, judged.labels[:, None]).mean())
            for name, m in models.items()
        }
    figures = {name: calibration(p, judged.labels) for name, p in predictions.items()}
    by_level = _figures_by_level(model, predictions, judged)
    text = _report_markdown(config, model, figures, likelihood, by_level, model.metadata["samples"])
    print(text)
    write_text(config.out / "report.md", text)
    write_text(config.out / "config.yaml", config.yaml())
    metadata = {key: value for key, value in model.metadata.items() if key != "counts"}
    write_text(
        config.out / "manifest.json",
        json.dumps(
            {
                "command": ["python", "-m", "train.fit_fom", *sys.argv[1:]],
                "commit": commit(),
                "versions": {"semfov": __version__, "python": platform.python_version(), "torch": torch.__version__},
                "model": metadata,
                "held_out": {name: asdict(figure) for name, figure in figures.items()},
            },
            indent=2,
        )
        + "\n",
    )
    last = list(models)[-1]
    classes = ("background", *model.classes)
    counts = ([name, *row] for name, row in zip(classes, model.metadata["counts"], strict=True))
    head = ["class", *(f"level {n}" for n in range(len(model.edges) + 1))]
    write_text(config.out / "counts.csv", csv_text([head, *counts]))
    figure = plot_reliability({name: (predictions[name], judged.labels) for name in ("raw scores", last)})
    names = ["report.md", "counts.csv", "config.yaml", "manifest.json"]
    return [*(config.out / name for name in names), save_figure(figure, config.out / "reliability.png")]


def _report_markdown(
    config: FitObservationConfig,
    model: FovealObservationModel,
    figures: dict[str, Calibration],
    likelihood: dict[str, float],
    by_level: list[list[str]],
    fitted: int,
) -> str:
    """Write the report as Markdown: the measures of each model, then counts and measures by level."""
    judged = next(iter(figures.values())).count
    head = ["model", "log likelihood", "NLL", "Brier", "ECE", "classwise ECE", "accuracy"]
    rows = [
        [name, f"{likelihood[name]:.2f}", *(f"{value:.3f}" for value in (f.nll, f.brier, f.ece)),
         f"{f.classwise_ece:.4f}", f"{f.accuracy:.3f}"]
        for name, f in figures.items()
    ]  # fmt: skip
    summary = table([head, *rows])
    counts = torch.tensor(model.metadata["counts"])
    fallback = model.metadata["fallback"]
    edges = ["0", *(f"{edge:.3f}" for edge in model.edges.tolist()), "…"]
    levels = [
        [
            f"{low} - {high}",
            str(int(counts[0, n])),
            str(int(counts[1:, n].sum())),
            str(fallback.get(str(n), "")),
            *by_level[n],
        ]
        for n, (low, high) in enumerate(pairwise(edges))
    ]
    axis = "reduction in octaves" if config.mosaics else "distance"
    where = (
        "the number of octaves by which the picture is reduced"
        if config.mosaics
        else "distance to the fixation in units of the image's longer side"
    )
    head = [axis, "background", "objects", "uses level", "NLL, raw", "NLL", "ECE, raw", "ECE"]
    return "\n".join(
        [
            f"Fitted on {fitted} detections, evaluated on {judged} detections in held-out photographs (one in "
            f"{config.holdout}). The log likelihood is that of the scores given the true class. The other measures are "
            "of the posterior of the class, background included.",
            "",
            *summary,
            "",
            f"Number of detections in the fit, by {where}. Levels with too few objects use the parameters of another "
            "level. NLL and ECE are measured on the held-out detections, for raw scores and for the fitted model.",
            "",
            *table([head, *levels]),
            "",
        ]
    )


def _figures_by_level(
    model: FovealObservationModel, predictions: dict[str, Tensor], judged: Samples
) -> list[list[str]]:
    """Compute NLL and ECE of raw scores and of the fitted model at each level; predictions `(M, K+1)`."""
    first, *_, last = predictions.values()
    level = model.level(judged.distance)
    rows = []
    for n in range(len(model.edges) + 1):
        here = level == n
        if not here.any():
            rows.append([""] * 4)
            continue
        raw, own = (calibration(each[here], judged.labels[here]) for each in (first, last))
        rows.append([f"{value:.3f}" for value in (raw.nll, own.nll, raw.ece, own.ece)])
    return rows


class ObservationFit(PartFit):
    """Fit the observation model with its miss rates."""

    name: ClassVar[str] = "observation"

    @property
    def settings(self) -> FitObservationConfig:
        """The settings of the observation model."""
        return self.inputs.settings(FitObservationConfig)

    @property
    def tasks(self) -> dict[str, float]:
        """The tasks and their seconds."""
        return {"fitting": 1 + 0.1 * len(self.run.scenes)}

    def fit(self) -> PartResult:
        """Fit the model, and compare its posteriors of the true class with those of raw scores."""
        config, run, samples = self.settings, self.run, self.inputs.samples
        held_out = split(samples.scene, config.holdout)
        judged = samples[held_out]
        model = _fit_model(config, run, _statistics_of(config, run, [samples[~held_out]]), samples[~held_out])
        fitted_on = {index for index in range(len(run.scenes)) if index % config.holdout}
        cells = partial(all_cells, cells=self.config.cells)
        misses = _count_misses(run.scenes, samples, fitted_on, model.edges, cells)
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
