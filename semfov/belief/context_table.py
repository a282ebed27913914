"""Tables of classes by classes, or of classes by heights in the picture, from which context is made."""

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from semfov.data.classes import alike
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular

_MOST = 10_000
_LARGEST = 1e3


@dataclass(frozen=True)
class _NamedTable:
    """A table of numbers with named rows and columns; values `(rows, columns)`."""

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    values: Tensor


def read_named_table(path: str | PathLike[str]) -> _NamedTable:
    """Read a table from CSV: names in the first row and the first column, numbers or empty cells elsewhere."""
    check_regular(path)
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            lines = [(reader.line_num, line) for line in reader if any(cell.strip() for cell in line)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: expected a CSV file, got: {error}") from error
    if not 2 <= len(lines) <= _MOST + 1 or not 2 <= len(lines[0][1]) <= _MOST + 1:
        raise DataError(
            f"{path}: expected 1 to {_MOST:,} names in the first row and in the first column, got {len(lines)} lines"
        )
    columns = [name.strip() for name in lines[0][1][1:]]
    rows, values = [], []
    for number, (name, *cells) in lines[1:]:
        if len(cells) != len(columns):
            raise DataError(f"{path}, line {number}: expected {len(columns)} values after the name, got {len(cells)}")
        rows.append(name.strip())
        values.append([_number(cell, f"{path}, line {number}") for cell in cells])
    for names, what in ((rows, "column"), (columns, "row")):
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice or "" in names:
            raise DataError(
                f"{path}: expected different names in the first {what}, got {', '.join(twice) or 'no name'}"
            )
    return _NamedTable(tuple(rows), tuple(columns), torch.tensor(values))


def _number(cell: str, where: str) -> float:
    if not cell.strip():
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = math.inf
    if not abs(value) <= _LARGEST:
        raise DataError(
            f"{where}: expected numbers from -1000 to 1000, or empty cells for unknown values, got {cell[:40]!r}"
        )
    return value


def cooccurrence_from(table: _NamedTable, classes: Sequence[str], bands: int) -> tuple[Tensor, list[str]]:
    """Log ratios of co-occurrence from a table, by the formula of `ContextPrior.from_table`; → `(K+1, K+1, N)`."""
    values = _picked(_picked(table.values, table.rows, classes).mT, table.columns, classes).mT
    values.fill_diagonal_(torch.nan)
    missing = [name for name, row, column in zip(classes, values, values.mT, strict=True)
               if row.isnan().all() and column.isnan().all()]  # fmt: skip
    if len(missing) == len(classes):
        some = ", ".join(table.rows[:5])
        raise InputError(f"classes: expected some that are in the table ({some}, …), got {', '.join(classes[:5])}, …")
    relative = values - values.nanmean(1, keepdim=True) - values.nanmean(0, keepdim=True) + values.nanmean()
    profile = torch.linspace(1, -1, bands)
    cooccurrence = torch.zeros(len(classes) + 1, len(classes) + 1, bands)
    cooccurrence[1:, 1:] = relative.nan_to_num(0)[..., None] * profile
    return cooccurrence, missing


def places_from(table: _NamedTable, classes: Sequence[str]) -> Tensor:
    """Log odds of places `(K+1, R, R)`, minus the mean of each class, from a table of classes by heights."""
    values = _picked(table.values, table.rows, classes)
    relative = (values - values.nanmean(1, keepdim=True)).nan_to_num(0)
    rows = relative.shape[1]
    place = torch.zeros(len(classes) + 1, rows, rows)
    place[1:] = relative[..., None].expand(-1, -1, rows)
    return place


def _picked(values: Tensor, names: Sequence[str], classes: Sequence[str]) -> Tensor:
    """Rows for the classes: the row of the name, or the mean of the rows of its synonyms, or NaN."""
    return torch.stack([values[alike(name, names)].nanmean(0) for name in classes])
