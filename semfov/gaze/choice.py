"""Rules that choose the next fixation from the acquisition values of cells: the best cell, or a random one."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from semfov.errors import check, check_shape, values_known
from semfov.precision import exact_product

_Noise = Callable[[int, Tensor], Tensor]
"""Maps the number of a gaze shift and the numbers of A episodes `(A,)` to random numbers `(A, X·Y)` in [0, 1)."""


class Choice(ABC):
    """Base of all rules that choose the next fixation.

    A subclass implements `__call__`, which `semfov.rollout` calls once for every gaze shift.

    >>> class First(Choice):
    ...     def __call__(self, shift, episodes, values, visited, centres):
    ...         cell = (~visited).long().argmax(-1)
    ...         return centres[cell], cell
    >>> First()(0, torch.tensor([0]), torch.zeros(1, 2), torch.tensor([[True, False]]), torch.zeros(2, 2))[1]
    tensor([1])
    """

    @abstractmethod
    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Choose the next fixation `(A, 2)` of each episode from values `(A, X·Y)`, and its cell `(A,)`."""


class Greedy(Choice):
    """Choose the cell of the highest value among those not visited (`select_fixation`).

    Args:
        noise: random numbers that break ties.

    >>> choice = Greedy(drawn_from(torch.rand(1, 1, 3)))
    >>> values, centres = torch.tensor([[0.1, 0.7, 0.2]]), torch.zeros(3, 2)
    >>> choice(0, torch.tensor([0]), values, torch.tensor([[False, True, False]]), centres)[1]
    tensor([2])
    """

    def __init__(self, noise: _Noise) -> None:
        self.noise = noise

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the centre of the best cell and the cell; cell 0 where all were visited."""
        cell = select_fixation(values, visited, self.noise(shift, episodes)).clamp(min=0)
        return centres[cell], cell


class Softmax(Choice):
    r"""A noisy choice: sample a cell not visited with probability :math:`P(x) \propto e^{b \, a(x)}`.

    With b = 0 all cells are equally likely. The larger b, the closer the choice is to `Greedy`. Cells are drawn as by
    `soft_fixation`, and the draw depends on the values and the random numbers alone. No gradient flows through it.

    Args:
        noise: random numbers to draw with.
        inverse_temperature: b, 0 or more, in the inverse unit of the values.

    Raises:
        InputError: b is negative.

    >>> noise = drawn_from(torch.rand(1, 1, 3, generator=torch.Generator().manual_seed(0)))
    >>> values, centres = torch.tensor([[0.0, 1.0, 2.0]]), torch.zeros(3, 2)
    >>> Softmax(noise, 9.0)(0, torch.tensor([0]), values, torch.tensor([[False, False, True]]), centres)[1]
    tensor([1])
    """

    def __init__(self, noise: _Noise, inverse_temperature: float) -> None:
        check(inverse_temperature >= 0, "inverse_temperature", "0 or more", inverse_temperature)
        self.noise = noise
        self.inverse_temperature = inverse_temperature

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the centre of the drawn cell and the cell; any cell where all were visited."""
        logits = self.inverse_temperature * values.detach()
        return soft_fixation(logits, visited, centres, self.noise(shift, episodes))


class Relaxed(Choice):
    """Sample a cell by Gumbel-softmax, so that gradients flow through the choice (`soft_fixation`).

    Args:
        noise: random numbers to draw with.
        cell_of: maps points `(A, 2)` to their cells `(A,)`; needed where `hard` is false.
        temperature: temperature of the softmax.
        hard: fixate the centre of the drawn cell with a straight-through gradient; otherwise fixate the mean of all
            centres, weighted by the softmax.

    >>> from semfov import Grid
    >>> choice = Relaxed(drawn_from(torch.full((1, 1, 2), 0.5)), Grid(2, 1, (20, 10)).cell_of)
    >>> values = torch.tensor([[0.0, 9.0]], requires_grad=True)
    >>> point, cell = choice(0, torch.tensor([0]), values, torch.zeros(1, 2).bool(), Grid(2, 1, (20, 10)).centres)
    >>> cell.tolist(), point.requires_grad
    ([1], True)
    """

    def __init__(
        self, noise: _Noise, cell_of: Callable[[Tensor], Tensor], *, temperature: float = 1.0, hard: bool = True
    ) -> None:
        self.noise = noise
        self.cell_of = cell_of
        self.temperature = temperature
        self.hard = hard

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the drawn fixation and its cell."""
        drawn = self.noise(shift, episodes)
        fixation, cell = soft_fixation(values, visited, centres, drawn, temperature=self.temperature, hard=self.hard)
        return fixation, cell if self.hard else self.cell_of(fixation.detach())


class Given(Choice):
    """Choose the cells of a given scanpath.

    Args:
        cells: `(B, n)`, the cells that each episode fixates, the start first.

    >>> centres = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    >>> Given(torch.tensor([[0, 1]]))(0, torch.tensor([0]), torch.zeros(1, 2), torch.zeros(1, 2).bool(), centres)[1]
    tensor([1])
    """

    def __init__(self, cells: Tensor) -> None:
        self.cells = cells

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the centre of the next cell of the scanpath and the cell; the last cell again at the end."""
        cell = self.cells[episodes, min(shift + 1, self.cells.shape[1] - 1)]
        return centres[cell], cell


def select_fixation(values: Tensor, visited: Tensor, noise: Tensor, *, tolerance: float = 1e-6) -> Tensor:
    r"""Choose the cell with the highest acquisition value among those not visited (inhibition of return).

    .. math:: f = \arg\max_{x \notin \mathcal V} a(x)

    Cells whose values equal the best to within `tolerance` (relative) are tied, and the one with the highest
    `noise` wins. A tolerance of a few rounding errors keeps equal beliefs tied, whatever the order of summation.

    Args:
        values: `(B, X·Y)`, acquisition values.
        visited: `(B, X·Y)` boolean, cells that were fixated and may not be chosen.
        noise: `(B, X·Y)`, random numbers in [0, 1) from each episode's own generator.
        tolerance: relative difference up to which values count as equal.

    Returns:
        `(B,)`, the chosen cell, or -1 where every cell has been visited.

    Raises:
        InputError: the shapes differ, or a cell that is not visited has the value NaN.

    >>> select_fixation(torch.tensor([[0.2, 0.9, 0.9]]), torch.tensor([[False, True, False]]), torch.rand(1, 3))
    tensor([2])
    """
    check_shape(values, "values", None, None)
    check_shape(visited, "visited", *values.shape)
    check_shape(noise, "noise", *values.shape)
    if values_known(values, visited):
        unusable = torch.isnan(values) & ~visited
        check(not bool(unusable.any()), "values", "numbers for all cells not visited", f"{int(unusable.sum())} NaN")
    candidates = values.masked_fill(visited, -torch.inf)
    best = candidates.amax(-1, keepdim=True)
    tied = (candidates >= best - tolerance * best.abs()) & ~visited
    choice = torch.where(tied, noise, -1.0).argmax(-1)
    return torch.where(visited.all(-1), -1, choice)


def soft_fixation(
    logits: Tensor,
    visited: Tensor,
    centres: Tensor,
    noise: Tensor,
    *,
    temperature: float = 1.0,
    hard: bool = True,
) -> tuple[Tensor, Tensor]:
    r"""Sample a fixation by Gumbel-softmax over the cells not visited (Jang, Gu and Poole, 2017).

    .. math:: y = \mathrm{softmax}\left(\frac{\ell - \ln(-\ln u)}{\tau}\right), \quad
              x^* = \arg\max_x y(x), \quad \tilde f = \sum_x y(x) \, c(x)

    With `hard` the fixation is the centre of x*, a draw from `softmax(ℓ)`, and has the gradient of the soft point f̃
    (straight-through; Bengio, Léonard and Courville, 2013); otherwise it is f̃ itself.

    Args:
        logits: `(B, X·Y)`, ℓ.
        visited: `(B, X·Y)` boolean, cells that may not be drawn; each row must leave at least one.
        centres: `(X·Y, 2)`, c, centres of the cells in pixels.
        noise: `(B, X·Y)`, u, uniform in [0, 1).
        temperature: τ, positive.
        hard: fixate the centre of x* with a straight-through gradient; otherwise the soft point f̃.

    Returns:
        The fixations `(B, 2)` in pixels, and the drawn cells `(B,)`.

    Raises:
        InputError: the temperature is not positive, or the shapes do not fit together.

    >>> logits = torch.tensor([[0.0, 9.0, 0.0]], requires_grad=True)
    >>> centres = torch.tensor([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    >>> point, cell = soft_fixation(logits, torch.tensor([[True, False, False]]), centres, torch.full((1, 3), 0.5))
    >>> point.tolist(), cell.tolist()
    ([[1.0, 0.0]], [1])
    """
    check(temperature > 0, "temperature", "a positive number", temperature)
    check_shape(logits, "logits", None, None)
    check_shape(visited, "visited", *logits.shape)
    check_shape(noise, "noise", *logits.shape)
    check_shape(centres, "centres", logits.shape[-1], 2)
    # At 0 and 1 the noise would be infinite, and choose a cell whatever its value.
    limits = torch.finfo(noise.dtype)
    uniform = noise.clamp(min=limits.tiny, max=1 - limits.eps)
    gumbel = -(-uniform.log()).log()
    perturbed = (logits + gumbel.to(logits)).masked_fill(visited, -torch.inf)
    weights = (perturbed / temperature).softmax(-1)
    cell = weights.argmax(-1)
    centres = centres.to(weights)
    soft = exact_product(weights, centres)
    if not hard:
        return soft, cell
    # The value is the centre, and the gradient is that of the soft point.
    return centres[cell] + (soft - soft.detach()), cell


def drawn_from(noise: Tensor) -> _Noise:
    """Read random numbers from a table `(B, shifts, X·Y)`, so that an episode can be repeated."""
    return lambda shift, episodes: noise[episodes, shift]


def drawn_by(generator: torch.Generator, cells: int, like: Tensor) -> _Noise:
    """Sample random numbers from a generator when needed, with the dtype and device of `like`."""
    return lambda shift, episodes: torch.rand(len(episodes), cells, generator=generator).to(like)
