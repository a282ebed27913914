"""How the next fixation is chosen from the values of the cells."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from semfov.errors import check, check_whole
from semfov.gaze.relaxation import soft_fixation
from semfov.gaze.selection import select_fixation

Noise = Callable[[int, Tensor], Tensor]
"""Random numbers `(A, X·Y)` in [0, 1) for the n-th choice of some episodes `(A,)`."""


class Choice(ABC):
    """Base of all ways to choose the next fixation."""

    @abstractmethod
    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next fixation `(A, 2)` and its cell `(A,)`; any cell where all were visited.

        Args:
            shift: gaze shifts that were made before.
            episodes: `(A,)`, numbers of the episodes that go on.
            values: `(A, X·Y)`, acquisition values.
            visited: `(A, X·Y)` boolean, cells that are out.
            centres: `(X·Y, 2)`, of the cells.
        """


class Greedy(Choice):
    """The best cell not visited (`select_fixation`).

    Args:
        noise: breaks ties.
    """

    def __init__(self, noise: Noise) -> None:
        self.noise = noise

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The centre of the best cell; the first cell where all were visited."""
        cell = select_fixation(values, visited, self.noise(shift, episodes)).clamp(min=0)
        return centres[cell], cell


class Exploratory(Greedy):
    """`Greedy` with some fixations astray, which training needs to see all cells.

    Args:
        noise: breaks ties, and draws: other numbers whenever it is asked.
        astray: probability of a fixation at random.
    """

    def __init__(self, noise: Noise, astray: float) -> None:
        super().__init__(noise)
        self.astray = astray

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The best cell, or any."""
        lost = self.noise(shift, episodes)[:, :1] < self.astray
        return super().__call__(shift, episodes, torch.where(lost, 0.0, values.detach()), visited, centres)


class Softmax(Choice):
    r"""A noisy choice: a cell not visited is drawn with :math:`P(x) \propto e^{b \, a(x)}`.

    With b = 0 all cells are equally likely; the larger b, the nearer it comes to `Greedy`. The draw is that of
    `soft_fixation` and so of the random numbers alone. No gradient flows through it.

    Args:
        noise: draws.
        inverse_temperature: b, 0 or more, in units of one over those of the values.

    >>> noise = drawn_from(torch.rand(1, 1, 3, generator=torch.Generator().manual_seed(0)))
    >>> values, centres = torch.tensor([[0.0, 1.0, 2.0]]), torch.zeros(3, 2)
    >>> Softmax(noise, 9.0)(0, torch.tensor([0]), values, torch.tensor([[False, False, True]]), centres)[1]
    tensor([1])
    """

    def __init__(self, noise: Noise, inverse_temperature: float) -> None:
        check(inverse_temperature >= 0, "inverse_temperature", "0 or more", inverse_temperature)
        self.noise = noise
        self.inverse_temperature = inverse_temperature

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The drawn cell's centre; any cell where all were visited."""
        logits = self.inverse_temperature * values.detach()
        return soft_fixation(logits, visited, centres, self.noise(shift, episodes))


class Relaxed(Choice):
    """A draw by Gumbel-softmax, through which gradients flow (`soft_fixation`).

    Args:
        noise: draws.
        cell_of: cell of a soft point.
        temperature: of the softmax.
        hard: straight-through, or the soft point.
    """

    def __init__(
        self, noise: Noise, cell_of: Callable[[Tensor], Tensor], *, temperature: float = 1.0, hard: bool = True
    ) -> None:
        self.noise = noise
        self.cell_of = cell_of
        self.temperature = temperature
        self.hard = hard

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The drawn fixation."""
        drawn = self.noise(shift, episodes)
        fixation, cell = soft_fixation(values, visited, centres, drawn, temperature=self.temperature, hard=self.hard)
        return fixation, cell if self.hard else self.cell_of(fixation.detach())


class Given(Choice):
    """A scanpath that is known already.

    Args:
        cells: `(B, n)`, the cells that each episode fixates, the start first.
    """

    def __init__(self, cells: Tensor) -> None:
        self.cells = cells

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The next cell of the scanpath; its last one at the end."""
        cell = self.cells[episodes, min(shift + 1, self.cells.shape[1] - 1)]
        return centres[cell], cell


def first_cell(start: int | None, seed: int, cells: int) -> tuple[int, torch.Generator]:
    """The cell that an episode fixates first, and the generator that breaks its ties.

    Args:
        start: the cell; None draws one.
        seed: of the generator.
        cells: how many there are.

    >>> first_cell(3, 0, 100)[0]
    3
    """
    check_whole(seed, "seed", 0, 2**63 - 1)
    generator = torch.Generator().manual_seed(int(seed))
    if start is None:
        return int(torch.randint(cells, (1,), generator=generator)), generator
    check_whole(start, "start", 0, cells - 1)
    return int(start), generator


def drawn_from(noise: Tensor) -> Noise:
    """Random numbers from a table `(B, shifts, X·Y)`."""
    return lambda shift, episodes: noise[episodes, shift]


def drawn_by(generator: torch.Generator, cells: int, like: Tensor) -> Noise:
    """Random numbers as they are needed; dtype and device as `like`."""
    return lambda shift, episodes: torch.rand(len(episodes), cells, generator=generator).to(like)
