"""The report on a fitted observation model: measures on held-out photographs, counts, and a reliability diagram."""

import csv
import io
import json
import platform
import sys
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path

import torch
import yaml
from torch import Tensor

from semfov.fit.observation_settings import FitObservationConfig
from semfov.io.code import commit
from semfov.io.files import write_text
from semfov.metrics.calibration import Calibration, calibration
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.samples import Samples
from semfov.runs.setup import plain
from semfov.runs.tables import table
from semfov.version import __version__
from semfov.viz import plot_reliability
from semfov.viz.style import save_figure

_Models = dict[str, FovealObservationModel]


def write_report(
    config: FitObservationConfig,
    model: FovealObservationModel,
    models: _Models,
    samples: Samples,
    held_out: torch.Tensor,
) -> list[Path]:
    """Evaluate the models on held-out samples, print the tables, and write the report.

    Args:
        config: the settings.
        model: the fitted model.
        models: all models to compare, the fitted one last.
        samples: all labelled detections.
        held_out: `(M,)` boolean, which of them are held out.

    Returns:
        The files that were written.
    """
    judged = samples[held_out]
    with torch.inference_mode():
        predictions = {name: m.calibrate(judged.scores, judged.distance) for name, m in models.items()}
        likelihood = {
            name: float(m.log_likelihood(judged.scores, judged.distance).gather(1, judged.labels[:, None]).mean())
            for name, m in models.items()
        }
    figures = {name: calibration(p, judged.labels) for name, p in predictions.items()}
    by_level = figures_by_level(model, predictions, judged)
    text = report_markdown(config, model, figures, likelihood, by_level, len(samples) - len(judged))
    print(text)
    write_text(config.out / "report.md", text)
    write_text(config.out / "config.yaml", yaml.safe_dump(plain(asdict(config)), sort_keys=False))
    write_text(config.out / "manifest.json", json.dumps(fit_manifest(model, figures), indent=2) + "\n")
    last = list(models)[-1]
    write_text(config.out / "counts.csv", counts_csv(model))
    figure = plot_reliability({name: (predictions[name], judged.labels) for name in ("raw scores", last)})
    names = ["report.md", "counts.csv", "config.yaml", "manifest.json"]
    return [*(config.out / name for name in names), save_figure(figure, config.out / "reliability.png")]


def report_markdown(
    config: FitObservationConfig,
    model: FovealObservationModel,
    figures: dict[str, Calibration],
    likelihood: dict[str, float],
    by_level: list[list[str]],
    fitted: int,
) -> str:
    """Write the report as Markdown: the measures of each model, then counts and measures by level.

    Args:
        config: the settings.
        model: the fitted model.
        figures: calibration of each model on the held-out samples.
        likelihood: mean log likelihood of the held-out scores under each model.
        by_level: cells of the table by level (`figures_by_level`).
        fitted: number of samples to fit on.

    Returns:
        The text.
    """
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


def figures_by_level(model: FovealObservationModel, predictions: dict[str, Tensor], judged: Samples) -> list[list[str]]:
    """Compute NLL and ECE of raw scores and of the fitted model at each level.

    Args:
        model: the fitted model.
        predictions: class probabilities `(M, K+1)` of each model, raw scores first and the fitted model last.
        judged: the held-out samples.

    Returns:
        Cells of a table, one row for each level.
    """
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


def counts_csv(model: FovealObservationModel) -> str:
    """Write the number of detections of each true class at each level in the fit as CSV."""
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["class", *(f"level {n}" for n in range(len(model.edges) + 1))])
    for name, counts in zip(("background", *model.classes), model.metadata["counts"], strict=True):
        rows.writerow([name, *counts])
    return text.getvalue()


def fit_manifest(model: FovealObservationModel, figures: dict[str, Calibration]) -> dict[str, object]:
    """Record the command, the commit, the versions and the model that the measures come from."""
    known = {key: value for key, value in model.metadata.items() if key != "counts"}
    return {
        "command": ["python", "-m", "train.fit_fom", *sys.argv[1:]],
        "commit": commit(),
        "versions": {"semfov": __version__, "python": platform.python_version(), "torch": torch.__version__},
        "model": known,
        "held_out": {name: asdict(figure) for name, figure in figures.items()},
    }
