"""What the records of a fovea share: the cells that it looks at, and the files of looks at cells."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.io.schema import Json, Number
from semfov.paths.base import Record
from semfov.paths.files import POSITIVE, pair

GRID: dict[str, Json] = {"grid": pair(Number(low=1, high=10_000, whole=True)), "size": pair(POSITIVE)}
"""JSON values of a grid in a file."""


@dataclass(frozen=True, kw_only=True, repr=False)
class CellRecord(Record):
    """Base of the records of looks of a fovea at cells; `seconds` are those of each look by stage."""

    grid: Grid
    seconds: tuple[Mapping[str, float], ...] = ()

    how = "fovea"

    _tensors: ClassVar[tuple[str, ...]]
    """Attributes that are tensors of a file; those that are None are left out."""

    _plain: ClassVar[tuple[str, ...]] = ()
    """Attributes that are JSON values of a file."""

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the photograph or frame in pixels."""
        width, height = (int(side) for side in self.grid.extent)
        return width, height

    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        size = self.grid.size.tolist() if isinstance(self.grid.size, Tensor) else list(self.grid.size)
        tensors = {name: getattr(self, name) for name in self._tensors if getattr(self, name) is not None}
        record = {name: getattr(self, name) for name in self._plain}
        record |= {"grid": [self.grid.columns, self.grid.rows], "size": size}
        return tensors, {**record, "seconds": [dict(each) for each in self.seconds]}

    @classmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        looks, seconds, decision = len(shared["detections"]), record["seconds"], shared["decision"]
        columns, rows = record["grid"]
        grid = Grid(columns, rows, tuple(record["size"]))
        check(len(seconds) in (0, looks), "seconds", f"times of {looks} looks, or none", len(seconds))
        cell = None if decision is None else decision.cell
        check(cell is None or cell < len(grid), "decision.cell", f"a cell number below {len(grid)}", cell)
        for look in shared["closer"]:
            check((look.cell or 0) < len(grid), "closer", f"a cell below {len(grid)}", look.cell)
        made = {name: tensors.get(name) for name in cls._tensors} | {name: record[name] for name in cls._plain}
        return {**made, "grid": grid, "seconds": tuple(seconds)}
