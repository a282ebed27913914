"""People's next fixations as choices among cells, with the value that a policy gives to every cell at that moment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Observer
from semfov.data.fixations import Fixations
from semfov.episode import Looks, rollout
from semfov.gaze.acquisition import AcquisitionFunction
from semfov.gaze.choice import Given


@dataclass(frozen=True)
class Choices:
    """n choices of the next fixation.

    Shapes: picture `(n,)`, subject `(n,)`, cell `(n,)`, next_cell `(n,)`, age `(n, X·Y)`, values `(n, X·Y)`.
    """

    picture: Tensor
    subject: Tensor
    cell: Tensor
    next_cell: Tensor
    age: Tensor
    values: Mapping[str, Tensor]

    def __len__(self) -> int:
        return len(self.next_cell)

    def __getitem__(self, index: Tensor) -> Choices:
        """Select choices by index or mask."""
        tensors = {name: getattr(self, name)[index] for name in ("picture", "subject", "cell", "next_cell", "age")}
        return Choices(**tensors, values={name: values[index] for name, values in self.values.items()})

    @classmethod
    def join(cls, several: Sequence[Choices]) -> Choices:
        """Join the choices of several pictures."""
        names = ("picture", "subject", "cell", "next_cell", "age")
        tensors = {name: torch.cat([getattr(some, name) for some in several]) for name in names}
        values = {name: torch.cat([some.values[name] for some in several]) for name in several[0].values}
        return cls(**tensors, values=values)


def fixated_cells(fixations: Sequence[Fixations], grid: Grid) -> tuple[Tensor, Tensor]:
    """Convert people's fixations to cells. Fixations outside the picture are left out.

    Shapes: → `(P, n)`.
    """
    rows = [grid.cell_of(torch.as_tensor(each.points[each.inside], dtype=torch.float32)) for each in fixations]
    count = torch.tensor([len(row) for row in rows])
    longest = max(1, int(count.max()))
    cells = torch.zeros(len(rows), longest, dtype=torch.int64)
    for number, row in enumerate(rows):
        if len(row):
            cells[number] = torch.cat([row, row[-1:].expand(longest - len(row))])
    return cells, count


def choices_in(cells: Tensor, count: Tensor, grid: Grid, picture: int, subject: Tensor) -> Choices:
    """List the choices in one picture, person by person, without the values of policies.

    Shapes: cells `(P, n)`, count `(P,)`, subject `(P,)`.
    """
    by_shift = []
    age = torch.full((len(cells), len(grid)), torch.inf)
    for shift in range(cells.shape[1] - 1):
        age = (age + 1).scatter(-1, cells[:, shift, None], 0.0)
        by_shift.append(age)
    going = torch.arange(cells.shape[1] - 1) < count[:, None] - 1
    ages = torch.stack(by_shift, 1)[going] if by_shift else age[:0]
    people = subject[:, None].expand(going.shape)[going]
    return Choices(torch.full_like(people, picture), people, cells[:, :-1][going], cells[:, 1:][going], ages, {})


def values_in(
    looks: Looks,
    observer: Observer,
    acquire: Callable[[Tensor], AcquisitionFunction],
    cells: Tensor,
    count: Tensor,
) -> Tensor:
    """Compute the values that a policy gives to all cells at every choice.

    The belief at each choice results from looks at the cells that the person has fixated so far.

    Shapes: acquire `(A,)`, cells `(P, n)`, count `(P,)`.
    """
    seeing = (count > 1).nonzero()[:, 0]
    table = torch.zeros(len(cells), cells.shape[1] - 1, len(looks.grid))
    steps = rollout(
        looks,
        observer,
        lambda _, cell: acquire(cell),
        cells[seeing, 0],
        Given(cells[seeing]),
        most=cells.shape[1] - 1,
        ends=lambda step: step.shift + 2 >= count[seeing[step.episodes]],
    )
    for step in steps:
        table[seeing[step.episodes], step.shift] = step.values.to(table)
    return table[torch.arange(cells.shape[1] - 1) < count[:, None] - 1]
