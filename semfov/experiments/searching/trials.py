"""Scanpaths of searches, brought to cells and cut at the target, as Ruarte et al. (2025) lay them side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, read_ruarte, read_table
from semfov.errors import DataError
from semfov.experiments.seeds import generator_for
from semfov.metrics.scanpath import found_at, merge_close

Array = NDArray[np.float64]


def read_searches(path: Path, screen: tuple[int, int], subject: str | None = None) -> list[Fixations]:
    """Scanpaths of a file, or of all JSON files of a folder, in screen pixels.

    Raises:
        DataError: the folder holds no such file, or a scanpath tells no target or box.
    """
    if path.is_dir():
        files = sorted(path.glob("*.json"))
        if not files:
            raise DataError(f"{path}: expected JSON files of scanpaths, found none")
        return [each for file in files for each in read_searches(file, screen, subject)]
    if path.suffix == ".csv":
        found = [each.resized(screen) for each in read_table(path)]
    else:
        found = read_ruarte(path, screen=screen, subject=subject)
    for each in found:
        if each.target is None or each.box is None:
            raise DataError(f"{path}: {each.picture}: expected a target and its box, for searches are scored by them")
    return found


def shift_found(search: Fixations, longest: int) -> int:
    """Gaze shift that found the target, as the file says, else by the box; -1 where none did in so many fixations."""
    assert search.box is not None
    at = len(search) - 1 if search.found else -1
    if search.found is None:
        at = found_at(search.points + 0.5, search.box)
    return at if at < longest else -1


def goal_cells(search: Fixations, grid: Grid) -> tuple[int, int, int, int]:
    """First and last column, first and last row of the cells that the target's box is in."""
    assert search.box is not None
    step = np.array(search.size) / (grid.columns, grid.rows)
    first = np.floor(np.array(search.box[:2]) / step + 1e-9)
    last = np.ceil(np.array(search.box[2:]) / step - 1e-9) - 1
    return int(first[0]), int(last[0]), int(first[1]), int(last[1])


def in_cells(search: Fixations, grid: Grid) -> Array:
    """Columns and rows of the cells that were fixated, `(n, 2)`, neighbours merged, up to the target.

    One fixation after another in the same cell is one (`merge_close`), and what comes after the first in a cell of the
    target is left out. Coordinates count from the left and the top edge of the screen, as they do it.
    """
    step = np.array(search.size) / (grid.columns, grid.rows)
    path = merge_close(np.clip(np.floor(search.points / step), 0, (grid.columns - 1, grid.rows - 1)), (1, 1))
    left, right, top, bottom = goal_cells(search, grid)
    x, y = path.T
    on = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
    return path[: on.argmax() + 1] if on.any() else path


def drawn_searches(
    searches: Sequence[Fixations],
    grid: Grid,
    start: tuple[float, float],
    density: Array,
    *,
    longest: int,
    seed: int,
    name: str,
) -> list[Fixations]:
    """Searches that draw cell after cell, without return, from the same density in every picture.

    Args:
        searches: one for each picture, for its target.
        grid: the cells of the screen.
        start: first fixation.
        density: `(X·Y,)`, from 0.
        longest: fixations of a search, the first among them.
        seed: of the draws.
        name: of the searcher.
    """
    centres = grid.centres.numpy()
    first = int(grid.cell_of(torch.tensor(start)))
    drawn = []
    for each in searches:
        generator = generator_for("searches", seed, each.picture, name)
        weights = torch.from_numpy(density).double().clone()
        weights[first] = 0
        others = weights.multinomial(longest - 1, generator=generator).numpy()
        cells = np.concatenate([[first], others])
        left, right, top, bottom = goal_cells(each, grid)
        x, y = cells % grid.columns, cells // grid.columns
        on = (left <= x) & (x <= right) & (top <= y) & (y <= bottom)
        cells = cells[: on.argmax() + 1] if on.any() else cells
        drawn.append(
            Fixations(
                each.picture,
                name,
                centres[cells].astype(np.float64),
                each.size,
                None,
                each.target,
                each.box,
                bool(on.any()),
            )
        )
    return drawn
