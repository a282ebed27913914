"""The cheapest pairs of two sets, of which not every member needs a partner."""

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
    rows, columns = np.nonzero(costs < 0)
    if not len(rows):
        return np.zeros((0, 2), np.intp)
    # Only rows and columns that can have a partner count.
    kept_rows = np.unique(rows)
    kept_columns = np.unique(columns)
    possible = np.minimum(costs[np.ix_(kept_rows, kept_columns)], 0.0)
    cheapest = possible.argmin(1)
    if len(set(cheapest.tolist())) == len(cheapest):  # each row can have its best: no sum is lower
        return np.stack([kept_rows, kept_columns[cheapest]], -1)
    table = np.concatenate([possible, np.zeros((len(kept_rows), len(kept_rows)))], 1)
    column_of = _assigned(table)
    count = len(kept_columns)
    made = column_of < count
    made[made] = possible[np.flatnonzero(made), column_of[made]] < 0
    return np.stack([kept_rows[made], kept_columns[column_of[made]]], -1)


def _assigned(costs: NDArray[np.float64]) -> NDArray[np.intp]:
    """Assign a column to each row at the lowest sum of costs; `(R, C)` with R <= C → `(R,)`."""
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
        distance = np.full(columns, np.inf)
        before = np.full(columns, -1)  # the row from which each column is reached
        reached = np.zeros(columns, bool)
        row = start
        length = 0.0
        while True:
            through = length + costs[row] - row_price[row] - column_price
            shorter = ~reached & (through < distance)
            distance[shorter] = through[shorter]
            before[shorter] = row
            column = int(np.where(reached, np.inf, distance).argmin())
            length = float(distance[column])
            reached[column] = True
            if row_of[column] < 0:
                break
            row = int(row_of[column])
        # Prices of what was reached change, so that all pairs remain the cheapest ones.
        partners = row_of[reached]
        known = partners >= 0
        row_price[start] += length
        row_price[partners[known]] += length - distance[reached][known]
        column_price[reached] -= length - distance[reached]
        while True:
            row = int(before[column])
            row_of[column] = row
            column, column_of[row] = int(column_of[row]), column
            if row == start:
                break
    return column_of
