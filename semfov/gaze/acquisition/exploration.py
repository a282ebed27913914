"""Acquisition functions of scene exploration that simulate one look at every cell.

The value of a look is the change that a simulated update causes in the map, summed over the cells x
(`semfov.gaze.acquisition.lookahead`); `TwoPeaks` takes the largest change instead. p is the mean and T the sum of a
cell's Dirichlet parameters. A prime or a bar marks their values after the update.

The update is the one with the expected scores E[S], as published. The value F of the updated map is therefore the
plug-in F(β'(E[S])), and not its expectation E[F(β'(S))]. With `likelihoods` of drawn looks, `KLDivergence`,
`BayesianSurprise`, `NegativeEntropy` and `TwoPeaks` take the expectation in each cell.
"""

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.gaze.acquisition.lookahead import Lookahead, Outlook
from semfov.observation.dirichlet import divergence_from_symmetric
from semfov.observation.foveal import FovealObservationModel


class KLDivergence(Lookahead):
    r"""How much a look is expected to raise the divergence of the map from its uniform prior.

    .. math:: a(f) = \sum_x F(\bar\beta(x \mid f)) - F(\beta(x)), \qquad
              F(\beta) = \mathrm{KL}\bigl(\mathrm{Dir}(\beta) \,\|\, \mathrm{Dir}(\beta^0)\bigr)

    with β⁰ the uniform prior, 0.5 for every class (Luzio, Bernardino and Moreno, 2024, Scene Exploration: F and the
    sum over the map that the next fixation maximises). The published value is :math:`\sum_x F(\bar\beta)`. The term of
    the present map is the same for every fixation. It is subtracted because small differences would be lost by rounding
    in a large sum.

    Args:
        model: the observation model.
        grid: the cells.
        prior: β⁰, positive.
        likelihoods: likelihoods of drawn looks, for the expectation over them (`Lookahead`); None is the published
            plug-in of the expected scores.

    Raises:
        InputError: `prior` is not positive.

    A fovea that sees well up to 0.4 image widths sees all of three cells from the central one:

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"])
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> KLDivergence(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "kl"
    tasks = ("exploration",)

    def __init__(
        self, model: FovealObservationModel, grid: Grid, *, prior: float = 0.5, likelihoods: Tensor | None = None
    ) -> None:
        super().__init__(model, grid, likelihoods=likelihoods)
        check(prior > 0, "prior", "a positive number", prior)
        self.prior = prior

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the divergence of each cell from the prior after the simulated look."""
        return divergence_from_symmetric(outlook.next_beta, self.prior)

    def present(self, beta: Tensor) -> Tensor:
        """Compute the divergence of each cell from the prior at present."""
        return divergence_from_symmetric(beta, self.prior)


class BayesianSurprise(Lookahead):
    r"""How much a look is expected to change the map: divergence of the predicted posterior from the present one.

    .. math:: a(f) = \sum_x \mathrm{KL}\bigl(\bar p(x \mid f) \,\|\, p(x)\bigr)

    This is the surprise of Itti and Baldi (2009), of the expected look. `KLDivergence` in contrast is between Dirichlet
    distributions, and from the prior.

    Args:
        model: the observation model.
        grid: the cells.
        likelihoods: likelihoods of drawn looks, for the expectation over them, as for `KLDivergence`.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> BayesianSurprise(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "surprise"
    tasks = ("exploration",)

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the divergence of the predicted posterior from the present one."""
        return _divergence(outlook)


class NegativeEntropy(Lookahead):
    r"""How much a look is expected to lower the entropy of the map.

    .. math:: a(f) = \sum_x H(p(x)) - H(\bar p(x \mid f)), \qquad H(p) = -\sum_k p_k \ln p_k

    (Luzio, Bernardino and Moreno, 2024, Scene Exploration, the classification negentropy.) The published value is
    :math:`-\sum_x H(\bar p)`. The entropy of the present map is the same for every fixation. It is added because small
    differences would be lost by rounding in a large sum.

    Args:
        model: the observation model.
        grid: the cells.
        likelihoods: likelihoods of drawn looks, for the expectation over them, as for `KLDivergence`.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> NegativeEntropy(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "negative-entropy"
    tasks = ("exploration",)

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the decrease of each cell's entropy by the look."""
        surprise = torch.xlogy(outlook.mean, outlook.mean)[..., None, :]
        # H(p) - H(p') = KL(p' || p) + Σ (p' - p) ln p
        return _divergence(outlook) + (outlook.growth * surprise).sum(-1)


class TwoPeaks(Lookahead):
    r"""Largest change, over all cells, of the difference between the two most probable classes of a cell.

    .. math:: a(f) = \max_x |\Delta(p'(x \mid f)) - \Delta(p(x))|, \qquad \Delta(p) = p_{(1)} - p_{(2)}

    (Luzio, Bernardino and Moreno, 2024, Scene Exploration, the expected improvement of the two-peak difference.)

    Args:
        model: the observation model.
        grid: the cells.
        likelihoods: likelihoods of drawn looks, for the expectation over them, as for `KLDivergence`.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.1], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[20.0, 40.0], [1.0, 2.0], [20.0, 40.0]]))
    >>> TwoPeaks(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "two-peaks"
    tasks = ("exploration",)

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the absolute change of the difference between the two most probable classes."""
        return (_lead(outlook.next_mean) - _lead(outlook.mean)[..., None]).abs()

    def pool(self, values: Tensor) -> Tensor:
        """Return the largest change over all cells."""
        return values.amax(-2)


class UpperConfidenceBound(Lookahead):
    r"""How much a look is expected to raise the upper confidence bound of every cell's most probable class.

    .. math:: a(f) = \sum_x U'(x \mid f) - U(x), \qquad U = p_{(1)} + \kappa \sqrt{p_{(1)} (1 - p_{(1)}) / (T + 1)}

    U is the mean of the class's probability plus κ standard deviations, under the Dirichlet belief. The bound is that
    of Srinivas et al. (2010), on the predicted map. The term of the present map does not change the choice.

    Args:
        model: the observation model.
        grid: the cells.
        kappa: κ, number of standard deviations above the mean, 0 or more.

    Raises:
        InputError: `kappa` is negative.

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> UpperConfidenceBound(model, Grid(3, 1, (30, 10)), kappa=0.5)(belief, torch.zeros(3, dtype=torch.bool)).shape
    torch.Size([3])
    """

    name = "upper-confidence-bound"
    tasks = ("exploration",)

    def __init__(self, model: FovealObservationModel, grid: Grid, *, kappa: float = 2.0) -> None:
        super().__init__(model, grid)
        check(kappa >= 0, "kappa", "0 or more", kappa)
        self.kappa = kappa

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the upper confidence bound of each cell after the simulated look."""
        return self._bound(outlook.next_mean, outlook.next_total)

    def present(self, beta: Tensor) -> Tensor:
        """Compute the present upper confidence bound of each cell."""
        total = beta.sum(-1)
        return self._bound(beta / total[..., None], total)

    def _bound(self, mean: Tensor, total: Tensor) -> Tensor:
        """Compute U of beliefs with means `(..., K+1)` and sums of the parameters `(...)`."""
        peak = mean.amax(-1)
        return peak + self.kappa * _deviation(peak, total)


class ProbabilityOfImprovement(Lookahead):
    r"""Probability that a look makes the most probable class of each cell more probable, summed over the cells.

    .. math:: a(f) = \sum_x \Phi\left(\frac{p'_{(1)}(x \mid f) - p_{(1)}(x) - \xi}{\sigma'(x \mid f)}\right), \qquad
              \sigma'^2 = p'_{(1)} (1 - p'_{(1)}) / (T' + 1)

    The marginal of the predicted Dirichlet is approximated by a normal distribution. This is the probability of
    improvement of Kushner (1964), on the predicted map. (A caption of Luzio, Bernardino and Moreno, 2024, gives this
    name to the sum of `KLDivergence`.)

    Args:
        model: the observation model.
        grid: the cells.
        margin: ξ, least increase of the probability that counts as an improvement.

    Raises:
        InputError: `margin` is not in [0, 1).

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"]).requires_grad_(False)
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> ProbabilityOfImprovement(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    name = "probability-of-improvement"
    tasks = ("exploration",)

    def __init__(self, model: FovealObservationModel, grid: Grid, *, margin: float = 0.0) -> None:
        super().__init__(model, grid)
        check(0 <= margin < 1, "margin", "at least 0 and less than 1", margin)
        self.margin = margin

    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the probability that the look makes a cell's most probable class more probable."""
        peak = outlook.next_mean.amax(-1)
        gain = peak - outlook.mean.amax(-1)[..., None] - self.margin
        return torch.special.ndtr(gain / _deviation(peak, outlook.next_total))


def _divergence(outlook: Outlook) -> Tensor:
    r"""Compute the divergence of the predicted means from the present ones, in nats, `(..., X·Y, N)`.

    It is computed as :math:`\sum_k p_k ((1 + e_k) \ln(1 + e_k) - e_k)` with :math:`e_k = p'_k / p_k - 1`. No term of
    this sum is negative, so small divergences are not differences of large numbers.
    """
    growth = outlook.growth
    change = growth.log1p()
    terms = torch.addcmul(change - growth, change, growth)
    return (terms * outlook.mean[..., None, :]).sum(-1)


def _lead(mean: Tensor) -> Tensor:
    """Compute the margin of the most probable class of means `(..., K+1)`: its probability minus the second largest."""
    first, place = mean.max(-1, keepdim=True)
    second = mean.scatter(-1, place, -torch.inf).amax(-1)
    return first[..., 0] - second


def _deviation(peak: Tensor, total: Tensor) -> Tensor:
    """Compute the standard deviation of a class probability under a Dirichlet, from its mean and the sum of β."""
    variance = peak * (1 - peak) / (total + 1)
    return variance.clamp(min=torch.finfo(variance.dtype).tiny).sqrt()
