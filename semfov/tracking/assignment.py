"""The cheapest pairs of two sets, of which not every member needs a partner."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


def cheapest_pairs(costs: NDArray[np.float64]) -> NDArray[np.intp]:
    r"""Pair rows with columns so that the sum of the costs is lowest; a pair that costs 0 or more is not made.

    The assignment is exact: shortest augmenting paths with dual prices (Jonker and Volgenant, 1987, Computing 38),
    in :math:`O(n^3)`. Being alone costs 0: each row has a column of its own at that price.

    Args:
        costs: `(R, C)`, negative where a pair is better than two that are alone; infinite where it must not be.

    Returns:
        `(P, 2)`, rows and columns of the pairs, by rows.

    >>> cheapest_pairs(np.array([[-3.0, -2.0], [-2.5, np.inf], [1.0, 4.0]])).tolist()
    [[0, 1], [1, 0]]
    """
    are_better = costs < 0
    # Only rows and columns that can have a partner count.
    kept_rows = np.flatnonzero(are_better.any(1))
    kept_columns = np.flatnonzero(are_better.any(0))
    if not len(kept_rows):
        return np.zeros((0, 2), np.intp)
    # Being alone costs 0, so that no pair has to cost more; those at 0 are not made in the end.
    possible = np.minimum(costs[kept_rows[:, None], kept_columns], 0.0)
    cheapest = possible.argmin(1)
    if len(set(cheapest.tolist())) == len(cheapest):  # each row can have its best: no sum is lower
        return np.stack([kept_rows, kept_columns[cheapest]], -1)
    table = np.concatenate([possible, np.zeros((len(kept_rows), len(kept_rows)))], 1)
    column_of = _assigned(table)
    count = len(kept_columns)
    # Rows that stay alone have one of the columns for that, or one at the same price.
    is_paired = column_of < count
    is_paired[is_paired] = possible[np.flatnonzero(is_paired), column_of[is_paired]] < 0
    return np.stack([kept_rows[is_paired], kept_columns[column_of[is_paired]]], -1)


class _Path(NamedTuple):
    """The cheapest way to give a row a column: from column to column, each of whose rows takes the next one.

    Attributes:
        end: the column at its end, which no row has.
        length: what it adds to the sum of costs.
        distance: `(C,)`, the lengths of the paths to all columns that were compared; infinite for others.
        before: `(C,)`, the row from which each of these is reached.
        reached: `(C,)` boolean, the columns that are as near as the end, or nearer.
    """

    end: int
    length: float
    distance: NDArray[np.float64]
    before: NDArray[np.intp]
    reached: NDArray[np.bool_]


def _assigned(costs: NDArray[np.float64]) -> NDArray[np.intp]:
    """Assign a column to each row at the lowest sum of costs; `(R, C)` with R <= C → `(R,)`.

    One row after the other gets a column by the shortest path in the costs above the prices of rows and columns.

    Invariant: in the rows so far, no cost is below the sum of the prices of its row and its column, and those of pairs
    are equal to it. So no other pairs of these rows have a lower sum.
    """
    rows, columns = costs.shape
    row_price = costs.min(1)
    column_price = np.zeros(columns)
    row_of = np.full(columns, -1)
    column_of = np.full(rows, -1)
    # The first row that wants a column has it, and few rows are left whose paths are searched.
    wanted, first_rows = np.unique(costs.argmin(1), return_index=True)
    row_of[wanted] = first_rows
    column_of[first_rows] = wanted
    for start in np.flatnonzero(column_of < 0).tolist():
        path = _shortest_path(start, costs, row_price, column_price, row_of)
        # Prices of what was reached change by how much nearer it is than the end, so that the invariant holds.
        change = path.length - path.distance[path.reached]
        partners = row_of[path.reached]
        are_paired = partners >= 0
        row_price[start] += path.length
        row_price[partners[are_paired]] += change[are_paired]
        column_price[path.reached] -= change
        _take(path, start, row_of, column_of)
    return column_of


def _shortest_path(
    start: int,
    costs: NDArray[np.float64],
    row_price: NDArray[np.float64],
    column_price: NDArray[np.float64],
    row_of: NDArray[np.intp],
) -> _Path:
    """Find the shortest path from a row to a column that no row has, by Dijkstra's algorithm.

    Args:
        start: the row.
        costs: `(R, C)`.
        row_price: `(R,)`.
        column_price: `(C,)`.
        row_of: `(C,)`, the row that has each column; -1 for none.

    Returns:
        The path.
    """
    columns = costs.shape[1]
    distance = np.full(columns, np.inf)
    before = np.full(columns, -1)
    reached = np.zeros(columns, bool)
    row = start
    length = 0.0
    while True:
        through = length + costs[row] - row_price[row] - column_price
        is_shorter = ~reached & (through < distance)
        distance[is_shorter] = through[is_shorter]
        before[is_shorter] = row
        nearest = int(np.where(reached, np.inf, distance).argmin())
        length = float(distance[nearest])
        reached[nearest] = True
        if row_of[nearest] < 0:
            return _Path(nearest, length, distance, before, reached)
        row = int(row_of[nearest])


def _take(path: _Path, start: int, row_of: NDArray[np.intp], column_of: NDArray[np.intp]) -> None:
    """Give each row of a path the next column, from the end of the path back to the row at its start."""
    column = path.end
    while True:
        row = int(path.before[column])
        row_of[column] = row
        next_column = int(column_of[row])  # which this row gives to the one before
        column_of[row] = column
        if row == start:
            return
        column = next_column
