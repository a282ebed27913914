"""Acquisition functions of ideal searchers, which know how visible the target is from every fixation."""

from abc import abstractmethod

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.observation import FovealObservationModel, visibility
from semfov.precision import exact_product

# Where nothing is visible the answer is a guess: with this signal each of n equal cells is right with 1/n.
_LEAST_SIGNAL = 1e-4


class _SignalSearch(AcquisitionFunction):
    """Base of the ideal searchers of Najemnik and Geisler: one target is seen through Gaussian noise."""

    target: Tensor
    signal: Tensor

    def __init__(self, target: int | Tensor, model: FovealObservationModel, grid: Grid) -> None:
        super().__init__()
        self.register_buffer("target", torch.as_tensor(target))
        level = model.level(grid.cell_distance)
        self.register_buffer("signal", visibility(model).detach()[self.target][..., level])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)`."""
        # As the search went on, the target was not in a fixated cell.
        place = belief.chance(self.target).masked_fill(visited, 0)
        total = place.sum(-1, keepdim=True)
        place = place / total.clamp(min=torch.finfo(place.dtype).tiny)  # q
        signal = self.signal.to(place).expand(len(place), -1, -1)
        return one_by_one(self.values, place, signal)

    @abstractmethod
    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """Compute values `(B, X·Y)` from the prior of the place `(B, X·Y)` and d' `(B, f, x)`."""


class EntropyLimit(_SignalSearch):
    r"""Entropy limit minimisation: expected decrease, by a look, of the entropy of the target's place, in the limit.

    .. math:: a(f) = \frac{1}{2} \sum_x q(x) \, d'^2(x, f), \qquad q \propto P(t \in x)

    This is the ELM rule of Najemnik and Geisler (2009), in nats. It costs little: a sum over the cells for each
    fixation. In 73 to 88 % of 150 random beliefs, by the size of the grid, it makes the ideal searcher's choice
    (`python -m benchmarks.searchers`).

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"], miss_rate=missed).requires_grad_(False)
    >>> belief = DirichletBelief(torch.ones(1, 3, 2))
    >>> EntropyLimit(1, model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "entropy-limit"
    tasks = ("search",)
    by_place = True

    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """Compute the sum, in nats."""
        return exact_product(signal.square(), place[..., None])[..., 0] / 2


class CorrectLocalisation(_SignalSearch):
    r"""Probability that the target is in the most probable cell after a look: the Bayesian ideal searcher.

    The cell x of the target gives a response :math:`W_x \sim N(1/2, 1/d'^2)`, and every other cell one of
    :math:`N(-1/2, 1/d'^2)`. A response multiplies the cell's probability by :math:`e^{d'^2 W}`. With q as in
    `EntropyLimit`,

    .. math:: a(f) = \sum_x q(x) \int \varphi(w) \prod_{y \ne x} \Phi\left(
              \frac{2 \ln (q(x) / q(y)) + d_y'^2 + d_x'^2 + 2 d_x' w}{2 d_y'}\right) dw

    (Najemnik and Geisler, 2005, the next fixation of the ideal searcher.) The integral is computed as a sum over
    equidistant w, which is differentiable where d' is. The cost grows with the third power of the number of cells, so
    this is a reference for small grids.

    Args:
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, with miss rates.
        grid: the cells of one image.
        nodes: number of values of w, from -5 to 5; at least 8.

    Raises:
        InputError: `nodes` is less than 8.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"], miss_rate=missed).requires_grad_(False)
    >>> belief = DirichletBelief(torch.ones(1, 3, 2))
    >>> CorrectLocalisation(1, model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "ideal-observer"
    tasks = ("search",)
    by_place = True

    def __init__(self, target: int | Tensor, model: FovealObservationModel, grid: Grid, *, nodes: int = 64) -> None:
        super().__init__(target, model, grid)
        check(nodes >= 8, "nodes", "8 or more", nodes)
        self.nodes = nodes

    def values(self, place: Tensor, signal: Tensor) -> Tensor:
        """Compute the integral, for one fixation at a time: all of them at once would fill the memory."""
        integrals = [_correct_localisation(place, d, nodes=self.nodes) for d in signal.unbind(-2)]
        return torch.stack(integrals, -1)


def _correct_localisation(place: Tensor, signal: Tensor, *, nodes: int = 64) -> Tensor:
    """Compute `CorrectLocalisation` for one fixation.

    Args:
        place: q, the prior of the place, `(..., X·Y)`.
        signal: d' in each cell, `(..., X·Y)`.
        nodes: number of values of the noise w.

    Returns:
        `(...)`.
    """
    place = place.to(torch.promote_types(place.dtype, signal.dtype))
    noise = torch.linspace(-5, 5, nodes, dtype=place.dtype, device=place.device)
    weight = (-noise.square() / 2).softmax(0)  # φ(w) dw
    d = signal.clamp(min=_LEAST_SIGNAL)
    log_place = place.clamp(min=torch.finfo(place.dtype).tiny).log()
    half_square = d.square() / 2
    # Dimensions: the cell x of the target, every other cell y, and the noise w in x.
    log_odds = log_place[..., :, None] - log_place[..., None, :]
    lead = log_odds + half_square[..., :, None] + half_square[..., None, :]
    response = (d[..., None] * noise)[..., None, :]
    d_of_other = d[..., None, :, None]
    beaten = torch.special.ndtr((lead[..., None] + response) / d_of_other)
    # No cell competes with itself.
    itself = torch.eye(place.shape[-1], dtype=torch.bool, device=place.device)[..., None]
    right = exact_product(torch.where(itself, 1.0, beaten).prod(-2), weight)
    return (place * right).sum(-1)
