"""Scores the searches of people, of models from files, of random baselines and of policies in the same way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from eval.human.search.config import PeopleSearchConfig
from eval.human.search.report import people_report
from eval.human.search.run import PeopleSearchRun
from eval.human.search.scores import Beside, People
from eval.human.search.trials import drawn_searches, read_searches
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, by_picture
from semfov.errors import DataError, check
from semfov.runs.scene_run import finish, gather

_Array = NDArray[np.float64]

RANDOM, CENTRE = "random draws", "centre draws"


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
        policies = run.searches(gather(run)[0])
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
    """A search in each picture, by uniform random draws, or by draws from people's fixations in all pictures."""
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
