"""Scanpaths of searches, reduced to cells and cut at the target, as Ruarte et al. (2025) compare them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, read_ruarte, read_table
from semfov.errors import DataError
from semfov.metrics.scanpath import found_at, merge_close
from semfov.runs.seeds import generator_for

_Array = NDArray[np.float64]


def read_searches(path: Path, screen: tuple[int, int], subject: str | None = None) -> list[Fixations]:
    """Read the scanpaths of a file, or of all JSON files of a folder.

    Args:
        path: a table (`.csv`), a JSON file in the format of Ruarte et al., or a folder of such JSON files.
        screen: `(width, height)` of the screen in pixels.
        subject: name of the searcher (None: the name given in the file).

    Returns:
        The scanpaths in screen pixels.

    Raises:
        DataError: the folder holds no JSON file, or a scanpath has no target or box.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if not files:
            raise DataError(f"{path}: expected JSON files of scanpaths, found none")
        return [*chain.from_iterable(read_searches(file, screen, subject) for file in files)]
    if path.suffix == ".csv":
        searches = [search.resized(screen) for search in read_table(path)]
    else:
        searches = read_ruarte(path, screen=screen, subject=subject)
    for search in searches:
        if search.target is None or search.box is None:
            raise DataError(f"{path}: {search.picture}: expected a target and its box, by which searches are scored")
    return searches


def shift_found(search: Fixations, longest: int) -> int:
    """Find the gaze shift that found the target, by the file or else the box; -1 if no fixation of `longest` did."""
    assert search.box is not None
    at = len(search) - 1 if search.found else -1
    if search.found is None:
        at = found_at(search.points + 0.5, search.box)
    return at if at < longest else -1


def goal_rectangle(search: Fixations, grid: Grid) -> tuple[int, int, int, int]:
    """First and last column, and first and last row, of the cells that the target's box overlaps."""
    assert search.box is not None
    step = np.array(search.size) / (grid.columns, grid.rows)
    first = np.floor(np.array(search.box[:2]) / step + 1e-9)
    last = np.ceil(np.array(search.box[2:]) / step - 1e-9) - 1
    return int(first[0]), int(last[0]), int(first[1]), int(last[1])


def in_cells(search: Fixations, grid: Grid) -> _Array:
    """Return the fixated cells of a search, up to the first on the target.

    Successive fixations in the same cell are merged into one (`merge_close`), and all fixations after the first one in
    a cell of the target are left out. As in Ruarte et al., coordinates count from the left and top edges of the screen.

    Args:
        search: the scanpath.
        grid: the grid over the screen.

    Returns:
        `(n, 2)`, column and row of each cell.
    """
    step = np.array(search.size) / (grid.columns, grid.rows)
    path = merge_close(np.clip(np.floor(search.points / step), 0, (grid.columns - 1, grid.rows - 1)), (1, 1))
    return path[: _steps_to_target(path, search, grid)]


def _steps_to_target(path: _Array, search: Fixations, grid: Grid) -> int | None:
    """Count fixations `(n, 2)`, column and row, up to the first in a cell of the target; None if none is."""
    left, right, top, bottom = goal_rectangle(search, grid)
    x, y = path.T
    on = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
    return int(on.argmax()) + 1 if on.any() else None


def drawn_searches(
    searches: Sequence[Fixations],
    grid: Grid,
    start: tuple[float, float],
    density: _Array,
    *,
    longest: int,
    seed: int,
    name: str,
) -> list[Fixations]:
    """Random searches that draw cell after cell, without replacement, from the same density in every picture.

    Args:
        searches: one search for each picture, which gives the target.
        grid: the grid over the screen.
        start: the first fixation, in pixels of the screen.
        density: `(X·Y,)`, weights of the cells, 0 or more.
        longest: largest number of fixations in a search, including the first.
        seed: random seed of the draws.
        name: name of the searcher.

    Returns:
        A search for each picture.
    """
    centres = grid.centres.numpy()
    first = int(grid.cell_of(torch.tensor(start)))
    drawn = []
    for search in searches:
        generator = generator_for("searches", seed, search.picture, name)
        weights = torch.from_numpy(density).double().clone()
        weights[first] = 0
        others = weights.multinomial(longest - 1, generator=generator).numpy()
        cells = np.concatenate([[first], others])
        steps = _steps_to_target(np.stack([cells % grid.columns, cells // grid.columns], -1), search, grid)
        points = centres[cells[:steps]].astype(np.float64)
        found = steps is not None
        drawn.append(Fixations(search.picture, name, points, search.size, None, search.target, search.box, found))
    return drawn
