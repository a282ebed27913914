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

    Attributes:
        picture: `(n,)`, number of the picture.
        subject: `(n,)`, number of the person.
        cell: `(n,)`, the fixated cell.
        next_cell: `(n,)`, the cell that was fixated next, possibly the same one.
        age: `(n, X·Y)`, number of fixations since each cell was last fixated; infinite if it never was.
        values: `(n, X·Y)` for each policy, its values of all cells.
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

    Args:
        fixations: fixations of P people.
        grid: the grid of cells.

    Returns:
        The cells `(P, n)`, with the last one repeated as padding, and the number of fixations of each person `(P,)`,
        which is 0 if all of them are outside the picture.
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

    Args:
        cells: `(P, n)`, cells that each person fixated.
        count: `(P,)`, number of fixations of each person.
        grid: the grid of cells.
        picture: number of the picture.
        subject: `(P,)`, numbers of the people.

    Returns:
        The choices.
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

    Args:
        looks: looks at the picture from every cell.
        observer: the observer, which turns looks into a belief.
        acquire: makes the acquisition function for episodes that fixate the cells `(A,)`.
        cells: `(P, n)`, cells that each person fixated.
        count: `(P,)`, number of fixations of each person.

    Returns:
        Values `(n, X·Y)`, in the order of `choices_in`.
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
