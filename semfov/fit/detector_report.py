"""The report about all models that were fitted to a detector: its text, tables and plots."""

from __future__ import annotations

from os import fspath
from typing import Any

import torch

from semfov.fit.comparison import Difference
from semfov.fit.parts.base import PartResult
from semfov.fit.settings import FitDetectorConfig
from semfov.gaze.policies import Task
from semfov.metrics.averages import FloatArray, standard_error
from semfov.runs.looking import Looking
from semfov.runs.tables import percent, plus_minus, table


def in_words(gain: Difference, unit: str, scale: float = 1.0) -> str:
    """Format a paired difference, times `scale`, with its unit, its standard error and its number of photographs."""
    digits = 1 if scale > 1 else 3
    return (
        f"{plus_minus(scale * gain.mean, scale * gain.error, digits, sign='+')} {unit} "
        f"on {gain.photographs} held-out photograph{'s' if gain.photographs != 1 else ''}"
    )


def mean_percent(values: FloatArray) -> str:
    """Format the mean of shares `(P,)` in percent, with its standard error."""
    return percent(float(values.mean()), float(standard_error(values)))


def percent_of(value: float) -> str:
    """Format a share in percent."""
    return f"{100 * value:.1f}"


def section(text: str, rows: list[list[str]]) -> str:
    """Return a paragraph of Markdown, followed by a table if there are rows."""
    return "\n".join([text, "", *(table(rows) if rows else []), *([""] if rows else [])])


def curves_figure(curves: dict[str, FloatArray], task: Task) -> Any:
    """Plot the means of curves `(P, shifts+1)` over photographs, with their standard errors."""
    from semfov.viz import plot_cumulative_performance, plot_success_rate

    means = {name: curve.mean(0) for name, curve in curves.items()}
    errors = {name: standard_error(curve) for name, curve in curves.items()}
    title = f"Held-out photographs ({len(curves['raw'])})"
    plot = plot_cumulative_performance if task == "search" else plot_success_rate
    return plot(means, errors, title=title)


_TITLES = {
    "observation": "Observation model",
    "tempering": "Tempering",
    "evidence": "Target evidence (searches)",
    "verification": "Verification (closer looks)",
    "map": "Learned map (explorations)",
    "windows": "Evidence by magnification (large pictures)",
}
"""Titles of the parts in reports."""

_UNUSED = {"verification": "no, no closer looks", "windows": "no, slices in the order of raw scores"}
"""What the agent does without a part that it does not use, other than to use raw scores."""


def class_counts(run: Looking, scenes: Any) -> dict[str, int]:
    """Count the objects of each class in the photographs with the given indices."""
    count = torch.zeros(len(run.scenes.classes) + 1, dtype=torch.int64)
    for index in scenes:
        count += torch.bincount(run.scenes.annotation(index).labels, minlength=len(count))
    return dict(zip(run.scenes.classes, count[1:].tolist(), strict=True))


def detector_report(config: FitDetectorConfig, run: Looking, results: dict[str, PartResult], seconds: float) -> str:
    """Write the report as Markdown."""
    photographs = len(run.scenes)
    holdout = config.holdout or 5
    held_out = [index for index in range(photographs) if index % holdout == 0]
    counts = class_counts(run, (index for index in range(photographs) if index % holdout))
    rows = [["part", "used", "result on held-out photographs"]]
    rows += [
        [_TITLES[name], "yes" if each.part.used else _UNUSED.get(name, "no, raw"), each.part.why]
        for name, each in results.items()
    ]
    lines = [
        f"# Models of {run.eye.detector.name}",
        "",
        f"{photographs} photographs, {len(held_out)} of them held out (one in {holdout}); "
        f"{len(counts)} classes; {config.columns} × {config.rows} cells; "
        f"sensor {config.sensor.name}; {seconds / 60:.1f} minutes in this run.",
        "",
        "The agent uses a part only if it is better than raw scores by more than one standard error of the paired "
        "difference over the held-out photographs. The verification is compared with the same agent without closer "
        "looks, and the evidence by magnification with looks at slices of large pictures in the order of raw scores.",
        "",
        *table(rows),
        "",
        *_thin_classes(counts, config.thin),
    ]
    if len(held_out) < 10:
        number = "only 1 photograph" if len(held_out) == 1 else f"only {len(held_out)} photographs"
        lines += [f"The figures are rough, because {number} could be held out.", ""]
    for name, fitted in results.items():
        lines += [f"## {_TITLES[name]}", "", fitted.report, ""]
        lines += [line for figure in fitted.figures for line in (f"![{figure}]({figure})", "")]
    return "\n".join(lines)


def _thin_classes(counts: dict[str, int], thin: int) -> list[str]:
    """Write warnings, as lines of Markdown, about classes with fewer than `thin` objects to learn from."""
    none = [name for name, count in counts.items() if count == 0]
    few = [f"{name} {count}" for name, count in counts.items() if 0 < count < thin]
    lines = []
    if none:
        lines += [f"**No object to learn from** ({len(none)} classes): {', '.join(none)}.", ""]
    if few:
        lines += [f"**Fewer than {thin} objects to learn from** ({len(few)} classes): {', '.join(few)}.", ""]
    if lines:
        lines += [
            "The target evidence and the map process the scores of all classes with one network; only one number per "
            "class, its frequency, is separate. The observation model changes the scores of a class without examples "
            "very little.",
            "",
        ]
    return lines


def next_commands(config: FitDetectorConfig, run: Looking) -> str:
    """Return example commands that use the model folder."""
    out = fspath(config.out)
    target = max(class_counts(run, range(len(run.scenes))).items(), key=lambda pair: pair[1])[0]
    quoted = f'"{target}"' if " " in target else target
    return "\n".join(
        [
            f"  semfov search PHOTO.jpg --target {quoted} --models {out}",
            f"  semfov find PHOTOS --target {quoted} --models {out} --out found.csv",
        ]
    )
