"""Fit evidence by magnification: `python -m train.fit_zoom` learns where closer looks find objects.

    python -m train.fit_zoom --data.root DIR --data.annotations instances.json --out runs/fit_zoom

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at mosaics of 4 × 4 and of 8 × 6 photographs and at other kinds of pictures that are composed of
photographs (`kinds`), in windows at steps of half a window and at all magnifications. The model learns to predict the
results of closer looks from coarser looks at the same place. The folder `out` gets the model (`<name>.safetensors`),
and a report that evaluates it on mosaics of held-out photographs. If the looking is interrupted, repeat the command to
continue.
"""

import json
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import get_args

import torch

from semfov.errors import check
from semfov.fit.photographs import fit_photographs
from semfov.fit.training import training_of
from semfov.fit.windows_certainty import explorations_of_kinds, spread_again
from semfov.fit.windows_evidence import SurveyExample, ZoomExample, judge_windows
from semfov.io.files import inside
from semfov.runs.command import command
from semfov.runs.setup import make_scenes
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.survey import Survey
from train.outputs import write_outputs
from train.zoom_choice import choose_foresight
from train.zoom_pictures import FitZoomConfig, PicturesFit, RefitPart

_JUDGED = ("judged", "judged far", "judged crowded")
"""Mosaics of held-out photographs on which foresight is chosen."""


def fit_zoom(config: FitZoomConfig) -> None:
    """Look at mosaics, fit, evaluate on held-out photographs, and write the model and a report."""
    check(len(config.refit) > 0, "refit", "at least one part of the model", config.refit)
    fit = PicturesFit(config)
    parts: set[RefitPart] = set(config.refit) if config.evidence else {*get_args(RefitPart)}
    examples = fit.look(_looked_at(config, parts))
    report = _Report()
    model = _start(config, fit, examples, report)
    if "survey" in parts:
        _fit_survey(fit, model, examples, report)
    if "decision" in parts:
        report.lines += fit.fit_decisions(model)
        # A verification belongs to the probability that it was fitted with.
        model.verification = None
        model.metadata.pop("verification", None)
    if "verification" in parts:
        check(model.thresholds is not None, "evidence", "a model whose decisions were fitted", config.evidence)
        report.lines += fit.fit_verification(model)
    if "certainty" in parts:
        report.lines += fit.fit_certainty(model)
    elif "spread" in parts:
        check(model.certainty is not None, "evidence", "a model whose certainty was fitted", config.evidence)
        prepare_worker()
        fitted, _ = fit.explored_pictures()
        report.lines += spread_again(model, explorations_of_kinds(model, fitted, config.passes), config.passes)
    if "photograph" in parts and config.photographs:
        scenes = make_scenes(config.data, fit.eye.detector.classes)
        report.lines += ["Photographs:", "", fit_photographs(model, scenes, fit.eye, config)]
    settings = training_of(config, fit.mosaics["near"])["training"]
    # The evidence for photographs notes its own metadata.
    model.metadata |= {part: settings for part in parts if part != "photograph"}
    path = inside(config.out, f"{fit.eye.detector.name}.safetensors")
    model.save(path)
    write_outputs(config, "\n".join(report.lines), ("figures.json", report.figures), path)


@dataclass
class _Report:
    """The report of a fit, as far as it is written.

    Attributes:
        lines: lines of Markdown.
        figures: the measures as JSON.
    """

    lines: list[str] = field(default_factory=list)
    figures: str = "{}"


def _looked_at(config: FitZoomConfig, parts: Collection[RefitPart]) -> list[str]:
    """List the kinds of pictures that must be looked at to fit some parts."""
    kinds: list[str] = []
    if config.evidence is None or "survey" in parts:
        kinds += ["near", "far", "judged"]
    if "survey" in parts:
        kinds += ["crowded", "judged crowded"]
    if config.evidence is None:
        kinds += config.kinds
    return kinds


def _start(
    config: FitZoomConfig,
    fit: PicturesFit,
    examples: Mapping[str, list[ZoomExample]],
    report: _Report,
) -> GlimpseEvidence:
    """Fit the prediction of closer looks, or read a model that was fitted before."""
    if config.evidence is None:
        model = fit.fit_prediction(examples)
        text, report.figures = judge_windows(model, examples["judged"])
        report.lines += [text]
        return model
    model = GlimpseEvidence.from_pretrained(config.evidence).requires_grad_(False)
    model.check_compatible(fit.eye.settings())
    return model


def _fit_survey(
    fit: PicturesFit, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]], report: _Report
) -> None:
    """Fit the numbers of objects of any class, evaluate them, and choose the foresight of the search."""
    fit.fit_survey(model, examples)
    measures = judge_survey(model.survey, examples["judged"])
    measures |= judge_survey(model.survey, examples["judged crowded"], ", crowded")
    report.figures = json.dumps({**json.loads(report.figures), **measures}, indent=1)
    tried = choose_foresight(model, fit, _JUDGED)
    rows = [["measure", "value"], *([name, f"{value:.4f}"] for name, value in measures.items())]
    report.lines += [
        *table(rows),
        "",
        f"Foresight chosen for finding all objects: {model.survey.foresight:g}.",
        "",
        *table(tried),
        "",
    ]


@torch.no_grad()
def judge_survey(survey: Survey, examples: Sequence[ZoomExample], where: str = "") -> dict[str, float]:
    """Average the losses on mosaics that were held out, by the overview and by closer looks.

    Args:
        survey: predicts the numbers of objects of any class.
        examples: the mosaics.
        where: what is added to the names of the measures.

    Returns:
        The measures by name.
    """
    name = "objects of any class, mean negative log likelihood"
    of_overviews = []
    of_closer_looks = []
    for example in map(SurveyExample.of, examples):
        overview, *closer = example.losses(survey, example.closer)
        of_overviews.append(overview)
        of_closer_looks += closer
    figures = {f"{name}, overview{where}": float(torch.stack(of_overviews).mean())}
    if of_closer_looks:
        figures[f"{name}, closer looks{where}"] = float(torch.stack(of_closer_looks).mean())
    return figures


main = command(fit_zoom, FitZoomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
