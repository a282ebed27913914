"""Tables of the pages of results, made from the output of the runs."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from eval.page import paper
from eval.page.curves import averaged, paired_difference, points, policies_of, records_of
from eval.page.experiments import DETECTORS, FOVEAE, SENSITIVITY, SENSITIVITY_POLICY, Experiment
from semfov.runs.tables import percent, table

Runs = dict[str, Experiment]

_SENSITIVITY_SHIFTS = (1, 5, 30)
"""Gaze shifts after which the study of settings is shown."""


def published(kind: str) -> dict[str, str]:
    """Names of the published experiments of a kind, by column heading."""
    return {
        f"{title}, {width}": f"{kind}-{fovea}-{name}"
        for name, title in DETECTORS.items()
        for fovea, width in FOVEAE.items()
    }


def published_columns(kind: str, runs: Runs) -> dict[str, Path]:
    """Folders of the published experiments of a kind, by column heading."""
    return {heading: runs[name].out for heading, name in published(kind).items()}


def beside_paper(runs: Runs) -> list[str]:
    """Tables I and II of the paper beside our results; the target is the commonest class of each image."""
    folders = published_columns("search", runs)
    rows = [["policy", "", "paper", *folders]]
    for policy, figures in (paper.TABLE_II | paper.TABLE_I).items():
        for place, n in enumerate(paper.TABLE_SHIFTS):
            ours = [_performance_cell(folder, policy, n) for folder in folders.values()]
            rows.append([policy if place == 0 else "", f"CP@{n}", f"{figures[place]:.2f}", *ours])
    return table(rows)


def _performance_cell(folder: Path, policy: str, shifts: int) -> str:
    """Cumulative performance in percent, with its standard error over images."""
    curve = averaged(records_of(folder, policy, commonest=True), shifts)
    return percent(curve.mean[shifts], curve.over_images[shifts])


def sensitivity(runs: Runs) -> list[str]:
    """Write a row for each setting of the study of settings: curves over all targets."""
    rows = [["setting", *(f"CP@{n}" for n in _SENSITIVITY_SHIFTS)]]
    for setting in SENSITIVITY:
        records = records_of(runs[f"sensitivity {setting}"].out, SENSITIVITY_POLICY)
        curve = averaged(records, max(_SENSITIVITY_SHIFTS))
        rows.append([setting, *(percent(curve.mean[n], curve.over_images[n]) for n in _SENSITIVITY_SHIFTS)])
    return table(rows)


def markdown_table(name: str, number: int, folder: Path, columns: Sequence[str] | None = None) -> list[str]:
    """Read the table of this number in a Markdown file, without the text around it; with `columns`, only these."""
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    tables = [list(rows) for is_table, rows in groupby(lines, lambda line: line.startswith("|")) if is_table]
    return tables[number] if columns is None else _with_columns(tables[number], columns)


def _with_columns(lines: Sequence[str], columns: Sequence[str]) -> list[str]:
    """Write a Markdown table reduced to its first column and some others.

    >>> _with_columns(["| a | b | c |", "|---|---|---|", "| 1 | 2 | 3 |"], ["c"])
    ['| a | c |', '|---|---|', '| 1 | 3 |']
    """
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    headings, _, *body = rows  # the second one is the rule
    places = [0, *(headings.index(column) for column in columns)]
    return table([[row[place] for place in places] for row in (headings, *body)])


def by_samples(folder: Path, shifts: Sequence[int], field: str = "right") -> list[str]:
    """Differences of policies with an expectation over drawn looks from the same with the expected scores."""
    rows = [["difference to the expected scores", *(str(n) for n in shifts)]]
    for policy in policies_of(folder):
        plain, _, drawn = policy.partition(", samples ")
        if drawn:
            rows.append([policy, *points(*paired_difference(folder, policy, plain, max(shifts), field), shifts)])
    return table(rows)


def photographs(runs: Runs) -> list[str]:
    """Table of the photographs of the page: their number, their objects and targets, and how many show a person."""
    from semfov.detection.class_names import COCO_CLASSES
    from semfov.runs.setup import make_scenes

    run = runs["search-published-nano"]
    scenes = make_scenes(run.data, COCO_CLASSES)
    labels = [scenes.annotation(index).labels for index in range(len(scenes))]
    counts = np.array([len(of_photograph) for of_photograph in labels])
    person = COCO_CLASSES.index("person") + 1
    with_person = sum(bool((of_photograph == person).any()) for of_photograph in labels)
    targets = sum(len(scenes.targets(index)) for index in range(len(scenes)))
    figures = {
        "photographs": f"{len(scenes):,}",
        "boxes": f"{counts.sum():,}",
        "boxes in a photograph, median": f"{np.median(counts):g}",
        "photographs with a person": str(with_person),
        "pairs of photograph and target": f"{targets:,}",
    }
    return table([["of the photographs of this page", ""], *([name, value] for name, value in figures.items())])
