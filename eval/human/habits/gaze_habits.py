"""How people move their eyes regardless of the picture: a log-linear choice among all cells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check, check_finite, check_shape
from semfov.gaze.choice import Choice, Noise, soft_fixation
from semfov.io.pretrained import Pretrained
from semfov.io.schema import Field, Number, Schema


class GazeHabits(Pretrained):
    r"""Where people look next: a log-linear model of the next cell, given the acquisition values of all cells.

    .. math:: P(x \mid f_1 \ldots f_n) \propto \exp\bigl(b \, z(x) + c(x) + s(\|x - f_n\|) + r(n - l(x))\bigr)

    z are the values of an acquisition function, scaled to mean 0 and variance 1 over the cells (`standardised`). c is a
    centre bias, and s a table over the length of the saccade. r is a table over the age of a cell, the number of
    fixations since it was last fixated at fixation l(x): a negative entry keeps the gaze from returning, and a positive
    one attracts it. This is inhibition of return that fades. There is no other inhibition: the gaze may stay, and may
    return. `python -m eval.human habits` fits all parameters to people's next fixations.

    Args:
        pull: b, inverse temperature of the choice.
        place: `(X·Y)`, c.
        step: `(D)`, s in every bin of distance; the first bin holds the fixated cell itself.
        edges: D - 1 ascending edges of the distance bins, in units of the image's longer side.
        back: `(R)`, r in every bin of age.
        ages: R - 1 ascending numbers, the last age in each bin but the last one, in fixations. The cell of the
            fixation before the present one has age 1.
        columns: number of cells in a row.
        metadata: JSON values to keep with the model.

    Raises:
        InputError: the sizes do not fit together, or a number is not finite.

    >>> habits = GazeHabits(0.0, torch.zeros(3), torch.tensor([-9.0, 1.0, 0.0]), [0.1, 0.4], torch.zeros(1), [], 3)
    >>> never = torch.full((1, 3), torch.inf)
    >>> habits(torch.zeros(1, 3), torch.tensor([0]), never, Grid(3, 1, (30, 10)))
    tensor([[-9.,  1.,  0.]])
    """

    kind: ClassVar[str] = "gaze-habits"
    title: ClassVar[str] = "model of gaze habits"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
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
        check(len(place) > 0, "place", "at least one cell", len(place))
        check(columns >= 1 and len(place) % columns == 0, "columns", f"a divisor of {len(place)} cells", columns)
        for name, table, borders, low in (("edges", step, edges, 0.0), ("ages", back, ages, 1.0)):
            ends = torch.as_tensor(borders, dtype=place.dtype)
            check_finite(ends, name)
            ascending = bool((ends.diff() > 0).all()) and bool((ends >= low).all())
            check(len(ends) == len(table) - 1 and ascending, name, f"{len(table) - 1} ascending numbers", ends.tolist())
            self.register_buffer(name, ends)
        for name, values in (("pull", torch.tensor(pull)), ("place", place), ("step", step), ("back", back)):
            check_finite(values, name)
            self.register_buffer(name, values.detach().to(place.dtype).clone())

    def forward(self, values: Tensor, cell: Tensor, age: Tensor, grid: Grid) -> Tensor:
        """Log probability of every cell as the next one, up to a constant.

        Args:
            values: `(B, X·Y)`, of an acquisition function.
            cell: `(B,)`, the cell that is fixated.
            age: `(B, X·Y)`, number of fixations since each cell was last fixated: 0 for the present cell, and infinite
                for cells that were never fixated.
            grid: the cells of one image.

        Returns:
            `(B, X·Y)`, in nats.

        Raises:
            InputError: the grid has another shape than the one the model was fitted on.
        """
        check((grid.columns, len(grid)) == (self.columns, len(self.place)), "grid", str(self), grid)
        steps = step_bins(grid, cell, self.edges)
        ages = age_bins(age, self.ages)
        # The table of ages has no entry for cells that were never fixated, and for the cell that is fixated now.
        back = torch.where(ages >= 0, self.back[ages.clamp(min=0)], 0.0)
        return self.pull * standardised(values) + (self.place + self.step[steps] + back).to(values)

    def extra_repr(self) -> str:
        """Its columns and rows."""
        return f"columns={self.columns}, rows={len(self.place) // self.columns}"

    def _record(self) -> dict[str, Any]:
        """Number of columns of the grid."""
        return {"columns": self.columns}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The tables from a file's record and tensors."""
        tables = {name: tensors[name] for name in ("place", "step", "edges", "back", "ages")}
        return cls(float(tensors["pull"]), **tables, columns=record["columns"], metadata=record["metadata"])


class Habitual(Choice):
    """Choose the next fixation as people do: draw it by `GazeHabits` from the values of an acquisition function.

    It keeps its own memory of when each cell was fixated, and may return to visited cells. Make a new one for each
    `semfov.rollout`.

    Args:
        noise: random numbers to draw with.
        habits: the fitted model.
        grid: the cells.

    >>> from semfov.gaze.choice import drawn_from
    >>> grid = Grid(2, 1, (20, 10))
    >>> habits = GazeHabits(50.0, torch.zeros(2), torch.zeros(1), [], torch.zeros(1), [], 2)
    >>> choice = Habitual(drawn_from(torch.full((1, 1, 2), 0.5)), habits, grid)
    >>> choice(0, torch.tensor([0]), torch.tensor([[1.0, 0.0]]), torch.tensor([[True, False]]), grid.centres)[1]
    tensor([0])
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
        """Return the centre of the drawn cell and the cell."""
        if shift == 0:
            # At the first choice all episodes take part, and only their start cells were fixated.
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
    """Scale values to mean 0 and variance 1 over the cells; 0 everywhere where all are equal.

    >>> standardised(torch.tensor([[1.0, 3.0], [2.0, 2.0]]))
    tensor([[-1.,  1.],
            [ 0.,  0.]])

    Shapes: values `(..., X·Y)`.
    """
    apart = values - values.mean(-1, keepdim=True)
    spread = apart.square().mean(-1, keepdim=True).sqrt()
    # A spread as small as this is a rounding error of equal values.
    least = 1e-6 * values.abs().amax(-1, keepdim=True) + torch.finfo(values.dtype).tiny
    return torch.where(spread > least, apart / spread.clamp(min=torch.finfo(values.dtype).tiny), 0.0)


def step_bins(grid: Grid, cell: Tensor, edges: Tensor) -> Tensor:
    """Bin of the distance from each cell `(...)` to all, `(..., X·Y)`; a distance on an edge is in the lower bin."""
    return torch.bucketize(grid.cell_distance.to(edges)[cell], edges)


def age_bins(age: Tensor, ages: Tensor) -> Tensor:
    """Bin of every age `(...)`; -1 where the age is 0 or infinite."""
    return torch.where((age > 0) & age.isfinite(), torch.bucketize(age.to(ages).contiguous(), ages), -1)
