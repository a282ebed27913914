"""Acquisition functions of scene exploration: which fixation changes the map for the better?

All simulate one look from every cell (`semfov.gaze.acquisition.lookahead`) and sum over the map what it does to each
cell x; p and T are mean and sum of a cell's Dirichlet parameters, primed after the simulated update.
"""

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import check
from semfov.gaze.acquisition.lookahead import LevelledModel, Lookahead, Outlook
from semfov.observation.dirichlet import kl_from_symmetric


class KLDivergence(Lookahead):
    r"""How far a look is expected to take the map from knowing nothing.

    .. math:: a(f) = \sum_x F(\bar\beta(x \mid f)) - F(\beta(x)), \qquad
              F(\beta) = \mathrm{KL}\bigl(\mathrm{Dir}(\beta) \,\|\, \mathrm{Dir}(\beta^0)\bigr)

    with β⁰ the uniform prior, 0.5 for every class (Luzio, Bernardino and Moreno, 2024, Scene Exploration: F and the
    sum over the map that the next fixation maximises). The published value is :math:`\sum_x F(\bar\beta)`. The present
    map's is the same for every fixation; without it, small differences are lost in a large sum.

    Args:
        model: the observation model.
        grid: the cells.
        prior: β⁰.

    An eye that sees well up to 0.4 image widths takes in all of three cells from the central one:

    >>> from semfov import DirichletBelief, FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [2.0, 1.0]], [[1.0, 9.0], [1.0, 2.0]]])
    >>> model = FovealObservationModel(alpha, [0.4], ["cup"])
    >>> belief = DirichletBelief(torch.tensor([[1.0, 2.0]]).repeat(3, 1))
    >>> KLDivergence(model, Grid(3, 1, (30, 10)))(belief, torch.zeros(3, dtype=torch.bool)).argmax()
    tensor(1)
    """

    def __init__(self, model: LevelledModel, grid: Grid, *, prior: float = 0.5) -> None:
        super().__init__(model, grid)
        check(prior > 0, "prior", "a positive number", prior)
        self.prior = prior

    def worth(self, outlook: Outlook) -> Tensor:
        """Divergence gained."""
        # The present map goes through the special functions with the predicted ones, as one level more.
        every = torch.cat([outlook.next_beta, outlook.beta[..., None, :]], -2)
        divergence = kl_from_symmetric(every, self.prior)
        return divergence[..., :-1] - divergence[..., -1:]


class BayesianSurprise(Lookahead):
    r"""How much a look is expected to change the map: divergence of the predicted from the present posterior.

    .. math:: a(f) = \sum_x \mathrm{KL}\bigl(\bar p(x \mid f) \,\|\, p(x)\bigr)

    (The surprise of Itti and Baldi, 2009, of the expected look. `KLDivergence` measures from the prior instead, and
    between the Dirichlets.)

    Args:
        model: the observation model.
        grid: the cells.
    """

    def worth(self, outlook: Outlook) -> Tensor:
        """Divergence of the predicted from the present posterior."""
        return divergence(outlook)


class NegativeEntropy(Lookahead):
    r"""How certain a look is expected to leave the map.

    .. math:: a(f) = \sum_x H(p(x)) - H(\bar p(x \mid f)), \qquad H(p) = -\sum_k p_k \ln p_k

    (Luzio, Bernardino and Moreno, 2024, Scene Exploration, the classification negentropy.) The published value is
    :math:`-\sum_x H(\bar p)`. The entropy of the present map is the same for every fixation; with it, small differences
    are not lost in a large sum.
    """

    def worth(self, outlook: Outlook) -> Tensor:
        """Entropy lost."""
        surprise = torch.xlogy(outlook.mean, outlook.mean)[..., None, :]
        # H(p) - H(p') = KL(p' || p) + Σ (p' - p) ln p
        return divergence(outlook) + (outlook.growth * surprise).sum(-1)


class TwoPeaks(Lookahead):
    r"""Largest change, anywhere on the map, of the lead of the most probable class over the second.

    .. math:: a(f) = \max_x |\Delta(p'(x \mid f)) - \Delta(p(x))|, \qquad \Delta(p) = p_{(1)} - p_{(2)}

    (Luzio, Bernardino and Moreno, 2024, Scene Exploration, the expected improvement of the two-peak difference.)
    """

    def worth(self, outlook: Outlook) -> Tensor:
        """Absolute change of the lead."""
        return (lead(outlook.next_mean) - lead(outlook.mean)[..., None]).abs()

    def pool(self, worth: Tensor) -> Tensor:
        """The largest over the map."""
        return worth.amax(-2)


class UpperConfidenceBound(Lookahead):
    r"""How far a look is expected to raise the upper confidence bound of every cell's most probable class.

    .. math:: a(f) = \sum_x U'(x \mid f) - U(x), \qquad U = p_{(1)} + \kappa \sqrt{p_{(1)} (1 - p_{(1)}) / (T + 1)}

    Mean and standard deviation are those of the class's probability under the Dirichlet belief. (The bound is that of
    Srinivas et al., 2010, taken on the predicted map; the present map's does not change the choice.)

    Args:
        model: the observation model.
        grid: the cells.
        kappa: κ, standard deviations above the mean.
    """

    def __init__(self, model: LevelledModel, grid: Grid, *, kappa: float = 2.0) -> None:
        super().__init__(model, grid)
        check(kappa >= 0, "kappa", "0 or more", kappa)
        self.kappa = kappa

    def worth(self, outlook: Outlook) -> Tensor:
        """Rise of the bound."""
        after = self._bound(outlook.next_mean.amax(-1), outlook.next_total)
        return after - self._bound(outlook.mean.amax(-1), outlook.total)[..., None]

    def _bound(self, peak: Tensor, total: Tensor) -> Tensor:
        return peak + self.kappa * deviation(peak, total)


class ProbabilityOfImprovement(Lookahead):
    r"""How likely a look leaves each cell with a more probable best class than it has.

    .. math:: a(f) = \sum_x \Phi\left(\frac{p'_{(1)}(x \mid f) - p_{(1)}(x) - \xi}{\sigma'(x \mid f)}\right), \qquad
              \sigma'^2 = p'_{(1)} (1 - p'_{(1)}) / (T' + 1)

    with the predicted Dirichlet's marginal taken for normal. (Kushner, 1964, on the predicted map. What a
    caption of Luzio, Bernardino and Moreno, 2024, calls the probability of improving is the sum of `KLDivergence`.)

    Args:
        model: the observation model.
        grid: the cells.
        margin: ξ, probability by which to improve.
    """

    def __init__(self, model: LevelledModel, grid: Grid, *, margin: float = 0.0) -> None:
        super().__init__(model, grid)
        check(0 <= margin < 1, "margin", "at least 0 and less than 1", margin)
        self.margin = margin

    def worth(self, outlook: Outlook) -> Tensor:
        """Probability of improvement."""
        peak = outlook.next_mean.amax(-1)
        gain = peak - outlook.mean.amax(-1)[..., None] - self.margin
        return torch.special.ndtr(gain / deviation(peak, outlook.next_total))


def divergence(outlook: Outlook) -> Tensor:
    r"""Divergence of predicted from present means, `(..., X·Y, N)`.

    With :math:`e_k = p'_k / p_k - 1`, as :math:`\sum_k p_k ((1 + e_k) \ln(1 + e_k) - e_k)`, of which no term is
    negative: what is small does not come from large terms that cancel.
    """
    growth = outlook.growth
    change = growth.log1p()
    terms = torch.addcmul(change - growth, change, growth)
    return (terms * outlook.mean[..., None, :]).sum(-1)


def lead(mean: Tensor) -> Tensor:
    """Difference of the two largest of probabilities `(..., K+1)`, `(...)`.

    >>> lead(torch.tensor([0.2, 0.5, 0.3]))
    tensor(0.2000)
    """
    first, place = mean.max(-1, keepdim=True)
    return first[..., 0] - mean.scatter(-1, place, -torch.inf).amax(-1)


def deviation(peak: Tensor, total: Tensor) -> Tensor:
    """Standard deviation of a class's probability with this mean, under a Dirichlet with this sum of parameters."""
    variance = peak * (1 - peak) / (total + 1)
    return variance.clamp(min=torch.finfo(variance.dtype).tiny).sqrt()
