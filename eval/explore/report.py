"""Output of an exploration run: the share of rightly named cells after each gaze shift, counted in three ways."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from eval.comparison.report_page import write_run_report
from eval.comparison.summary import (
    LAST_COLUMN,
    Curve,
    announce,
    collect_records,
    curve_of,
    curve_rows,
    curves_csv,
    sensing,
    write_files,
)
from eval.explore.run import ExploreRun
from semfov.errors import DataError
from semfov.metrics.episodes import FloatArray
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.viz.style import save_figure

_EXPLORATION_SHIFTS = (0, 1, 2, 3, 4, 5, 10, 20)
"""Gaze shifts at which tables show the success rate."""

_ANSWERS = {
    "all classes": ("right", "as published: the answer is the most probable class, background included"),
    "without background": ("right_without_background", "the answer is the most probable class other than background"),
    "whole grid": ("right_everywhere", "all cells count: background is right where there is no object"),
}
"""Ways to count answers: the field of the records, and a description."""


def exploration_report(run: ExploreRun, *, pictures: bool = True) -> None:
    """Write all output of a finished run, or all but its figures and its page, and print the tables."""
    records, seconds = collect_records(run)
    if not records:
        raise DataError("data: no scene has an object; lower data.min_instances or raise data.limit")
    # The reference of one unfoveated pass comes after the policies.
    names = dict.fromkeys([*run.policies, *(record["policy"] for record in records)])
    curves = {answer: success(records, list(names), answer) for answer in _ANSWERS}
    summary = _exploration_summary(curves, run.config.protocol.shifts, sensing(run))
    tables = {"summary.md": summary, "summary.csv": curves_csv(curves, ("answers", "success_rate"))}
    written = write_files(run, "eval.explore", tables, records, seconds)
    if pictures:
        written += [_draw_exploration_curves(run, curves[answer], answer) for answer in _ANSWERS]
        written.append(
            write_run_report(
                run,
                records,
                curves,
                titles={name: title for name, (_, title) in _ANSWERS.items()},
                label="cells with the right class (%)",
                shifts=_EXPLORATION_SHIFTS,
            )
        )
    announce(summary, written)


def success(records: list[ResultRecord], policies: Sequence[str], answer: str) -> dict[str, Curve]:
    """Success rate of each policy after each gaze shift."""
    measure = partial(_rate, field=_ANSWERS[answer][0])
    return {policy: curve_of((r for r in records if r["policy"] == policy), measure) for policy in policies}


def _rate(record: ResultRecord, field: str) -> FloatArray:
    return np.asarray(record[field]) / record["grid_cells" if field == "right_everywhere" else "object_cells"]


def _exploration_summary(curves: dict[str, dict[str, Curve]], last: int, sensing: str) -> str:
    """Write the tables that the run prints: success rates with standard errors over images."""
    shifts = [n for n in _EXPLORATION_SHIFTS if n <= last]
    head = ["policy", *(str(n) for n in shifts), LAST_COLUMN]
    lines = []
    for answer, policies in curves.items():
        first = next(iter(policies.values()))
        lines += [
            f"**{_ANSWERS[answer][1]}** ({sensing}; {first.images} images, {first.episodes} explorations per policy; "
            "percentage of cells with a right answer after n gaze shifts, among the cells with objects unless all "
            "cells count, ± standard error over images)",
            "",
            *table([head, *curve_rows(policies, shifts)]),
            "",
        ]
    return "\n".join(lines)


def _draw_exploration_curves(run: ExploreRun, curves: dict[str, Curve], answer: str) -> Path:
    """Draw the success rate against gaze shifts."""
    from semfov.viz import plot_curves

    figure = plot_curves(
        {name: curve.mean for name, curve in curves.items()},
        {name: curve.over_images for name, curve in curves.items()},
        label="cells with the right class (%)",
        title=f"Exploration, {answer}\n{sensing(run)}",
    )
    return save_figure(figure, run.config.out / f"success_rate_{answer.replace(' ', '_')}.png")
