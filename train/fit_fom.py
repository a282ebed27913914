"""Fit a foveal observation model: `python -m train.fit_fom` learns how a detector scores what it sees off-centre.

    python -m train.fit_fom --data.root DIR --data.annotations instances.json --out runs/fit_fom

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Every photograph is fixated at random points. The detections are matched to the annotated boxes, and p(scores | class,
distance to the fovea) is fitted to them. The folder `out` gets the model (`<name>.safetensors`), a report that
evaluates it on held-out photographs, and a reliability diagram. If a run is interrupted, repeat the command to
continue. Several machines share the work with `--scheduler` (docs/guides/cluster.md).

Use the model with `--belief.model runs/fit_fom/<name>.safetensors`.
"""

import json
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Annotated, Literal

import torch
from torch import Tensor

from semfov.errors import check
from semfov.fit.cells import MOST_PHOTOGRAPHS, fit_cells
from semfov.fit.observation import count_misses, fit_published, statistics_of
from semfov.fit.samples import AnnotatedLooks, Samples, annotated_looks
from semfov.fit.settings import FitConfig
from semfov.fit.through_belief import fit_through_belief, mean_landing_loss, starting_model
from semfov.fit.training import split
from semfov.io.ranges import Count, Positive, Range, Share, Weight, Whole
from semfov.io.tables import csv_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.observation import MissCounts, fit_discriminative
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.mle import Method
from semfov.runs.command import command
from semfov.runs.tables import table
from semfov.version import __version__
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure
from train.mosaic_samples import MosaicSampler
from train.outputs import commit, model_path, write_outputs
from train.samples import Sampler, collect_samples

_Models = dict[str, FovealObservationModel]


@dataclass(frozen=True)
class FitFomConfig(FitConfig):
    """Fit p(scores | class, distance to the fovea) on photographs with boxes.

    Args:
        data: photographs to fit on (by default all of them, however many objects they have).
        method: how the model is fitted. `newton`, `fixed_point` (both by Minka; the paper does not say which it uses)
            and `gradient` maximise the likelihood of the scores, for classes and levels with `enough` detections.
            `discriminative` maximises the posterior probability of the true class instead, which is the quantity that
            calibration is about. `search` starts from it, and learns through the belief where the target of a search
            is (`semfov.fit.through_belief`): the odds of a miss.
        steps: number of steps of the fit through the belief.
        looks: most looks in a search of this fit.
        max_target_area: classes that cover a larger share of the image are not searched for in this fit.
        mosaics: number of mosaics of 8 × 6 photographs to look at in windows, for pictures larger than the detector's
            input (0: photographs, through the fovea). The levels are then octaves by which the picture is reduced, and
            `width` and `sensor` are ignored.
        fixations: random fixations in each photograph, or windows of a mosaic at each magnification.
        levels: number of levels of distance. Each is `width` wide; the last one has no upper limit.
        width: width of a level for a fovea of 100 pixels, in pixels of an image whose longer side is 640. It is scaled
            with the fovea. A sensor with steps of acuity has its own levels, one for each step.
        minimum: number of objects that a level needs. A level with fewer is fitted with the detections of its
            neighbours, of as many as it needs (0: no level is).
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

    method: Literal["newton", "fixed_point", "gradient", "discriminative", "search"] = "discriminative"
    steps: Count = 200
    looks: Count = 8
    max_target_area: Positive = 0.2
    mosaics: Whole = 0
    fixations: Count = 8
    levels: Annotated[int, Range(1, 1000)] = 8
    width: Positive = 50.0
    minimum: Whole = 100
    shrinkage: Weight = 10.0
    enough: Whole | None = None
    holdout: Annotated[int, Range(2, 10**9)] = 10
    iou: Share = 0.5
    most: Count = 1_000_000
    shard: Count = 32
    out: Path = Path("runs/fit_fom")

    @property
    def edges(self) -> list[float]:
        """Borders between the levels, in units of the image's longer side, or in octaves for mosaics."""
        if self.mosaics:
            return [n - 0.5 for n in range(1, self.levels)]
        return self.sensor.level_edges(self.levels, self.width)


_TRAINED = ("discriminative", "search")
"""Methods that maximise the probability of the true class, from the published fit on."""

_CELLS = (10, 10)  # columns and rows of the beliefs through which numbers are fitted


def _fitted_name(config: FitFomConfig) -> str:
    """Return the name in tables of the model that is saved, or that the fit through the belief starts from."""
    return "discriminative" if config.method in _TRAINED else f"Dirichlet, {config.method}"


def _judgement(config: FitFomConfig, figures: dict[str, Calibration]) -> str:
    """Say whether the saved model is better than raw scores on held-out photographs."""
    raw = figures["raw scores"]
    fitted = figures[_fitted_name(config)]
    measured = f"Brier {fitted.brier:.3f} and NLL {fitted.nll:.3f}, raw scores {raw.brier:.3f} and {raw.nll:.3f}"
    if fitted.brier <= raw.brier and fitted.nll <= raw.nll:
        return f"The model is better than raw scores on held-out photographs: {measured}."
    return (
        f"**Raw scores are better on held-out photographs**: the model has {measured}. Do without the model, or fit it "
        f"on more photographs."
    )


class _Evaluation:
    """Models on held-out samples.

    Attributes:
        model: the model that is saved, or that the fit through the belief starts from.
        judged: M labelled detections.
        predictions: posteriors of the class by the name of the model, `(M, K+1)`.
        likelihood: mean log likelihood of the scores given the true class.
        figures: measures of the posteriors.
    """

    def __init__(self, model: FovealObservationModel, models: _Models, judged: Samples) -> None:
        self.model = model
        self.judged = judged
        labels = judged.labels[:, None]
        with torch.inference_mode():
            self.predictions = {name: other.calibrate(judged.scores, judged.distance) for name, other in models.items()}
            self.likelihood = {
                name: float(other.log_likelihood(judged.scores, judged.distance).gather(1, labels).mean())
                for name, other in models.items()
            }
        self.figures = {name: calibration(posterior, judged.labels) for name, posterior in self.predictions.items()}

    def compared(self) -> dict[str, tuple[Tensor, Tensor]]:
        """Return the posteriors by raw scores and by the last model, each with the true classes."""
        *_, last = self.predictions
        return {name: (self.predictions[name], self.judged.labels) for name in ("raw scores", last)}

    def model_rows(self) -> list[list[str]]:
        """Make rows of a table of the measures of each model."""
        rows = [["model", "log likelihood", "NLL", "Brier", "ECE", "classwise ECE", "accuracy"]]
        for name, figures in self.figures.items():
            measures = (figures.nll, figures.brier, figures.ece)
            rows.append(
                [
                    name,
                    f"{self.likelihood[name]:.2f}",
                    *(f"{measure:.3f}" for measure in measures),
                    f"{figures.classwise_ece:.4f}",
                    f"{figures.accuracy:.3f}",
                ]
            )
        return rows

    def level_rows(self, axis: str) -> list[list[str]]:
        """Make rows of a table of counts and measures at each level."""
        counts = torch.tensor(self.model.metadata["counts"])
        borders = ["0", *(f"{edge:.3f}" for edge in self.model.edges.tolist()), "…"]
        rows = [[axis, "background", "objects", "with levels", "NLL, raw", "NLL", "ECE, raw", "ECE"]]
        for level, (low, high) in enumerate(pairwise(borders)):
            background = int(counts[0, level])
            objects = int(counts[1:, level].sum())
            levels = self._levels_together(level)
            rows.append([f"{low} - {high}", str(background), str(objects), levels, *self._figures_at(level)])
        return rows

    def _levels_together(self, level: int) -> str:
        """Return the first and the last of the levels that a level is fitted with; empty where it is fitted alone."""
        pooled = self.model.metadata["pooled"]
        if str(level) not in pooled:
            return ""
        levels = pooled[str(level)]
        return f"{levels[0]} to {levels[-1]}"

    def _figures_at(self, level: int) -> list[str]:
        """Measure NLL and ECE of raw scores and of the fitted model at a level, as cells of a table."""
        is_at_level = self.model.level(self.judged.distance) == level
        if not is_at_level.any():
            return [""] * 4
        first, *_, last = self.predictions.values()
        labels = self.judged.labels[is_at_level]
        raw = calibration(first[is_at_level], labels)
        fitted = calibration(last[is_at_level], labels)
        return [f"{value:.3f}" for value in (raw.nll, fitted.nll, raw.ece, fitted.ece)]


def _report_markdown(config: FitFomConfig, evaluation: _Evaluation) -> str:
    """Write the report as Markdown: the measures of each model, then counts and measures by level."""
    if config.mosaics:
        axis = "reduction in octaves"
        words = "the number of octaves by which the picture is reduced"
    else:
        axis = "distance"
        words = "distance to the fixation in units of the image's longer side"
    return "\n".join(
        [
            f"Fitted on {evaluation.model.metadata['samples']} detections, evaluated on {len(evaluation.judged)} "
            f"detections in held-out photographs (one in {config.holdout}). The log likelihood is that of the scores "
            "given the true class. The other measures are of the posterior of the class, background included.",
            "",
            *table(evaluation.model_rows()),
            "",
            _judgement(config, evaluation.figures),
            "",
            f"Number of detections in the fit, by {words}. Levels with too few objects are fitted with their "
            "neighbours. NLL and ECE are measured on the held-out detections, for raw scores and for the fitted model.",
            "",
            *table(evaluation.level_rows(axis)),
            "",
        ]
    )


def _counts(model: FovealObservationModel) -> str:
    """List the detections of the fit by class and level, as CSV."""
    classes = ("background", *model.classes)
    counts = ([name, *row] for name, row in zip(classes, model.metadata["counts"], strict=True))
    head = ["class", *(f"level {level}" for level in range(len(model.edges) + 1))]
    return csv_text([head, *counts])


def _manifest(evaluation: _Evaluation) -> dict[str, object]:
    """Describe the run: the command, the versions, and the model with its measures."""
    metadata = evaluation.model.metadata
    return {
        "command": ["python", "-m", "train.fit_fom", *sys.argv[1:]],
        "commit": commit(),
        "versions": {"semfov": __version__, "python": platform.python_version(), "torch": torch.__version__},
        "model": {name: value for name, value in metadata.items() if name != "counts"},
        "held_out": {name: asdict(figures) for name, figures in evaluation.figures.items()},
    }


def _fit_to_search(
    config: FitFomConfig, sampler: Sampler, model: FovealObservationModel
) -> tuple[FovealObservationModel, str]:
    """Fit a model through the belief; returns it, and how much better searches of held-out photographs land."""
    searches = [searched for searched in _annotated(config, sampler) if len(searched.targets)]
    training = [searched for searched in searches if searched.photograph % config.holdout]
    judged = [searched for searched in searches if searched.photograph % config.holdout == 0]
    options = {"looks": config.looks, "steps": config.steps, "seed": config.seed}
    fitted = fit_through_belief(model, training, **options, search={**options, "photographs": len(training)})
    if not judged:
        return fitted, ""
    before = mean_landing_loss(starting_model(model), judged, config.looks)
    after = mean_landing_loss(fitted, judged, config.looks)
    return fitted, (
        f"Searches of {len(judged)} held-out photographs: the negative log of the target's share of the belief in "
        f"cells not fixated yet is {after:.3f} on average, before the fit through the belief {before:.3f}.\n\n"
    )


def fit_fom(config: FitFomConfig) -> None:
    """Collect labelled detections, fit the model, evaluate it on held-out photographs, and write all results."""
    check(not (config.mosaics and config.method == "search"), "method", "another one with mosaics", config.method)
    kind = MosaicSampler if config.mosaics else Sampler
    sampler = collect_samples(config, (config.cache or config.out) / "samples", "looking", kind)
    # Only these are in memory at once; the published fits and the misses are sums over all shards.
    samples = sampler.drawn(config.most)
    held_out = split(samples.scene, config.holdout)
    published = _published_fit(config, sampler)
    model = _fit_model(config, samples[~held_out], published)
    _describe_cells(config, sampler, model)
    saved = model
    landing = ""
    if config.method == "search":
        saved, landing = _fit_to_search(config, sampler, model)
    path = model_path(config, sampler.eye.detector.name)
    saved.save(path)
    evaluation = _Evaluation(model, _compared_models(config, published, model), samples[held_out])
    diagram = save_figure(plot_reliability(evaluation.compared()), config.out / "reliability.png")
    files = {"manifest.json": json.dumps(_manifest(evaluation), indent=2) + "\n", "counts.csv": _counts(model)}
    write_outputs(config, landing + _report_markdown(config, evaluation), files, path, diagram)


def _published_fit(config: FitFomConfig, sampler: Sampler) -> Callable[..., FovealObservationModel]:
    """Return the published fit to all detections in photographs that are not held out; its options are to be given."""
    training = (shard[shard.scene % config.holdout != 0] for shard in sampler.by_shard())
    statistics = statistics_of(config.edges, sampler.eye.detector.classes, training)
    options = {name: getattr(config, name) for name in ("minimum", "shrinkage", "enough", "fixations", "seed")}
    return partial(fit_published, sampler.eye, sampler.scenes, statistics, config.edges, **options)


def _fit_model(
    config: FitFomConfig, training: Samples, published: Callable[..., FovealObservationModel]
) -> FovealObservationModel:
    """Fit the model by the method of the settings."""
    if config.method not in _TRAINED:
        return published(method=config.method)
    start = published(expected="empirical")
    return fit_discriminative(start, training.scores, training.distance, training.labels)


def _annotated(config: FitFomConfig, sampler: Sampler) -> Iterator[AnnotatedLooks]:
    """Go through the looks at photographs with objects, and what their cells hold."""
    for shard in sampler.by_shard():
        looks = ((index, *shard.looks_at(index)) for index in shard.scenes.unique().tolist())
        yield from annotated_looks(sampler.scenes, looks, _CELLS, config.max_target_area)


def _describe_cells(config: FitFomConfig, sampler: Sampler, model: FovealObservationModel) -> None:
    """Set how often cells with an object have no detection, and fit what a look says about whole cells."""
    fitted_on = {index for index in range(len(sampler.scenes)) if index % config.holdout != 0}
    counts = (
        count_misses(sampler.scenes, shard, fitted_on, model.edges, sampler.cells) for shard in sampler.by_shard()
    )
    misses = MissCounts.merge(counts, len(model.classes) + 1, len(model.edges) + 1)
    model.miss_rate = misses.rates().to(model.edges)
    if config.mosaics:
        model.metadata["cells"] = misses.total.sum(1).tolist()
    elif config.method in _TRAINED:
        training = (looks for looks in _annotated(config, sampler) if looks.photograph in fitted_on)
        fit_cells(model, [*islice(training, MOST_PHOTOGRAPHS)], seed=config.seed)


def _compared_models(
    config: FitFomConfig, published: Callable[..., FovealObservationModel], model: FovealObservationModel
) -> _Models:
    """Return the models in the report: raw scores first, and the discriminative one last."""
    models = {"raw scores": FovealObservationModel.identity(model.classes, config.edges).eval()}
    methods: tuple[Method, ...] = ("newton", "fixed_point", "gradient")
    for method in methods:
        models[f"Dirichlet, {method}"] = published(method=method)
    models["Dirichlet with class prior"] = published(prior=True)
    models["the same, tempered 0.1"] = published(prior=True, tempering=0.1)
    if config.method in _TRAINED:
        models["discriminative"] = model
    return models


main = command(fit_fom, FitFomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
