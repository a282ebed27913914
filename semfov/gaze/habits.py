"""How people move their eyes, whatever there is to see: a log-linear choice among all cells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check, check_finite, check_shape
from semfov.gaze.choice import Choice, Noise
from semfov.gaze.relaxation import soft_fixation
from semfov.io.pretrained import Pretrained
from semfov.io.schema import Field, Number, Schema


class GazeHabits(Pretrained):
    r"""Where people look next, given a value of every cell: the cell is drawn with a probability that is log-linear.

    .. math:: P(x \mid f_1 \ldots f_n) \propto \exp\bigl(b \, z(x) + c(x) + s(\|x - f_n\|) + r(n - l(x))\bigr)

    with z the values of an acquisition function, scaled to mean 0 and variance 1 over the cells (`standardised`), c a
    bias for the centre, s a table of saccade lengths, and r a table of how a cell is kept from the gaze, or draws it,
    the more fixations ago :math:`l(x)` it was last fixated: inhibition of return that fades. There is no other
    inhibition: the gaze may stay, and may return. `train.fit_humanlike` fits all of it to people's next fixations.

    Args:
        pull: b, inverse temperature of the choice.
        place: `(X·Y)`, c.
        step: `(D)`, s in every bin of distance, the cell itself in the first.
        edges: D - 1 ascending borders of the bins, in longer sides of the image.
        back: `(R)`, r in every bin of age.
        ages: R - 1 ascending last ages of the bins but the last, in fixations: an age of 1 is that of the fixation
            before the present one.
        columns: cells in a row.
        metadata: JSON values that are kept with the model.

    >>> habits = GazeHabits(0.0, torch.zeros(3), torch.tensor([-9.0, 1.0, 0.0]), [0.1, 0.4], torch.zeros(1), [], 3)
    >>> never = torch.full((1, 3), torch.inf)
    >>> habits(torch.zeros(1, 3), torch.tensor([0]), never, Grid(3, 1, (30, 10)))
    tensor([[-9.,  1.,  0.]])
    """

    kind: ClassVar[str] = "gaze-habits"
    title: ClassVar[str] = "model of gaze habits"
    shipped: ClassVar[Path] = Path(__file__).parent / "models" / "habits"
    schema: ClassVar[Schema] = Schema(
        {
            "pull": Field((), low=-1e3, high=1e3),
            "place": Field(("C",), low=-1e3, high=1e3),
            "step": Field(("D",), low=-1e3, high=1e3),
            "edges": Field(("D-1",), above=0, high=100, ascending=True),
            "back": Field(("R",), low=-1e3, high=1e3),
            "ages": Field(("R-1",), low=1, high=1e6, ascending=True),
        },
        {"columns": Number(size="X")},
    )
    pull: Tensor
    place: Tensor
    step: Tensor
    edges: Tensor
    back: Tensor
    ages: Tensor

    def __init__(
        self,
        pull: float,
        place: Tensor,
        step: Tensor,
        edges: Sequence[float] | Tensor,
        back: Tensor,
        ages: Sequence[float] | Tensor,
        columns: int,
        *,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.columns = columns
        self.metadata = dict(metadata or {})
        check_shape(place, "place", None)
        check(columns >= 1 and len(place) % columns == 0, "columns", f"a divisor of {len(place)} cells", columns)
        for name, table, borders, low in (("edges", step, edges, 0.0), ("ages", back, ages, 1.0)):
            ends = torch.as_tensor(borders, dtype=place.dtype)
            check_finite(ends, name)
            ascending = bool((ends.diff() > 0).all()) and bool((ends >= low).all())
            check(len(ends) == len(table) - 1 and ascending, name, f"{len(table) - 1} ascending numbers", ends.tolist())
            self.register_buffer(name, ends)
        for name, given in (("pull", torch.tensor(pull)), ("place", place), ("step", step), ("back", back)):
            check_finite(given, name)
            self.register_buffer(name, given.detach().to(place.dtype).clone())

    def forward(self, values: Tensor, cell: Tensor, age: Tensor, grid: Grid) -> Tensor:
        """Log probabilities up to a constant, `(B, X·Y)`.

        Args:
            values: `(B, X·Y)`, of an acquisition function.
            cell: `(B,)`, that is fixated.
            age: `(B, X·Y)`, how many fixations ago each cell was fixated last, 0 for the present one and infinite for
                those that never were.
            grid: the cells of one image.

        Raises:
            InputError: the grid is another than the model was fitted on.
        """
        check((grid.columns, len(grid)) == (self.columns, len(self.place)), "grid", str(self), grid)
        steps = step_bins(grid, cell, self.edges)
        ages = age_bins(age, self.ages)
        # Of a cell that was never fixated, or is now, the age says nothing.
        back = torch.where(ages >= 0, self.back[ages.clamp(min=0)], 0.0)
        return self.pull * standardised(values) + (self.place + self.step[steps] + back).to(values)

    def extra_repr(self) -> str:
        """Grid, for `repr`."""
        return f"columns={self.columns}, rows={len(self.place) // self.columns}"

    def _record(self) -> dict[str, Any]:
        """Columns of the grid."""
        return {"columns": self.columns}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The tables from what was kept."""
        tables = {name: tensors[name] for name in ("place", "step", "edges", "back", "ages")}
        return cls(float(tensors["pull"]), **tables, columns=record["columns"], metadata=record["metadata"])


class Habitual(Choice):
    """The next fixation as people choose it: drawn by `GazeHabits` from the values of an acquisition function.

    It goes by its own memory of what was fixated when, and not by the cells that are out. One is made for each
    `semfov.rollout`.

    Args:
        noise: draws.
        habits: the fitted model.
        grid: the cells.
    """

    def __init__(self, noise: Noise, habits: GazeHabits, grid: Grid) -> None:
        self.noise = noise
        self.habits = habits
        self.grid = grid
        self._cell = torch.zeros(0, dtype=torch.int64)
        self._age = torch.zeros(0, len(grid))

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The drawn cell and its centre."""
        if shift == 0:
            # All episodes are there, and the start is all that was fixated.
            self._cell = visited.long().argmax(-1)
            self._age = torch.full_like(values.detach(), torch.inf)
        cell = self._cell[episodes]
        age = (self._age[episodes] + 1).scatter(-1, cell[:, None], 0.0)
        logits = self.habits(values.detach(), cell, age, self.grid)
        fixation, drawn = soft_fixation(logits, torch.zeros_like(visited), centres, self.noise(shift, episodes))
        self._age = self._age.index_copy(0, episodes, age)
        self._cell = self._cell.index_copy(0, episodes, drawn)
        return fixation, drawn


def standardised(values: Tensor) -> Tensor:
    """Values `(..., X·Y)` scaled to mean 0 and variance 1 over the cells; 0 where all are equal.

    >>> standardised(torch.tensor([[1.0, 3.0], [2.0, 2.0]]))
    tensor([[-1.,  1.],
            [ 0.,  0.]])
    """
    apart = values - values.mean(-1, keepdim=True)
    spread = apart.square().mean(-1, keepdim=True).sqrt()
    # Rounding alone tells equal values apart.
    least = 1e-6 * values.abs().amax(-1, keepdim=True) + torch.finfo(values.dtype).tiny
    return torch.where(spread > least, apart / spread.clamp(min=torch.finfo(values.dtype).tiny), 0.0)


def step_bins(grid: Grid, cell: Tensor, edges: Tensor) -> Tensor:
    """Bin of the distance from `cell` `(...)` to every cell, `(..., X·Y)`; one that equals a border is inside."""
    return torch.bucketize(grid.cell_distance.to(edges)[cell], edges)


def age_bins(age: Tensor, ages: Tensor) -> Tensor:
    """Bin of every age, `(...)`; -1 where it is 0 or infinite."""
    return torch.where((age > 0) & age.isfinite(), torch.bucketize(age.to(ages).contiguous(), ages), -1)
