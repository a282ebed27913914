"""The Dirichlet distribution: density, moments, entropy, divergence and maximum-likelihood fit."""

import math

import torch
from torch import Tensor

from semfov.errors import check, check_finite, check_shape, check_tensor, values_known
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


_LARGEST = 1e10  # parameter up to which double precision leaves entropies and divergences to the third decimal


def log_normaliser(alpha: Tensor) -> Tensor:
    r"""Logarithm of the normalising constant of a Dirichlet: `ln B(α) = Σ ln Γ(α_k) - ln Γ(A)`, with `A = Σ α_k`.

    Args:
        alpha: `(..., K)`, parameters, positive.

    Returns:
        `(...)`, the logarithm.

    Raises:
        InputError: a parameter is not positive.

    >>> log_normaliser(torch.tensor([1.0, 1.0, 1.0]))
    tensor(-0.6931)
    """
    return _log_normaliser(alpha, "alpha").to(alpha.dtype)


def log_prob(alpha: Tensor, log_scores: Tensor) -> Tensor:
    r"""Log density of scores on the simplex, given the logarithms of the scores.

    .. math:: \ln p(s | \alpha) = \ln\Gamma(A) - \sum_k \ln\Gamma(\alpha_k) + \sum_k (\alpha_k - 1) \ln s_k

    This is the logarithm of equation 9 of Luzio, Bernardino and Moreno (2024).

    Args:
        alpha: `(..., K)`, parameters, positive.
        log_scores: `(..., K)`, logarithms of scores that sum to 1; broadcasts with `alpha`.

    Returns:
        `(...)`, log densities in nats.

    Raises:
        InputError: the numbers of components differ, or a parameter is not positive.

    >>> log_prob(torch.tensor([1.0, 1.0, 1.0]), torch.tensor([0.2, 0.3, 0.5]).log())
    tensor(0.6931)
    """
    check_tensor(alpha, "alpha")
    check_shape(log_scores, "log_scores", alpha.shape[-1])
    constant = _log_normaliser(alpha, "alpha")
    # A score of 0 counts for nothing where its parameter is 1: 0 · ln 0 is 0 there.
    scores = torch.where((alpha == 1) & log_scores.isneginf(), 0.0, log_scores)
    dtype = torch.promote_types(alpha.dtype, log_scores.dtype)
    linear = ((alpha.double() - 1) * scores.double()).sum(-1)
    return (linear - constant).to(dtype)


def mean(alpha: Tensor) -> Tensor:
    """Mean of a Dirichlet: the expected scores, `α_k / A`.

    For a belief Dir(β) it is the probability of each class, one draw of the Dirichlet-compound multinomial (Luzio,
    Bernardino and Moreno, 2024, equations 4 and 5).

    Args:
        alpha: `(..., K)`, parameters, positive.

    Returns:
        `(..., K)`, which sums to 1.

    Raises:
        InputError: a parameter is not positive.

    >>> mean(torch.tensor([1.0, 3.0]))
    tensor([0.2500, 0.7500])
    """
    _check_parameters(alpha, "alpha")
    return alpha / alpha.sum(-1, keepdim=True)


def covariance(alpha: Tensor) -> Tensor:
    r"""Covariance of the scores under Dir(α): `p_i (δ_ij - p_j) / (A + 1)`, with `p = α / A`.

    It shrinks as evidence grows; `categorical_covariance` does not.

    Args:
        alpha: `(..., K)`, parameters, positive.

    Returns:
        `(..., K, K)`, symmetric.

    >>> covariance(torch.tensor([1.0, 1.0]))
    tensor([[ 0.0833, -0.0833],
            [-0.0833,  0.0833]])
    """
    return categorical_covariance(alpha) / (alpha.sum(-1) + 1)[..., None, None]


def categorical_covariance(alpha: Tensor) -> Tensor:
    r"""Covariance of the class, as a one-hot vector drawn once from the mean: `p_i (δ_ij - p_j)`.

    Off the diagonal this is `σ_ij = -p_i p_j`, the "co-variances of the class distribution" of Luzio, Bernardino and
    Moreno (2024, equation 6). It is not the covariance of the probabilities under the Dirichlet (`covariance`).
    No rule of fusion and no policy reads it.

    Args:
        alpha: `(..., K)`, parameters, positive.

    Returns:
        `(..., K, K)`, symmetric.

    >>> categorical_covariance(torch.tensor([1.0, 1.0]))
    tensor([[ 0.2500, -0.2500],
            [-0.2500,  0.2500]])
    """
    p = mean(alpha)
    return torch.diag_embed(p) - p[..., :, None] * p[..., None, :]


def entropy(alpha: Tensor) -> Tensor:
    r"""Differential entropy of a Dirichlet density.

    .. math:: H = \ln B(\alpha) + (A - K) \psi(A) - \sum_k (\alpha_k - 1) \psi(\alpha_k)

    The negentropy of Luzio, Bernardino and Moreno (2024, equation 20) is another quantity: it is computed from the
    mean of the Dirichlet, which is a categorical distribution.

    Args:
        alpha: `(..., K)`, parameters, positive.

    Returns:
        `(...)`, entropies in nats.

    >>> entropy(torch.tensor([1.0, 1.0]))
    tensor(0.)
    """
    constant = _log_normaliser(alpha, "alpha", _LARGEST)
    exact = alpha.double()
    surprise = exact.digamma() - exact.sum(-1, keepdim=True).digamma()
    return (constant - ((exact - 1) * surprise).sum(-1)).to(alpha.dtype)


def kl_divergence(alpha: Tensor, other: Tensor) -> Tensor:
    r"""Kullback-Leibler divergence :math:`D_{KL}(\mathrm{Dir}(\alpha) \| \mathrm{Dir}(\beta))`.

    .. math:: KL(\alpha \| \beta) = \ln B(\beta) - \ln B(\alpha)
              + \sum_k (\alpha_k - \beta_k) (\psi(\alpha_k) - \psi(A))

    Luzio, Bernardino and Moreno (2024, equation 19) explore with it: `alpha` is the belief about a cell, and `other`
    is the prior, 0.5 for every class.

    Args:
        alpha: `(..., K)`, parameters of the distribution that the expectation is taken over, positive.
        other: `(..., K)`, β, positive; broadcasts with `alpha`.

    Returns:
        `(...)`, divergences in nats.

    Raises:
        InputError: the numbers of components differ, or a parameter is not positive.

    >>> kl_divergence(torch.tensor([2.0, 1.0]), torch.tensor([1.0, 1.0]))
    tensor(0.1931)
    """
    check_tensor(alpha, "alpha")
    check_shape(other, "other", alpha.shape[-1])
    constants = _log_normaliser(other, "other", _LARGEST) - _log_normaliser(alpha, "alpha", _LARGEST)
    exact = alpha.double()
    expected_log = exact.digamma() - exact.sum(-1, keepdim=True).digamma()
    divergence = constants + ((exact - other.double()) * expected_log).sum(-1)
    return divergence.to(torch.promote_types(alpha.dtype, other.dtype))


def kl_from_symmetric(alpha: Tensor, parameter: float) -> Tensor:
    r"""Kullback-Leibler divergence to a symmetric Dirichlet, whose parameters all equal c.

    .. math:: \mathrm{KL} = \sum_k h(\alpha_k; c) - h(A; K c), \qquad
              h(x; c) = (x - c) \, \psi(x) - \ln\frac{\Gamma(x)}{\Gamma(c)}

    h is 0 at c and never negative (`semfov.observation.special.log_gamma_divergence`). For parameters close to c this
    form avoids the cancellation of large terms that `kl_divergence` has.

    Args:
        alpha: `(..., K)`, parameters, positive.
        parameter: c, positive.

    Returns:
        `(...)`, divergences in nats.

    Raises:
        InputError: `parameter` is not positive.

    >>> kl_from_symmetric(torch.tensor([2.0, 1.0]), 1.0)
    tensor(0.1931)
    """
    check(parameter > 0, "parameter", "a positive number", parameter)
    _check_parameters(alpha, "alpha")
    return divergence_from_symmetric(alpha, parameter)


def divergence_from_symmetric(alpha: Tensor, parameter: float) -> Tensor:
    """Compute `kl_from_symmetric` without the checks.

    Args:
        alpha: `(..., K)`, parameters, positive.
        parameter: c, positive.

    Returns:
        `(...)`, divergences in nats.
    """
    base = alpha.shape[-1] * parameter
    # There are few sums and their terms are large: double precision costs little here.
    total = alpha.sum(-1).double()
    of_total = (total - base) * total.digamma() - total.lgamma() + math.lgamma(base)
    return log_gamma_divergence(alpha, parameter).sum(-1) - of_total.to(alpha)


def floor(scores: Tensor, epsilon: float) -> Tensor:
    """Raise scores to at least `epsilon` and scale them to sum to 1, so that their logarithms are finite.

    Args:
        scores: `(..., K)`, not negative.
        epsilon: the lower bound, applied before scaling; positive.

    Returns:
        `(..., K)`, which sums to 1.

    Raises:
        InputError: a score is negative or not finite, or `epsilon` is not positive.

    >>> floor(torch.tensor([0.0, 3.0]), 1.0)
    tensor([0.2500, 0.7500])
    """
    check_shape(scores, "scores", None)
    check(epsilon > 0, "epsilon", "a positive number", epsilon)
    if scores.numel() and values_known(scores):
        # The minimum and the maximum of a tensor with a NaN are NaN, so one pass checks both conditions.
        least, largest = torch.stack(scores.detach().aminmax()).tolist()
        if not (math.isfinite(least) and math.isfinite(largest)):
            check_finite(scores, "scores")
        check(least >= 0, "scores", "no negative numbers", least)
    raised = scores.clamp(min=epsilon)
    return raised / raised.sum(-1, keepdim=True)


def _log_normaliser(alpha: Tensor, argument: str, largest: float = math.inf) -> Tensor:
    """Compute `log_normaliser` in float64: ln Γ of large parameters is far larger than the differences wanted."""
    _check_parameters(alpha, argument, largest)
    exact = alpha.double()
    return exact.lgamma().sum(-1) - exact.sum(-1).lgamma()


def _check_parameters(alpha: Tensor, argument: str, bound: float = math.inf) -> None:
    """Raise `InputError` unless parameters `(..., K)` are positive, finite and at most `bound`."""
    check_shape(alpha, argument, None)
    check(alpha.shape[-1] > 0, argument, "at least one parameter", "none")
    floating = alpha.is_floating_point()
    check(floating, argument, "floating-point parameters", f"{alpha.dtype}; give {argument}.float()")
    if alpha.numel() and values_known(alpha):
        # The minimum and the maximum of a tensor with a NaN are NaN.
        least, largest = torch.stack(alpha.detach().aminmax()).tolist()
        positive = least > 0 and largest < math.inf
        check(positive, argument, "positive, finite parameters", f"{least:g} to {largest:g}")
        got = f"{largest:g}; beyond, rounding is all there is"
        check(largest <= bound, argument, f"parameters up to {bound:g}", got)
