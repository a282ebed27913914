"""Acquisition functions of visual search, computed from the probability of the target in each cell."""

import torch
from torch import Tensor

from semfov.belief.belief import Belief, dirichlet_belief, pick
from semfov.belief.grid import Grid
from semfov.errors import check, check_shape
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.lookahead import at_levels, look_ahead, look_ahead_by_samples
from semfov.observation.foveal import FovealObservationModel


class TargetPosterior(AcquisitionFunction):
    r"""Probability that a cell holds the target class: non-predictive search.

    .. math:: a(x) = P(C^x = t) = \beta_t(x) / \sum_j \beta_j(x)

    for a Dirichlet belief (Luzio, Bernardino and Moreno, 2024, Non-Predictive Visual Search). Other beliefs define the
    probability themselves (`Belief.chance`).

    Args:
        target: index of the target class, 1..K, or a tensor `(B,)` with one for each episode.

    >>> from semfov import DirichletBelief
    >>> belief = DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))
    >>> TargetPosterior(1)(belief, torch.zeros(1, 2, dtype=torch.bool))
    tensor([[0.7500, 0.5000]])
    """

    name = "non-predictive"
    tasks = ("search",)
    target: Tensor

    def __init__(self, target: int | Tensor) -> None:
        super().__init__()
        self.register_buffer("target", torch.as_tensor(target))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(B, X·Y)`."""
        return belief.chance(self.target)


class PredictedTargetPosterior(AcquisitionFunction):
    r"""Probability of the target in a cell after one more look at the cell, with expected scores: predictive search.

    The scores expected of this foveal look enter one simulated update by Kaplan's rule:

    .. math:: \bar S_0 = \sum_k p_k \, \frac{\alpha_{k,0}}{\sum_j \alpha_{k,0,j}}, \qquad
              a(x) = \frac{\bar\beta_t}{\sum_k \bar\beta_k} = p_t \frac{T + r_t}{T + 1}, \quad
              r_t = \frac{\bar S_{0,t}}{\sum_j p_j \bar S_{0,j}}, \quad T = \sum_j \beta_j

    (Luzio, Bernardino and Moreno, 2024, Predictive Visual Search.) The expected scores are not calibrated again. This
    is the plug-in :math:`\beta'(E[S])`, and not the expectation over S. With `likelihoods` of drawn looks it is the
    expectation, which equals :math:`p_t` if they are the true likelihoods:

    .. math:: E[p'_t] = \frac{T p_t + E[p_t \lambda_t / \sum_j p_j \lambda_j]}{T + 1} = p_t, \qquad
              E\Bigl[\frac{p_t \lambda_t}{\sum_j p_j \lambda_j}\Bigr] =
              \int \frac{p_t \lambda_t(S)}{\sum_j p_j \lambda_j(S)} \sum_j p_j \lambda_j(S) \, dS = p_t

    Args:
        target: index of the target class, 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, for the expected scores.
        likelihoods: `(K+1, N, M, K+1)`, likelihoods of drawn looks
            (`semfov.gaze.acquisition.lookahead.sampled_likelihoods`), of which those at level 0 count; None is the
            published plug-in.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> model = FovealObservationModel(torch.tensor([[[9.0, 1.0]], [[1.0, 9.0]]]), [], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]]))
    >>> PredictedTargetPosterior(1, model)(belief, torch.zeros(1, 2, dtype=torch.bool)).argmax()
    tensor(0)
    """

    name = "predictive"
    tasks = ("search",)
    target: Tensor
    likelihoods: Tensor | None

    def __init__(
        self, target: int | Tensor, model: FovealObservationModel, *, likelihoods: Tensor | None = None
    ) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("target", torch.as_tensor(target))
        self.register_buffer("likelihoods", likelihoods, persistent=False)

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        beta = dirichlet_belief(belief).beta
        if self.likelihoods is None:
            outlook = look_ahead(beta, self.model.expected_scores()[:, :1])
        else:
            outlook = look_ahead_by_samples(beta, self.likelihoods[:, :1], visited)
        return pick(outlook.next_mean, self.target).mean(-1)


class NeighbourhoodPosterior(AcquisitionFunction):
    r"""Expected probability of the target in and around a cell after a fixation of that cell.

    .. math:: a(f) = \sum_x \exp\left(-\frac{\|x - f\|^2}{2 \varsigma^2}\right) \bar p_t(x \mid f)

    :math:`\bar p` is the predicted map, in which every cell is seen at the level of its distance to f. The outlook of
    Luzio, Bernardino and Moreno (2024) proposes it: "the semantic information available in the cells surrounding a
    potential fixation point, which can be extracted from" the predicted map, weighted "according to their distance to
    the focal point". The paper gives no weights; the Gaussian is our choice.

    Args:
        target: index of the target class, 1..K, or a tensor `(B,)` with one for each episode.
        model: the observation model, for the expected scores.
        grid: the cells of one image.
        sigma: ς in cells, positive.

    Raises:
        InputError: `sigma` is not positive.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.ones(1, 3, 2))
    >>> NeighbourhoodPosterior(1, model, Grid(3, 1, (30, 10)))(belief, torch.zeros(1, 3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "neighbourhood"
    tasks = ("search",)
    target: Tensor
    levels: Tensor
    kernel: Tensor

    def __init__(self, target: int | Tensor, model: FovealObservationModel, grid: Grid, *, sigma: float = 0.7) -> None:
        super().__init__()
        check(sigma > 0, "sigma", "a positive number of cells", sigma)
        self.model = model
        self.register_buffer("target", torch.as_tensor(target))
        self.register_buffer("levels", model.level(grid.cell_distance))
        cell = torch.arange(len(grid))
        column = cell % grid.columns
        row = cell // grid.columns
        place = torch.stack([column, row], -1).to(torch.get_default_dtype())
        distance = torch.cdist(place, place)  # (X·Y, X·Y), in cells
        self.register_buffer("kernel", (-distance.square() / (2 * sigma**2)).exp())

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute values `(..., X·Y)` for a belief `(..., X·Y, K+1)`."""
        beta = dirichlet_belief(belief).beta
        check_shape(beta, "beta", self.levels.shape[-1], None)
        outlook = look_ahead(beta, self.model.expected_scores())
        predicted = at_levels(pick(outlook.next_mean, self.target), self.levels)  # (..., x, f)
        return (predicted * self.kernel.to(predicted)).sum(-2)
