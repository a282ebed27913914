"""Acquisition functions of ideal searchers, which know how well they see: what will a look tell of the place?"""

from abc import abstractmethod
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.observation.separation import ScoringModel, visibility

# Cells that cannot be seen at all are told apart by noise alone: each of n equal ones is right with 1/n.
_LEAST_SIGNAL = 1e-4


class SignalModel(ScoringModel, Protocol):
    """What these functions need of an observation model (`semfov.FovealObservationModel`)."""

    def level(self, distance: Tensor) -> Tensor:
        """Level of each distance, `(...)` from 0 to N - 1."""
        ...


class SignalSearch(AcquisitionFunction):
    """Base of the ideal searchers of Najemnik and Geisler: one target, somewhere, seen through normal noise.

    The prior of the target's place is the belief's probability in every cell, scaled to sum to 1 over the cells that
    were not fixated: a search that goes on has not found it there.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates (`semfov.observation.visibility`).
        grid: the cells of one image.

    Attributes:
        signal: `(..., f, x)`, d' of a target in cell x seen from f, for each target.
    """

    target: Tensor
    signal: Tensor

    def __init__(self, target: int | Tensor, model: SignalModel, grid: Grid) -> None:
        super().__init__()
        self.register_buffer("target", torch.as_tensor(target))
        level = model.level(grid.cell_distance)
        self.register_buffer("signal", visibility(model).detach()[self.target][..., level])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`."""
        place = belief.chance(self.target).masked_fill(visited, 0)
        place = place / place.sum(-1, keepdim=True).clamp(min=torch.finfo(place.dtype).tiny)
        return one_by_one(self.values, place, self.signal.to(place).expand(len(place), -1, -1))

    @abstractmethod
    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """Values `(B, X·Y)` for the probability of the place `(B, X·Y)` and d' `(B, f, x)`."""


class EntropyLimit(SignalSearch):
    r"""Entropy limit minimisation: how much a look is expected to lower the entropy of the target's place, at most.

    .. math:: a(f) = \frac{1}{2} \sum_x q(x) \, d'^2(x, f), \qquad q \propto P(t \in x)

    (Najemnik and Geisler, 2009, the entropy limit minimisation rule, ELM; in nats.) It is the ideal searcher's choice
    in nearly all cases at a small part of the cost: a sum over the cells for each fixation.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.
    """

    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """The sum."""
        return (signal.square() @ place[..., None])[..., 0] / 2


class CorrectLocalisation(SignalSearch):
    r"""Probability that the most probable cell is the target's after a look: the Bayesian ideal searcher.

    A target in x answers with :math:`W_x \sim N(1/2, 1/d'^2)` and every other cell with :math:`N(-1/2, 1/d'^2)`, which
    multiplies its probability by :math:`e^{d'^2 W}`. With q as in `EntropyLimit`,

    .. math:: a(f) = \sum_x q(x) \int \varphi(w) \prod_{y \ne x} \Phi\left(
              \frac{2 \ln (q(x) / q(y)) + d_y'^2 + d_x'^2 + 2 d_x' w}{2 d_y'}\right) dw

    (Najemnik and Geisler, 2005, the next fixation of the ideal searcher.) The integral is a sum over equidistant w,
    smooth where d' is. Its cost grows with the third power of the number of cells: it is a reference for small grids.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.
        nodes: number of w, from -5 to 5.
    """

    def __init__(self, target: int | Tensor, model: SignalModel, grid: Grid, *, nodes: int = 64) -> None:
        super().__init__(target, model, grid)
        check(nodes >= 8, "nodes", "8 or more", nodes)
        self.nodes = nodes

    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """The integral, a fixation at a time."""
        return torch.stack([correct_localisation(place, d, nodes=self.nodes) for d in signal.unbind(-2)], -1)

    def extra_repr(self) -> str:
        """Settings, for `repr`."""
        return f"nodes={self.nodes}"


def correct_localisation(place: Tensor, signal: Tensor, *, nodes: int = 64) -> Tensor:
    """Probability that the most probable place is right after a look; see `CorrectLocalisation`.

    Args:
        place: `(..., X·Y)`, prior q.
        signal: `(..., X·Y)`, d' of every cell from the fixation, not negative.
        nodes: of the integral.

    Returns:
        `(...)`.

    >>> even = torch.full((4,), 0.25)
    >>> correct_localisation(even, torch.zeros(4)), correct_localisation(even, torch.full((4,), 9.0))
    (tensor(0.2500), tensor(1.0000))
    """
    noise = torch.linspace(-5, 5, nodes, dtype=place.dtype, device=place.device)
    weight = (-noise.square() / 2).softmax(0)
    d = signal.clamp(min=_LEAST_SIGNAL)
    # Cells of the target x and of its rivals y, and the noise w in x.
    log, half = place.clamp(min=torch.finfo(place.dtype).tiny).log(), d.square() / 2
    ahead = log[..., :, None] - log[..., None, :] + half[..., :, None] + half[..., None, :]
    heard = (d[..., None] * noise)[..., None, :]
    beaten = torch.special.ndtr((ahead[..., None] + heard) / d[..., None, :, None])
    itself = torch.eye(place.shape[-1], dtype=torch.bool, device=place.device)[..., None]
    right = torch.where(itself, 1.0, beaten).prod(-2) @ weight
    return (place * right).sum(-1)
