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
from collections.abc import Mapping, Sequence
from typing import get_args

import torch

from semfov.errors import check
from semfov.fit.photographs import fit_photographs
from semfov.fit.training import training_of
from semfov.fit.windows_certainty import explorations_of_kinds, spread_again
from semfov.fit.windows_evidence import (
    SurveyExample,
    Windows,
    ZoomExample,
    fit_presence,
    judge_windows,
    pair_windows,
    presence_loss,
)
from semfov.io.files import inside
from semfov.runs.command import command
from semfov.runs.setup import make_scenes
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker
from semfov.zoom.evidence import GlimpseEvidence, Survey
from train.outputs import write_outputs
from train.zoom_choice import choose_foresight, choose_patience
from train.zoom_pictures import PICTURE_KINDS, FitZoomConfig, PicturesFit, RefitPart

_FURTHER = 1e-3
"""Highest learning rate of a prediction that is fitted further."""

_JUDGED = ("judged", "judged far", "judged crowded")
"""Mosaics of held-out photographs on which foresight is chosen."""


def fit_zoom(config: FitZoomConfig) -> None:
    """Look at mosaics, fit, evaluate on held-out photographs, and write the model and a report."""
    fit = PicturesFit(config)
    lines, figures = list[str](), "{}"
    check(len(config.refit) > 0, "refit", "at least one part of the model", config.refit)
    refit: set[RefitPart] = set(config.refit) if config.evidence else {*get_args(RefitPart)}
    looked: list[str] = ["near", "far", "judged"] * bool(refit & {"presence", "survey"})
    looked += ["crowded", "judged crowded"] * ("survey" in refit)
    looked += [*config.kinds] * ("presence" in refit)
    looked += [f"judged {kind}" for kind in PICTURE_KINDS] * ("presence" in refit and config.evidence is not None)
    examples = fit.look(looked)
    if config.evidence is None:
        model = fit.closer(examples)
        text, figures = judge_windows(model, examples["judged"])
        tried = choose_patience(model, fit)
        lines += [text, f"Patience chosen for the search: {model.patience:g}.", "", *table(tried), ""]
    else:
        model = GlimpseEvidence.from_pretrained(config.evidence).requires_grad_(False)
        model.check_compatible(fit.eye.settings())
        if "presence" in refit:
            lines += _fit_further(config, model, examples)
    if "survey" in refit:
        fit.survey(model, examples)
        held = {"": examples["judged"], ", crowded": examples["judged crowded"]}
        measured = {
            name: value for each in held for name, value in judge_survey(model.survey, held[each], each).items()
        }
        figures = json.dumps({**json.loads(figures), **measured}, indent=1)
        tried = choose_foresight(model, fit, _JUDGED)
        chosen = f"Foresight chosen for finding all objects: {model.survey.foresight:g}."
        rows = ([name, f"{value:.4f}"] for name, value in measured.items())
        lines += [*table([["measure", "value"], *rows]), "", chosen, "", *table(tried), ""]
    if "decision" in refit:
        lines += fit.decisions(model)
        # A verification belongs to the probability that it was fitted with.
        model.verification = None
        model.metadata.pop("verification", None)
    if "verification" in refit:
        check(model.thresholds is not None, "evidence", "a model whose decisions were fitted", config.evidence)
        lines += fit.verification(model)
    if "certainty" in refit:
        lines += fit.certainty(model)
    elif "spread" in refit:
        check(model.certainty is not None, "evidence", "a model whose certainty was fitted", config.evidence)
        prepare_worker()
        lines += spread_again(model, explorations_of_kinds(model, fit.explored()[0], config.passes), config.passes)
    if "photograph" in refit and config.photographs:
        scenes = make_scenes(config.data, fit.eye.detector.classes)
        lines += ["Photographs:", "", fit_photographs(model, scenes, fit.eye, config)]
    settings = training_of(config, fit.mosaics["near"])["training"]
    model.metadata |= {part: settings for part in refit if part != "photograph"}
    path = inside(config.out, f"{fit.eye.detector.name}.safetensors")
    model.save(path)
    write_outputs(config, "\n".join(lines), ("figures.json", figures), path)


@torch.no_grad()
def judge_survey(survey: Survey, examples: Sequence[ZoomExample], where: str = "") -> dict[str, float]:
    """Mean loss on mosaics that were held out, by the overview and by closer looks."""
    name = "objects of any class, mean negative log likelihood"
    first, later = [], []
    for example in map(SurveyExample.of, examples):
        overview, *closer = example.losses(survey, example.closer)
        first.append(overview)
        later += closer
    figures = {f"{name}, overview{where}": float(torch.stack(first).mean())}
    if later:
        figures[f"{name}, closer looks{where}"] = float(torch.stack(later).mean())
    return figures


def _fit_further(config: FitZoomConfig, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> list[str]:
    """Fit the prediction whether a closer look shows a class further from where it is, more slowly."""
    torch.manual_seed(config.seed)
    judged = {kind: pair_windows(some) for kind, some in examples.items() if some and kind.startswith("judged")}
    before = {kind: _cross_entropies(model, windows) for kind, windows in judged.items()}
    looks = [each for kind in ("near", "far", *config.kinds) for each in examples[kind]]
    fit_presence(model.requires_grad_(True), pair_windows(looks), config.steps, rate=_FURTHER)
    model.requires_grad_(False)
    rows = [["", "overview, before", "after", "closer looks, before", "after"]]
    for kind, windows in judged.items():
        pairs = zip(before[kind], _cross_entropies(model, windows), strict=True)
        rows.append([kind, *(f"{each:.4f}" for pair in pairs for each in pair)])
    return ["Cross-entropy of whether a closer look shows a class, by kind of picture:", "", *table(rows), ""]


@torch.no_grad()
def _cross_entropies(model: GlimpseEvidence, windows: Windows) -> tuple[float, float]:
    """The cross-entropy of whether a closer look shows a class, by overviews and by closer looks (NaN without any)."""
    rows = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    first, later = (float(presence_loss(model, windows, some)) if len(some) else float("nan") for some in rows)
    return first, later


main = command(fit_zoom, FitZoomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
