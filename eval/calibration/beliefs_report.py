"""Output of a run that evaluates the calibration of beliefs: tables, sums, and a reliability diagram."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from eval.calibration.beliefs import BANDS, CELL_GROUPS, MAP, BeliefCalibrationRun
from eval.calibration.cell_figure import plot_cell_reliability
from eval.calibration.sums import AddedSums
from eval.comparison.records import gather
from eval.comparison.summary import MANIFEST, manifest, sensing, write_texts
from eval.decide.run import LANDINGS, LANDINGS_TEXT, landing_cells
from semfov.errors import DataError
from semfov.io.tables import csv_text
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.viz.style import save_figure

_Sums = dict[tuple[str, int, str], AddedSums]
"""Sums over predictions by belief, number of looks, and group of cells."""

_HEAD = ("NLL", "Brier", "ECE", "mean probability", "share that hold it")


def write_belief_report(run: BeliefCalibrationRun) -> tuple[str, list[Path]]:
    """Write the tables, the sums and the figure of a finished run."""
    stored = gather(run)
    records = [*stored]
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise target_area")
    sums = _add_up(records)
    text = _beliefs_summary(records, sums, run)
    files = {"beliefs.md": text, "beliefs.csv": _beliefs_csv(sums), "beliefs.json": _beliefs_json(sums)}
    files[MANIFEST] = manifest(run, "eval.calibration", stored.seconds)
    written = write_texts(run.config.out, files)
    groups = (
        f"distance from the closest fixation, as a fraction of the longer side, after {_judged_after(sums)[-1]} looks"
    )
    figure = save_figure(plot_cell_reliability(*_curves(sums), groups=groups), run.config.out / "beliefs.png")
    return text, [*written, figure]


def _add_up(records: Iterable[ResultRecord]) -> _Sums:
    """Add up the sums of all searches."""
    sums: _Sums = defaultdict(AddedSums.nothing)
    for record in records:
        for belief, measures in record["beliefs"].items():
            for looks, groups in measures["looks"].items():
                for group, values in groups.items():
                    sums[belief, int(looks), group] += AddedSums.from_record(values)
    return dict(sums)


def _pooled(sums: _Sums, belief: str, looks: int) -> AddedSums:
    """Compute sums over all cells, whatever their group."""
    total = AddedSums.nothing()
    for group in CELL_GROUPS:
        if (belief, looks, group) in sums:
            total = total + sums[belief, looks, group]
    return total


def _beliefs_summary(records: Sequence[ResultRecord], sums: _Sums, run: BeliefCalibrationRun) -> str:
    """Write the tables, as Markdown."""
    beliefs = list(run.observers)
    there = sum(record["present"] for record in records)
    last = _judged_after(sums)[-1]
    cells = _pooled(sums, beliefs[0], last)
    holds = torch.arange(cells.count) < cells.bins[2].sum()  # as many cells as hold the target
    constant = AddedSums.of(torch.full((cells.count,), cells.rate), holds)
    return "\n".join(
        [
            f"Does a cell hold the target? {len(records)} searches ({sensing(run)}), {there} of them for a class that "
            f"is present. The {run.guide} belief guides the gaze, which does not stop at the target; all beliefs are "
            f"updated with the same looks. A constant prediction of {cells.rate:.4f}, the share of cells that hold the "
            f"target, would have an NLL of {constant.nll:.4f}, a Brier score of {constant.brier:.4f} and an ECE of 0.",
            "",
            *table(_rows_by_looks(sums, beliefs)),
            "",
            f"After {last} looks, by distance from the closest fixation, as a fraction of the image's longer side; "
            "fixated cells are a group of their own.",
            "",
            *table(_rows_by_distance(sums, beliefs, last)),
            "",
            LANDINGS_TEXT,
            "",
            *table([["belief", *LANDINGS], *_landing_table(records)]),
            "",
            *_notes(run),
        ]
    )


def _rows_by_looks(sums: _Sums, beliefs: Sequence[str]) -> list[list[str]]:
    """Write the rows of the table of all cells, by number of looks."""
    rows = [["looks", "belief", "cells", *_HEAD]]
    for looks in _judged_after(sums):
        rows += [[str(looks), belief, *_measures_row(_pooled(sums, belief, looks))] for belief in beliefs]
    return rows


def _rows_by_distance(sums: _Sums, beliefs: Sequence[str], looks: int) -> list[list[str]]:
    """Write the rows of the table after a number of looks, by group of cells."""
    rows = [["distance", "belief", "cells", *_HEAD]]
    for group in CELL_GROUPS:
        with_group = [belief for belief in beliefs if (belief, looks, group) in sums]
        rows += [[group, belief, *_measures_row(sums[belief, looks, group])] for belief in with_group]
    return rows


def _notes(run: BeliefCalibrationRun) -> list[str]:
    """Say which beliefs are left out, and what is known of the others; each note is followed by an empty line."""
    lines: list[str] = []
    for name, reason in run.left_out.items():
        lines += [f"Left out because no fitted model is shipped: {name} ({reason}).", ""]
    if MAP in run.observers:
        lines += [
            f"The {MAP} assumes that classes are as frequent as they are in photographs. Here half of the target "
            "classes are present, so its probabilities are expected to be too low.",
            "",
        ]
    return lines


def _judged_after(sums: _Sums) -> list[int]:
    """Return the numbers of looks for which there are sums."""
    return sorted({looks for _, looks, _ in sums})


def _measures_row(sums: AddedSums) -> list[str]:
    """Write the number of cells and the measures as cells of a table row."""
    measures = (sums.nll, sums.brier, sums.ece, sums.probability, sums.rate)
    return [str(sums.count), *(f"{measure:.4f}" for measure in measures)]


def _landing_table(records: Sequence[ResultRecord]) -> list[list[str]]:
    """Write the rows of the table about the first look on the target (`landing`)."""
    landed = [record for record in records if record["seen"] is not None]
    rows = []
    for belief in records[0]["beliefs"]:
        landings = [(record["beliefs"][belief]["landing"], record["seen"]) for record in landed]
        rows.append([belief, *landing_cells(landings)])
    return rows


def _beliefs_csv(sums: _Sums) -> str:
    """Write all measures as CSV: a row for each belief, number of looks and group of cells."""
    rows: list[list[object]] = [
        ["belief", "looks", "cells", "count", "nll", "brier", "ece", "mean_probability", "rate"]
    ]
    for belief, looks, group, of_group in _sums_by_name(sums):
        measures = (of_group.nll, of_group.brier, of_group.ece, of_group.probability, of_group.rate)
        rows.append([belief, looks, group, of_group.count, *(f"{measure:.6f}" for measure in measures)])
    return csv_text(rows)


def _beliefs_json(sums: _Sums) -> str:
    """All sums as JSON; the sums of several runs may be added up (`AddedSums.from_record`)."""
    entries = [
        {"belief": belief, "looks": looks, "cells": group, **of_group.record()}
        for belief, looks, group, of_group in _sums_by_name(sums)
    ]
    return json.dumps({"edges": AddedSums.EDGES.tolist(), "bands": BANDS, "sums": entries}) + "\n"


def _sums_by_name(sums: _Sums) -> Iterator[tuple[str, int, str, AddedSums]]:
    """Sum by belief, number of looks and group of cells; the sum over all cells comes before the groups."""
    for belief, looks in dict.fromkeys((belief, looks) for belief, looks, _ in sums):
        yield belief, looks, "all", _pooled(sums, belief, looks)
        for group in CELL_GROUPS:
            if (belief, looks, group) in sums:
                yield belief, looks, group, sums[belief, looks, group]


def _curves(sums: _Sums) -> tuple[dict[str, dict[str, Tensor]], dict[str, dict[str, float]]]:
    """Collect the arguments of `plot_cell_reliability`."""
    beliefs = list(dict.fromkeys(belief for belief, _, _ in sums))
    panels: dict[str, dict[str, Tensor]] = {}
    for looks in _judged_after(sums):
        title = f"after {looks} looks" if looks > 1 else "after 1 look"
        panels[title] = {belief: _pooled(sums, belief, looks).bins for belief in beliefs}
    last = _judged_after(sums)[-1]
    errors: dict[str, dict[str, float]] = {}
    for belief in beliefs:
        groups = [group for group in CELL_GROUPS if (belief, last, group) in sums]
        errors[belief] = {group: sums[belief, last, group].ece for group in groups}
    return panels, errors
