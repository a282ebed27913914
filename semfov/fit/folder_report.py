"""The report of a model folder: which parts are used and why, what was measured, and which classes are rare."""

from collections.abc import Iterable, Mapping

import torch

from semfov.fit.part import PartInputs
from semfov.runs.looking import Looking
from semfov.runs.tables import table

_TITLES = {
    "observation": "Observation model (scores of detections)",
    "search": "Search model (searches)",
    "verification": "Verification (closer looks)",
    "windows": "Evidence by magnification (large pictures)",
}
"""Titles of the parts in reports."""

_UNUSED = {"verification": "no, no closer looks", "windows": "no, slices in the order of raw scores"}
"""What the agent does without a part that it does not use, other than to use raw scores."""

_FEW = 10  # with fewer held-out photographs, figures are rough


def class_counts(run: Looking, scenes: Iterable[int]) -> dict[str, int]:
    """Count the objects of each class in the photographs with the given numbers."""
    count = torch.zeros(len(run.scenes.classes) + 1, dtype=torch.int64)
    for index in scenes:
        count += torch.bincount(run.scenes.annotation(index).labels, minlength=len(count))
    return dict(zip(run.scenes.classes, count[1:].tolist(), strict=True))


def folder_report(inputs: PartInputs, seconds: float) -> str:
    """Report on all parts of a folder.

    Args:
        inputs: the photographs, and the parts that are finished.
        seconds: how long the fit took.

    Returns:
        The report in Markdown.
    """
    config = inputs.config
    run = inputs.run
    counts = class_counts(run, inputs.training)
    lines = [
        f"# Models of {run.eye.detector.name}",
        "",
        f"{len(run.scenes)} photographs, {len(inputs.held_out)} of them held out (one in {config.holdout}); "
        f"{len(counts)} classes; {config.columns} × {config.rows} cells; "
        f"sensor {config.sensor.name}; {seconds / 60:.1f} minutes in this run.",
        "",
        "The agent uses a part only if it is better than raw scores by more than one standard error of the paired "
        "difference over the held-out photographs. The verification is compared with the same agent without closer "
        "looks, and the evidence by magnification with looks at slices of large pictures in the order of raw scores. "
        "The semantic map takes calibrated or raw scores, whichever tell better what cells hold.",
        "",
        *table(_part_rows(inputs)),
        "",
        *thin_classes(counts, config.thin),
        *_roughness(len(inputs.held_out)),
    ]
    for name, fitted in inputs.results.items():
        lines += [f"## {_TITLES[name]}", "", fitted.report, ""]
        for figure in fitted.figures:
            lines += [f"![{figure}]({figure})", ""]
    return "\n".join(lines)


def _part_rows(inputs: PartInputs) -> list[list[str]]:
    """Make rows of a table of the parts."""
    rows = [["part", "used", "result on held-out photographs"]]
    for name, fitted in inputs.results.items():
        used = "yes" if fitted.part.used else _UNUSED.get(name, "no, raw")
        rows.append([_TITLES[name], used, fitted.part.why])
        if "map" in fitted.part.settings:
            of_map = fitted.part.settings["map"]
            rows.append(["Semantic map (explorations)", f"yes, {of_map['scores']} scores", of_map["why"]])
    return rows


def thin_classes(counts: Mapping[str, int], thin: int) -> list[str]:
    """Write warnings about classes with few objects to learn from.

    Args:
        counts: number of objects of each class.
        thin: number of objects below which a class is named.

    Returns:
        Lines of Markdown; none where all classes have enough.
    """
    classes = {
        "No object": [name for name, count in counts.items() if count == 0],
        f"Fewer than {thin} objects": [f"{name} {count}" for name, count in counts.items() if 0 < count < thin],
    }
    lines: list[str] = []
    for words, names in classes.items():
        if names:
            lines += [f"**{words} to learn from** ({len(names)} classes): {', '.join(names)}.", ""]
    if lines:
        lines += [
            "The search model and the semantic map have a few numbers each, the same for all classes. The observation "
            "model changes the scores of a class without examples very little.",
            "",
        ]
    return lines


def _roughness(held_out: int) -> list[str]:
    """Say, in lines of Markdown, whether the figures are rough."""
    if held_out >= _FEW:
        return []
    number = "only 1 photograph" if held_out == 1 else f"only {held_out} photographs"
    return [f"The figures are rough, because {number} could be held out.", ""]
