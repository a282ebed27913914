"""Conversion of tables in which a fixation is not one row with a column for x and one for y."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from semfov.human.fixations.columns import LOST, Row, Table
from semfov.human.fixations.programs import Column, key_of

_PAIR = ("location_x", "location_y")  # columns that are made of one of pairs
_SNAPSHOT = ("snapshot", "mapped x", "mapped y", "mapped type", "mapped index")
"""Columns that are made of those of a snapshot: its name, and place, kind and number of a fixation in it."""

_MAPPED = re.compile(r"mapped (fixation [xy]|eye movement type(?: index)?) \[(.+)\]", re.IGNORECASE)
"""Columns of Tobii Pro Lab for fixations of glasses on the snapshot in the brackets."""


def unfolded(table: Table) -> Table:
    """Convert a table so that each fixation has one row, with a column for x and one for y.

    Args:
        table: a column `location` may have pairs `[x, y]`, and each snapshot of glasses columns of its own. Snapshots
            to which no fixation is mapped do not count.

    Returns:
        The table with further columns; that which is given, where it has neither.
    """
    return _with_snapshots(_with_pairs(table))


def _with_pairs(table: Table) -> Table:
    """Make two columns of a column `location` of pairs, `[x, y]`, if a table has one."""
    names = {Column.of(name).key: name for name in table.columns}
    if "location" not in names or "locationx" in names:
        return table
    rows = []
    for row in table.rows:
        text = row.fields.get(names["location"], "").strip("[]() ")
        pair = re.split(r"[,\s]+", text)
        x, y = pair if len(pair) == 2 else ("", "")
        rows.append(_with_fields(row, _PAIR, (x, y)))
    return table._replace(columns=[*table.columns, *_PAIR], rows=rows)


def _with_fields(row: Row, names: Sequence[str], texts: Sequence[str]) -> Row:
    """Add fields of these names to a row."""
    return row._replace(fields={**row.fields, **dict(zip(names, texts, strict=True))})


class _Snapshot(NamedTuple):
    """A picture on which fixations of glasses are mapped, and the names of its columns by their keys."""

    name: str
    columns: dict[str, str]

    def has_fixation(self, row: Row) -> bool:
        """Tell whether a row has the place of a fixation on the snapshot."""
        place = self._texts(row, ("fixationx", "fixationy"))
        return not any(text.lower() in LOST for text in place)

    def row(self, row: Row) -> Row:
        """Write what a row has of the snapshot into the columns of all snapshots."""
        texts = self._texts(row, ("fixationx", "fixationy", "eyemovementtype", "eyemovementtypeindex"))
        return _with_fields(row, _SNAPSHOT, [self.name, *texts])

    def _texts(self, row: Row, keys: Sequence[str]) -> list[str]:
        """Take the fields of a row by the keys of the snapshot's columns; those that the table lacks are empty."""
        return [row.fields.get(self.columns.get(key, ""), "") for key in keys]


def _with_snapshots(table: Table) -> Table:
    """Make a row of each row and snapshot, one snapshot after the other, if a table has fixations on some."""
    snapshots: dict[str, _Snapshot] = {}
    for name in table.columns:
        if mapped := _MAPPED.fullmatch(name):
            key, snapshot = mapped.groups()
            snapshots.setdefault(snapshot, _Snapshot(snapshot, {})).columns[key_of(key)] = name
    viewed = [snapshot for snapshot in snapshots.values() if any(map(snapshot.has_fixation, table.rows))]
    if not viewed:
        return table
    rows: list[Row] = []
    for snapshot in viewed:
        rows += map(snapshot.row, table.rows)
    return table._replace(columns=[*table.columns, *_SNAPSHOT], rows=rows)
