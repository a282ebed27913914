"""The Dirichlet distribution: density, moments, entropy, divergence, and its maximum-likelihood fit."""

import math

import torch
from torch import Tensor

from semfov.errors import check, check_finite, check_shape, values_known
from semfov.observation.mle import inverse_digamma, mle, shrink, vacuous
from semfov.observation.special import log_gamma_divergence

__all__ = [
    "categorical_covariance",
    "covariance",
    "entropy",
    "floor",
    "inverse_digamma",
    "kl_divergence",
    "kl_from_symmetric",
    "log_normaliser",
    "log_prob",
    "mean",
    "mle",
    "shrink",
    "vacuous",
]


def log_normaliser(alpha: Tensor) -> Tensor:
    r"""Logarithm of what a Dirichlet density is divided by, `(...)`: `Σ ln Γ(α_k) - ln Γ(A)`, `A = Σ α_k`.

    >>> log_normaliser(torch.tensor([1.0, 1.0, 1.0]))
    tensor(-0.6931)
    """
    _check_parameters(alpha, "alpha")
    return alpha.lgamma().sum(-1) - alpha.sum(-1).lgamma()


def log_prob(alpha: Tensor, log_scores: Tensor) -> Tensor:
    r"""Log density of scores on the simplex, from their logarithms.

    .. math:: \ln p(s | \alpha) = \ln\Gamma(A) - \sum_k \ln\Gamma(\alpha_k) + \sum_k (\alpha_k - 1) \ln s_k

    (The logarithm of equation 9 of Luzio, Bernardino and Moreno, 2024.)

    Args:
        alpha: `(..., K)`, parameters, positive.
        log_scores: `(..., K)`, logarithms of scores that sum to 1; broadcasts with `alpha`.

    Returns:
        `(...)`.

    >>> log_prob(torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.2, 0.3, 0.5]).log())
    tensor(0.6931)
    """
    check_shape(log_scores, "log_scores", alpha.shape[-1])
    return ((alpha - 1) * log_scores).sum(-1) - log_normaliser(alpha)


def mean(alpha: Tensor) -> Tensor:
    """Expected scores, `(..., K)`: `α_k / A`.

    Of a belief Dir(β) this is the probability of each class: one draw of the Dirichlet-compound multinomial
    (Luzio, Bernardino and Moreno, 2024, equations 4 and 5).

    >>> mean(torch.tensor([1.0, 3.0]))
    tensor([0.2500, 0.7500])
    """
    _check_parameters(alpha, "alpha")
    return alpha / alpha.sum(-1, keepdim=True)


def covariance(alpha: Tensor) -> Tensor:
    r"""Covariance of the scores under Dir(α), `(..., K, K)`: `p_i (δ_ij - p_j) / (A + 1)`, with `p = α / A`.

    It shrinks as evidence grows; `categorical_covariance` does not.

    >>> covariance(torch.tensor([1.0, 1.0]))
    tensor([[ 0.0833, -0.0833],
            [-0.0833,  0.0833]])
    """
    return categorical_covariance(alpha) / (alpha.sum(-1) + 1)[..., None, None]


def categorical_covariance(alpha: Tensor) -> Tensor:
    r"""Covariance of the class as a one-hot vector, drawn once from the mean, `(..., K, K)`: `p_i (δ_ij - p_j)`.

    Off the diagonal this is the `σ_ij = -p_i p_j` of Luzio, Bernardino and Moreno (2024, equation 6), "co-variances of
    the class distribution". It is not the covariance of the probabilities under the Dirichlet (`covariance`).

    >>> categorical_covariance(torch.tensor([1.0, 1.0]))
    tensor([[ 0.2500, -0.2500],
            [-0.2500,  0.2500]])
    """
    p = mean(alpha)
    return torch.diag_embed(p) - p[..., :, None] * p[..., None, :]


def entropy(alpha: Tensor) -> Tensor:
    r"""Differential entropy, in nats, `(...)`.

    .. math:: H = \ln B(\alpha) + (A - K) \psi(A) - \sum_k (\alpha_k - 1) \psi(\alpha_k)

    It is that of the density. The negentropy of Luzio, Bernardino and Moreno (2024, equation 20) is that of the mean.

    >>> entropy(torch.tensor([1.0, 1.0]))
    tensor(0.)
    """
    surprise = alpha.digamma() - alpha.sum(-1, keepdim=True).digamma()
    return log_normaliser(alpha) - ((alpha - 1) * surprise).sum(-1)


def kl_divergence(alpha: Tensor, other: Tensor) -> Tensor:
    r"""Kullback-Leibler divergence :math:`D_{KL}(\mathrm{Dir}(\alpha) \| \mathrm{Dir}(\beta))`, in nats, `(...)`.

    .. math:: KL(\alpha \| \beta) = \ln B(\beta) - \ln B(\alpha)
              + \sum_k (\alpha_k - \beta_k) (\psi(\alpha_k) - \psi(A))

    Exploration by Luzio, Bernardino and Moreno (2024, equation 19) takes it from a cell's belief, as `alpha`, to the
    prior, `other` with 0.5 for every class.

    Args:
        alpha: `(..., K)`, the distribution that the expectation is over.
        other: `(..., K)`, β; broadcasts with `alpha`.

    >>> kl_divergence(torch.tensor([2.0, 1.0]), torch.tensor([1.0, 1.0]))
    tensor(0.1931)
    """
    check_shape(other, "other", alpha.shape[-1])
    expected = alpha.digamma() - alpha.sum(-1, keepdim=True).digamma()
    return log_normaliser(other) - log_normaliser(alpha) + ((alpha - other) * expected).sum(-1)


def kl_from_symmetric(alpha: Tensor, parameter: float) -> Tensor:
    r"""`kl_divergence` to a symmetric Dirichlet, whose parameters are all c, in nats, `(...)`.

    .. math:: \mathrm{KL} = \sum_k h(\alpha_k; c) - h(A; K c), \qquad
              h(x; c) = (x - c) \, \psi(x) - \ln\frac{\Gamma(x)}{\Gamma(c)}

    h is 0 at c and nowhere negative (`semfov.observation.special.log_gamma_divergence`), so what differs little from c
    does not come from large terms that cancel.

    Args:
        alpha: `(..., K)`, parameters, positive.
        parameter: c, positive.

    >>> kl_from_symmetric(torch.tensor([2.0, 1.0]), 1.0)
    tensor(0.1931)
    """
    check(parameter > 0, "parameter", "a positive number", parameter)
    base = alpha.shape[-1] * parameter
    # Sums are few, and their terms large: double precision costs nothing here.
    total = alpha.sum(-1).double()
    whole = (total - base) * total.digamma() - total.lgamma() + math.lgamma(base)
    return log_gamma_divergence(alpha, parameter).sum(-1) - whole.to(alpha)


def floor(scores: Tensor, epsilon: float) -> Tensor:
    """Scores `(..., K)` raised to at least `epsilon` and scaled to sum to 1, so that their logarithms are finite.

    Raises:
        InputError: a score is negative or not finite.

    >>> floor(torch.tensor([0.0, 3.0]), 1.0)
    tensor([0.2500, 0.7500])
    """
    check_shape(scores, "scores", None)
    check(epsilon > 0, "epsilon", "a positive number", epsilon)
    if scores.numel() and values_known(scores):
        # NaN survives the minimum and the maximum, so one pass answers both questions.
        least, largest = scores.detach().aminmax()
        if not bool(torch.isfinite(least) & torch.isfinite(largest)):
            check_finite(scores, "scores")
        check(bool(least >= 0), "scores", "no negative numbers", float(least))
    raised = scores.clamp(min=epsilon)
    return raised / raised.sum(-1, keepdim=True)


def _check_parameters(alpha: Tensor, argument: str) -> None:
    check_shape(alpha, argument, None)
    if alpha.numel() and values_known(alpha):
        check(bool((alpha > 0).all()), argument, "positive parameters", alpha.detach().amin().tolist())
