"""Exploration that looks where most additional cells are expected to be classified correctly."""

from torch import Tensor

from semfov.belief import Grid
from semfov.belief.belief import Belief, dirichlet_belief, one_by_one
from semfov.errors import InputError, check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import acuity
from semfov.gaze.acquisition.lookahead import at_levels
from semfov.observation.foveal import FovealObservationModel
from semfov.precision import exact_product

_CORRECTED = 0.3  # c, by least squares 0.32 in explorations of photographs


class ExpectedAccuracy(AcquisitionFunction):
    r"""Expected number of additional cells that the map classifies correctly after one more look.

    The present map is correct in a cell with objects with probability :math:`\max_{k \ge 1} p_k`. From level n an
    object of class k is detected with probability :math:`v_{kn} = 1 - m_{kn}`, and is then classified correctly with
    probability :math:`c_{kn}`. If it is missed, its probability shrinks by the miss rate m. So

    .. math:: a(f) = \sum_x \Bigl[\sum_{k \ge 1} p_k v_{kn} c_{kn} + \max_{k \ge 1} p_k m_{kn} -
              \max_{k \ge 1} p_k\Bigr]_+, \qquad n = n(d(x, f))

    Cells whose object is known have no gain, and cells that clearly are background have none. The gaze is drawn to
    cells where something may have been missed. Use it with an observer that models misses
    (`semfov.observers.Semantic(misses=...)`).

    Args:
        model: the observation model, with miss rates; c is its expected score of the true class.
        grid: the cells of one image.

    Raises:
        InputError: the model has no miss rates.

    A fovea that detects well up to 0.4 image widths sees all of three cells from the central one:

    >>> import torch
    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.stack([8 * torch.eye(3) + 1, torch.eye(3) + 1], 1)
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8], [0.1, 0.8]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup", "cat"], miss_rate=missed).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[2.0, 1.0, 1.0]]).repeat(1, 3, 1))
    >>> ExpectedAccuracy(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "expected-accuracy"
    tasks = ("exploration",)
    levels: Tensor
    miss: Tensor
    named: Tensor

    def __init__(self, model: FovealObservationModel, grid: Grid) -> None:
        super().__init__()
        if model.miss_rate is None:
            raise InputError("model: expected an observation model with miss rates, got one without them")
        right = model.expected_scores().detach().diagonal(dim1=0, dim2=2).t()
        self.register_buffer("levels", model.level(grid.cell_distance))
        self.register_buffer("miss", model.miss_rate[1:])
        self.register_buffer("named", (1 - model.miss_rate[1:]) * right[1:])

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(..., X·Y)`, in cells, for a belief `(..., X·Y, K+1)`."""
        dirichlet = dirichlet_belief(belief)
        check_shape(dirichlet.beta, "beta", self.levels.shape[-1], None)
        objects = dirichlet.probabilities[..., 1:]
        detected = exact_product(objects, self.named.to(objects))
        missed = (objects[..., None] * self.miss.to(objects)).amax(-2)
        gain = (detected + missed - objects.amax(-1, keepdim=True)).clamp(min=0)
        return at_levels(gain, self.levels).sum(-2)


class ExpectedGain(AcquisitionFunction):
    r"""Expected number of additional cells that the map classifies correctly after a look, :math:`E[\Delta \mid f]`.

    .. math:: a(f) = c \sum_x \bigl(1 - \max_k p_k(x)\bigr) \bigl[v(d(x, f)) - v(d^*(x))\bigr]_+

    The map is wrong in a cell with probability :math:`1 - \max_k p_k`, background included. A look corrects a share c
    of the wrong cells where it adds a full acuity v to that of their closest look (`CloserLook`). An exploration can
    end when no look is expected to gain more than it costs (`semfov.ActivePerception.explore(min_gain=...)`).

    Args:
        grid: the cells of one image.
        fovea: width of the fovea in units of the image's longer side (100 px of 640 by default).

    Raises:
        InputError: `grid` is no grid, or `fovea` is not positive.

    >>> import torch
    >>> from semfov import DirichletBelief
    >>> belief = DirichletBelief(torch.ones(1, 3, 4), torch.tensor([[0.0, 1 / 3, 2 / 3]]))
    >>> ExpectedGain(Grid(3, 1, (90, 30)))(belief, torch.tensor([[True, False, False]])).argmax()
    tensor(1)
    """

    name = "expected-gain"
    tasks = ("exploration",)
    distance: Tensor

    def __init__(self, grid: Grid, fovea: float = 100 / 640) -> None:
        super().__init__()
        check(isinstance(grid, Grid), "grid", "a Grid", type(grid).__name__)
        check(fovea > 0, "fovea", "a positive number", fovea)
        self.fovea = fovea
        self.register_buffer("distance", grid.cell_distance)

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)`, in cells, for a belief about all classes that has `closest` distances."""
        distance = self.distance.to(belief.closest)

        def gain(probabilities: Tensor, closest: Tensor) -> Tensor:
            return corrected_cells(probabilities, closest, distance, self.fovea).sum(-1)

        return one_by_one(gain, belief.class_probabilities(), belief.closest)


def corrected_cells(probabilities: Tensor, closest: Tensor, distance: Tensor, fovea: float) -> Tensor:
    """Compute the probability that a look corrects each cell: the terms of `ExpectedGain`.

    Args:
        probabilities: `(B, X·Y, K+1)`, class probabilities of a map.
        closest: `(B, X·Y)`, from each cell to its closest fixation so far, in longer sides of the image.
        distance: `(F, X·Y)`, from each of F possible fixations to every cell.
        fovea: width of the fovea, in the same unit.

    Returns:
        `(B, F, X·Y)`.
    """
    wrong = 1 - probabilities.amax(-1)
    sharper = (acuity(distance, fovea) - acuity(closest, fovea)[:, None]).clamp(min=0)
    return _CORRECTED * wrong[:, None] * sharper
