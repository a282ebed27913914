"""Scores the searches of people, of models from files, of random baselines and of policies in the same way."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any

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
    screen = config.screen.width, config.screen.height
    grid = Grid(config.belief.columns, config.belief.rows, screen)
    people = read_searches(config.people, screen)
    stems = [path.stem for path in config.files]
    for name in stems:
        check(stems.count(name) == 1, "files", "files of different names", f"{name!r} {stems.count(name)} times")
    searchers = {path.stem: read_searches(path, screen, path.stem) for path in config.files}
    pictures = {each.picture for each in people}
    for name, searches in searchers.items():
        if not pictures & {each.picture for each in searches}:
            raise DataError(f"{name}: expected searches in pictures that people searched, got only other pictures")
    floors = {name: _floor(name, people, grid, config) for name in (RANDOM, CENTRE)}
    policies: dict[str, list[Fixations]] = {}
    run: PeopleSearchRun | None = None
    if config.pictures:
        run = PeopleSearchRun(config)
        finish(run, "searching")
        policies = run.searches([*gather(run)])
    every = {"people": people, **searchers, **floors}
    tables = {f"all {len(pictures)} pictures": _scored(every, people, grid, config)}
    if run is not None:
        here = set(run.scenes.ids)
        few = {name: [each for each in searches if each.picture in here] for name, searches in every.items()}
        few = {name: searches for name, searches in few.items() if searches}
        title = f"the {len(here)} available pictures"
        tables[title] = _scored({**few, **policies}, few["people"], grid, config)
    people_report(config, tables, {**floors, **policies})


def _scored(
    searchers: dict[str, list[Fixations]], people: list[Fixations], grid: Grid, config: PeopleSearchConfig
) -> dict[str, Beside]:
    settings: dict[str, Any] = {"bandwidth": config.bandwidth, "bootstrap": config.bootstrap}
    beside = People(people, grid, longest=config.protocol.shifts + 1, **settings)
    return {name: beside.score(searches) for name, searches in searchers.items()}


def _floor(name: str, people: Sequence[Fixations], grid: Grid, config: PeopleSearchConfig) -> list[Fixations]:
    """Return a search in each picture, by uniform random draws, or by draws from people's fixations in all pictures."""
    density = np.ones(len(grid)) if name == RANDOM else _centre(people, grid)
    trials = [searches[0] for searches in by_picture(people).values()]
    protocol = config.protocol
    longest = min(protocol.shifts + 1, len(grid))
    return drawn_searches(trials, grid, config.screen.start, density, longest=longest, seed=protocol.seed, name=name)


def _centre(people: Sequence[Fixations], grid: Grid) -> _Array:
    """How often people fixate each cell after their first fixation in all pictures, plus one."""
    points = np.concatenate([each.points[1:] for each in people])
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
    summary = "\n".join(line for title, rows in tables.items() for line in [f"**{title}**", "", *_table(rows), ""])
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

        figure = plot_curves(
            {name: each.curve for name, each in rows.items()}, title=title, label="targets found (%)", most=102
        )
        written.append(save_figure(figure, out / f"performance_{number}.png"))
    announce(summary, written)


def _cells(each: Beside) -> list[tuple[float, float]]:
    none = float("nan")
    figures = [each.area, each.tfp_auc, (each.mismatch, none), each.ratio]
    return [*figures, each.multimatch, each.mean(4), each.mean(5)] if each.alike else [*figures, *[(none, none)] * 3]


def _table(rows: Rows) -> list[str]:
    body = [[name, *(_with_error(*cell) for cell in _cells(each))] for name, each in rows.items()]
    return table([["", *_HEAD], *body])


def _with_error(value: float, error: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.3f} ± {error:.3f}" if not math.isnan(error) else f"{value:.3f}"


def _csv(tables: Mapping[str, Rows]) -> str:
    lines = [["table", "row", "figure", "value", "error"]]
    for title, rows in tables.items():
        for name, each in rows.items():
            named = dict(zip(_HEAD, _cells(each), strict=True))
            if each.alike:
                named |= {f"MultiMatch {what}": each.mean(n) for n, what in enumerate(DIMENSIONS)}
            lines += [[title, name, what, f"{value:.5f}", f"{error:.5f}"] for what, (value, error) in named.items()]
    return csv_text(lines)


def _curves(tables: Mapping[str, Rows]) -> str:
    lines = [["table", "row", "gaze shifts", "found"]]
    for title, rows in tables.items():
        for name, each in rows.items():
            lines += [[title, name, str(n), f"{value:.5f}"] for n, value in enumerate(each.curve)]
    return csv_text(lines)


def _manifest(config: PeopleSearchConfig) -> dict[str, object]:
    files = [config.people, *config.files]
    files = [file for path in files for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    return {
        "command": ["python", "-m", "eval.human", *sys.argv[1:]],
        "commit": commit(),
        "semfov": __version__,
        "sha256": {str(file): sha256(file) for file in files},
        "seed": config.protocol.seed,
    }
