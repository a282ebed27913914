"""Visibility: how well a target can be told from background at each level of distance, as d' of signal detection."""

import torch
from torch import Tensor

from semfov.errors import InputError
from semfov.observation.dirichlet import kl_divergence
from semfov.observation.foveal import FovealObservationModel


def visibility(model: FovealObservationModel) -> Tensor:
    r"""Compute the detectability index d' of every class against background, at every level of distance.

    The signal in a cell is the log likelihood ratio of target and background given the detection there, R = ln Dir(S |
    α_k) - ln Dir(S | α_0). Without a detection there is no signal, R = 0, as in a belief that fuses detections alone.
    R is therefore distributed as a mixture, weighted by the miss rates m:

    .. math::

        d' &= \frac{E_k[R] - E_0[R]}{\sqrt{(V_k[R] + V_0[R]) / 2}}, \qquad E_c[R] = (1 - m_c) \mu_c, \qquad
        V_c[R] = (1 - m_c) (\sigma_c^2 + m_c \mu_c^2) \\
        \mu_k &= \mathrm{KL}(\alpha_k \| \alpha_0), \qquad \mu_0 = -\mathrm{KL}(\alpha_0 \| \alpha_k), \qquad
        \sigma_c^2 = \sum_j w_j^2 \psi'(\alpha_{cj}) - \Bigl(\sum_j w_j\Bigr)^2 \psi'(A_c), \quad
        w = \alpha_k - \alpha_0

    This is d' for two distributions of unequal variance, the `d_a` of Simpson and Fitter (1973); the moments of log
    scores are those of Minka (2000). It is never negative. It is 0 for a class if neither the class nor background is
    ever detected. It does not depend on the tempering.

    The Dirichlets must be densities of the scores, as in models fitted by maximum likelihood (`...-published`). Models
    trained for the posterior of the class do not qualify: their d' is nearly the same at all levels.

    Args:
        model: the observation model, with miss rates.

    Returns:
        `(K+1, N)`, d'; that of background is 0.

    Raises:
        InputError: the model has no miss rates.

    >>> from semfov import FovealObservationModel
    >>> alpha = torch.tensor([[[9.0, 1.0], [5.0, 1.0]], [[1.0, 9.0], [1.0, 1.0]]])
    >>> missed = torch.tensor([[0.5, 0.9], [0.1, 0.8]])
    >>> model = FovealObservationModel(alpha, [0.2], ["cup"], miss_rate=missed)
    >>> visibility(model).detach()
    tensor([[0.0000, 0.0000],
            [2.4116, 0.3841]])
    """
    if model.miss_rate is None:
        raise InputError(
            "model: expected an observation model with miss rates (fit one with `train.fit_fom`), got one without"
        )
    target = model.alpha
    background = target[:1]
    moments = _log_ratio_moments(target, target, background)
    signal_mean, signal_variance = _mixed(*moments, model.miss_rate)
    moments = _log_ratio_moments(background, target, background)
    noise_mean, noise_variance = _mixed(*moments, model.miss_rate[:1])
    deviation = ((signal_variance + noise_variance) / 2).sqrt()
    difference = signal_mean - noise_mean
    # Not divided by 0 where it is replaced, either, as gradients of both branches are computed.
    divisor = deviation.clamp(min=torch.finfo(deviation.dtype).tiny)
    return torch.where(deviation > 0, difference / divisor, 0.0)


def _log_ratio_moments(alpha: Tensor, target: Tensor, background: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean and variance of `ln Dir(S | target) - ln Dir(S | background)` for scores S from Dir(alpha)."""
    # ln p/q under r is KL(r || q) - KL(r || p).
    mean = kl_divergence(alpha, background) - kl_divergence(alpha, target)
    weight = target - background
    total = torch.polygamma(1, alpha.sum(-1))
    of_each = (weight.square() * torch.polygamma(1, alpha)).sum(-1)
    of_total = weight.sum(-1).square() * total
    variance = of_each - of_total
    # Where the variance is 0, rounding can make the difference negative.
    return mean, variance.clamp(min=0)


def _mixed(mean: Tensor, variance: Tensor, missed: Tensor) -> tuple[Tensor, Tensor]:
    """Compute mean and variance of a variable that is 0 with probability `missed`, and else has these moments."""
    detected = 1 - missed
    # E[R²] - E[R]² = (1 - m) (σ² + μ²) - (1 - m)² μ²
    mixed_variance = detected * (variance + missed * mean.square())
    return detected * mean, mixed_variance
