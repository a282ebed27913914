"""Scores the searches of people, of models from files, of random baselines and of policies in the same way."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from eval.comparison.records import gather
from eval.comparison.summary import announce, write_texts
from eval.human.search.run import PeopleSearchConfig, PeopleSearchRun
from eval.human.search.scores import DIMENSIONS, Beside, People
from eval.human.search.trials import drawn_searches, read_searches
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, by_picture, write_table
from semfov.errors import DataError, check
from semfov.io.files import plain_name, sha256
from semfov.io.tables import csv_text
from semfov.runs.scene_run import finish
from semfov.runs.tables import table
from semfov.version import __version__
from semfov.viz.style import save_figure
from train.outputs import commit

_Array = NDArray[np.float64]

RANDOM, CENTRE = "uniform scanpaths", "centre-bias scanpaths"


def compare(config: PeopleSearchConfig) -> None:
    """Score all searchers against people and write the report.

    Args:
        config: the settings.

    Raises:
        DataError: the file of a model has no picture that people searched.
    """
    screen = (config.screen.width, config.screen.height)
    grid = Grid(config.belief.columns, config.belief.rows, screen)
    people = read_searches(config.people, screen)
    pictures = {search.picture for search in people}
    models = _from_files(config, screen, pictures)
    baselines = {name: _floor(name, people, grid, config) for name in (RANDOM, CENTRE)}
    searchers = {"people": people, **models, **baselines}
    tables = {f"all {len(pictures)} pictures": _scored(searchers, people, grid, config)}
    policies: dict[str, list[Fixations]] = {}
    if config.pictures:
        run = PeopleSearchRun(config)
        finish(run, "searching")
        policies = run.searches([*gather(run)])
        available = _in_pictures(searchers, set(run.scenes.ids))
        title = f"the {len(set(run.scenes.ids))} available pictures"
        tables[title] = _scored({**available, **policies}, available["people"], grid, config)
    people_report(config, tables, {**baselines, **policies})


def _from_files(
    config: PeopleSearchConfig, screen: tuple[int, int], pictures: Collection[str]
) -> dict[str, list[Fixations]]:
    """Read the searches of models from files, which should be in pictures that people searched."""
    names = [path.stem for path in config.files]
    for name in names:
        count = names.count(name)
        check(count == 1, "files", "files of different names", f"{name!r} {count} times")
    searchers = {path.stem: read_searches(path, screen, path.stem) for path in config.files}
    for name, searches in searchers.items():
        if not any(search.picture in pictures for search in searches):
            raise DataError(f"{name}: expected searches in pictures that people searched, got only other pictures")
    return searchers


def _in_pictures(
    searchers: Mapping[str, Sequence[Fixations]], pictures: Collection[object]
) -> dict[str, list[Fixations]]:
    """Select the searches in some pictures, and the searchers that have any."""
    selected = {}
    for name, searches in searchers.items():
        in_pictures = [search for search in searches if search.picture in pictures]
        if in_pictures:
            selected[name] = in_pictures
    return selected


def _scored(
    searchers: Mapping[str, list[Fixations]], people: list[Fixations], grid: Grid, config: PeopleSearchConfig
) -> dict[str, Beside]:
    """Score searchers beside people."""
    longest = config.protocol.shifts + 1
    beside = People(people, grid, longest=longest, bandwidth=config.bandwidth, bootstrap=config.bootstrap)
    return {name: beside.score(searches) for name, searches in searchers.items()}


def _floor(name: str, people: Sequence[Fixations], grid: Grid, config: PeopleSearchConfig) -> list[Fixations]:
    """Return a search in each picture, by uniform random draws, or by draws from people's fixations in all pictures."""
    density = np.ones(len(grid)) if name == RANDOM else _centre(people, grid)
    trials = [searches[0] for searches in by_picture(people).values()]
    protocol = config.protocol
    longest = min(protocol.shifts + 1, len(grid))
    return drawn_searches(trials, grid, config.screen.start, density, longest=longest, seed=protocol.seed, name=name)


def _centre(people: Sequence[Fixations], grid: Grid) -> _Array:
    """Count how often people fixate each cell after their first fixation in all pictures, plus one."""
    points = np.concatenate([search.points[1:] for search in people])
    counts = torch.bincount(grid.cell_of(torch.from_numpy(points)), minlength=len(grid))
    return np.asarray(counts.double().numpy() + 1)


Rows = Mapping[str, Beside]

_HEAD = (
    "area under performance",
    "TFP-AUC",
    "probability mismatch",
    "scanpath ratio",
    "MultiMatch",
    "sequence score",
    "edit distance",
)


def people_report(
    config: PeopleSearchConfig, tables: Mapping[str, Rows], scanpaths: Mapping[str, list[Fixations]]
) -> None:
    """Write all output and print the tables; scanpaths are those of random baselines and policies, by name."""
    out = config.out
    lines = []
    for title, rows in tables.items():
        lines += [f"**{title}**", "", *_table(rows), ""]
    summary = "\n".join(lines)
    files = {
        "summary.md": summary,
        "summary.csv": _csv(tables),
        "curves.csv": _curves(tables),
        "config.yaml": config.yaml(),
        "manifest.json": json.dumps(_manifest(config), indent=2) + "\n",
    }
    written = write_texts(out, files)
    for name, searches in scanpaths.items():
        path = out / "scanpaths" / f"{plain_name(name)}.csv"
        write_table(path, searches)
        written.append(path)
    for number, (title, rows) in enumerate(tables.items(), start=1):
        from semfov.viz import plot_curves

        curves = {name: scores.curve for name, scores in rows.items()}
        figure = plot_curves(curves, title=title, label="targets found (%)", most=102)
        written.append(save_figure(figure, out / f"performance_{number}.png"))
    announce(summary, written)


def _cells(scores: Beside) -> list[tuple[float, float]]:
    """List the figures of a searcher under `_HEAD` with their standard errors, NaN where there is none."""
    nothing = (math.nan, math.nan)
    alike = [scores.multimatch, scores.sequence_score, scores.edit_distance] if scores.alike else [nothing] * 3
    return [scores.area, scores.tfp_auc, (scores.mismatch, math.nan), scores.ratio, *alike]


def _table(rows: Rows) -> list[str]:
    """Write a table of searchers, as Markdown."""
    body = [["", *_HEAD]]
    for name, scores in rows.items():
        body.append([name, *(_with_error(value, error) for value, error in _cells(scores))])
    return table(body)


def _with_error(value: float, error: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.3f} ± {error:.3f}" if not math.isnan(error) else f"{value:.3f}"


def _csv(tables: Mapping[str, Rows]) -> str:
    """Write all figures, one a row, with the single dimensions of MultiMatch."""
    lines = [["table", "row", "figure", "value", "error"]]
    for title, rows in tables.items():
        for name, scores in rows.items():
            figures = dict(zip(_HEAD, _cells(scores), strict=True))
            if scores.alike:
                figures |= {f"MultiMatch {dimension}": scores.mean(n) for n, dimension in enumerate(DIMENSIONS)}
            for figure, (value, error) in figures.items():
                lines.append([title, name, figure, f"{value:.5f}", f"{error:.5f}"])
    return csv_text(lines)


def _curves(tables: Mapping[str, Rows]) -> str:
    """Write the performance after each gaze shift, one a row."""
    lines = [["table", "row", "gaze shifts", "found"]]
    for title, rows in tables.items():
        for name, scores in rows.items():
            lines += [[title, name, str(shifts), f"{share:.5f}"] for shifts, share in enumerate(scores.curve)]
    return csv_text(lines)


def _manifest(config: PeopleSearchConfig) -> dict[str, object]:
    """Describe what the scores were made of."""
    files: list[Path] = []
    for path in (config.people, *config.files):
        files += sorted(path.glob("*.json")) if path.is_dir() else [path]
    return {
        "command": ["python", "-m", "eval.human", *sys.argv[1:]],
        "commit": commit(),
        "semfov": __version__,
        "sha256": {str(file): sha256(file) for file in files},
        "seed": config.protocol.seed,
    }
