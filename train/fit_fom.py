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
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import torch
from torch import Tensor

from semfov.errors import check
from semfov.fit.observation import count_misses, fit_published, statistics_of
from semfov.fit.settings import FitConfig
from semfov.fit.through_belief import (
    SearchedLooks,
    fit_through_belief,
    mean_landing_loss,
    searched_looks,
    starting_model,
)
from semfov.fit.training import split
from semfov.io.files import write_text
from semfov.io.tables import csv_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.observation import MissCounts, fit_discriminative
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.mle import Method
from semfov.runs.command import command
from semfov.runs.samples import Samples
from semfov.runs.settings import Count, Positive, Range, Share, Weight, Whole
from semfov.runs.tables import table
from semfov.version import __version__
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure
from train.mosaic_samples import MosaicSampler
from train.outputs import commit, model_path
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
            is (`semfov.fit.through_belief`): exponents, odds of a miss and refutation.
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


def _fitted_name(config: FitFomConfig) -> str:
    """Name in tables of the model that is saved, or that the fit through the belief starts from."""
    trained = config.method in ("discriminative", "search")
    return "discriminative" if trained else f"Dirichlet, {config.method}"


def _judgement(config: FitFomConfig, figures: dict[str, Calibration]) -> str:
    """Say whether the saved model is better than raw scores on held-out photographs."""
    raw, fitted = figures["raw scores"], figures[_fitted_name(config)]
    measured = f"Brier {fitted.brier:.3f} and NLL {fitted.nll:.3f}, raw scores {raw.brier:.3f} and {raw.nll:.3f}"
    if fitted.brier <= raw.brier and fitted.nll <= raw.nll:
        return f"The model is better than raw scores on held-out photographs: {measured}."
    return (
        f"**Raw scores are better on held-out photographs**: the model has {measured}. Do without the model, or fit it "
        f"on more photographs."
    )


def _report_markdown(
    config: FitFomConfig,
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
    pooled = model.metadata["pooled"]
    edges = ["0", *(f"{edge:.3f}" for edge in model.edges.tolist()), "…"]
    levels = [
        [
            f"{low} - {high}",
            str(int(counts[0, n])),
            str(int(counts[1:, n].sum())),
            "{} to {}".format(*[pooled[str(n)][end] for end in (0, -1)]) if str(n) in pooled else "",
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
    head = [axis, "background", "objects", "with levels", "NLL, raw", "NLL", "ECE, raw", "ECE"]
    return "\n".join(
        [
            f"Fitted on {fitted} detections, evaluated on {judged} detections in held-out photographs (one in "
            f"{config.holdout}). The log likelihood is that of the scores given the true class. The other measures are "
            "of the posterior of the class, background included.",
            "",
            *summary,
            "",
            _judgement(config, figures),
            "",
            f"Number of detections in the fit, by {where}. Levels with too few objects are fitted with their "
            "neighbours. NLL and ECE are measured on the held-out detections, for raw scores and for the fitted model.",
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


def _write_report(
    config: FitFomConfig,
    model: FovealObservationModel,
    models: _Models,
    judged: Samples,
    landing: str,
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
    text = landing + _report_markdown(config, model, figures, likelihood, by_level, model.metadata["samples"])
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


def _fit_to_search(
    config: FitFomConfig, sampler: Sampler, model: FovealObservationModel
) -> tuple[FovealObservationModel, str]:
    """Fit a model through the belief; returns it, and how much better searches of held-out photographs land."""
    searches: dict[int, SearchedLooks] = {}
    for shard in sampler.by_shard():
        searches |= searched_looks(sampler.scenes, shard, (10, 10), config.max_target_area)
    fitted = [each for index, each in searches.items() if index % config.holdout]
    judged = [each for index, each in searches.items() if index % config.holdout == 0]
    options = {"looks": config.looks, "steps": config.steps, "seed": config.seed}
    better = fit_through_belief(model, fitted, **options, search={**options, "photographs": len(fitted)})
    if not judged:
        return better, ""
    losses = [mean_landing_loss(each, judged, config.looks) for each in (starting_model(model), better)]
    return better, (
        f"Searches of {len(judged)} held-out photographs: the negative log of the target's share of the belief in "
        f"cells not fixated yet is {losses[1]:.3f} on average, before the fit through the belief {losses[0]:.3f}.\n\n"
    )


def fit_fom(config: FitFomConfig) -> None:
    """Collect labelled detections, fit the model, evaluate it on held-out photographs, and write all results."""
    check(not (config.mosaics and config.method == "search"), "method", "another one with mosaics", config.method)
    folder, kind = (config.cache or config.out) / "samples", MosaicSampler if config.mosaics else Sampler
    sampler = collect_samples(config, folder, "looking", kind)
    samples = sampler.drawn(config.most)
    held_out = split(samples.scene, config.holdout)
    training = (shard[shard.scene % config.holdout != 0] for shard in sampler.by_shard())
    edges, classes = config.edges, sampler.eye.detector.classes
    statistics = statistics_of(edges, classes, training)
    noted = {name: getattr(config, name) for name in ("minimum", "shrinkage", "enough", "fixations", "seed")}
    published = partial(fit_published, sampler.eye, sampler.scenes, statistics, edges, **noted)
    if config.method in ("discriminative", "search"):
        fitted, start = samples[~held_out], published(expected="empirical")
        model = fit_discriminative(start, fitted.scores, fitted.distance, fitted.labels)
    else:
        model = published(method=config.method)
    fitted_on = {index for index in range(len(sampler.scenes)) if index % config.holdout != 0}
    counts = (
        count_misses(sampler.scenes, shard, fitted_on, model.edges, sampler.cells) for shard in sampler.by_shard()
    )
    misses = MissCounts.merge(counts, len(model.classes) + 1, len(model.edges) + 1)
    model.miss_rate = misses.rates().to(model.edges)
    if config.mosaics:
        model.metadata["cells"] = misses.total.sum(1).tolist()
    saved, landing = _fit_to_search(config, sampler, model) if config.method == "search" else (model, "")
    path = model_path(config, sampler.eye.detector.name)
    saved.save(path)
    models = {"raw scores": FovealObservationModel.identity(classes, edges).eval()}
    methods: tuple[Method, ...] = ("newton", "fixed_point", "gradient")
    for method in methods:
        models[f"Dirichlet, {method}"] = published(method=method)
    models["Dirichlet with class prior"] = published(prior=True)
    models["the same, tempered 0.1"] = published(prior=True, tempering=0.1)
    if config.method in ("discriminative", "search"):
        models["discriminative"] = model
    written = _write_report(config, model, models, samples[held_out], landing)
    print("written:")
    for file in [path, *written]:
        print(f"  {file}")


main = command(fit_fom, FitFomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
