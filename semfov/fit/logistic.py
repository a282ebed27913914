"""Logistic regression by maximum likelihood."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

_OF_OFFSET = 1e-6  # strength of the prior of the offset, which leaves it free
_LONGEST_STEP = 2.0
_CONVERGED = 1e-9
_HALVINGS = 30  # of a step that would raise the loss
_PSEUDO_CASES = 2


def logistic_regression(
    facts: Tensor,
    right: Tensor,
    *,
    times: Tensor | None = None,
    known: Tensor | None = None,
    ridge: float = 1.0,
    prior: tuple[Tensor, Tensor] | None = None,
    steps: int = 100,
) -> list[float]:
    """Fit a logistic regression by penalised maximum likelihood, with Newton's method; no step raises the loss.

    Args:
        facts: `(n, m)`, inputs of each case.
        right: `(n,)`, the answers, 0 or 1.
        times: `(n,)`, how often each case counts; None: once.
        known: `(n,)`, log odds of each case that are given, and to which the fitted ones are added; None: 0.
        ridge: strength with which the weights are held near 0.
        prior: centre and precision of a normal prior of offset and weights, each `(m + 1,)`, in place of `ridge`.
        steps: largest number of steps.

    Returns:
        The offset, and the m weights.
    """
    # With a prior of its own the result is finite without pseudo-cases.
    pseudo_weight = 0.5 if prior is None else 0.0
    cases = _cases(facts, right, times, known, pseudo_weight)
    posterior = _Posterior(*cases, *_normal_prior(facts.shape[1], ridge, prior))
    coefficients = posterior.centre.clone()
    for _ in range(steps):
        gradient = posterior.gradient(coefficients)
        if float(gradient.abs().max()) < _CONVERGED:
            break
        # Where facts separate the cases, and nothing holds the weights, the curvature vanishes.
        step = torch.linalg.pinv(posterior.curvature(coefficients), hermitian=True) @ gradient
        # A shorter step keeps its direction, in which the loss falls.
        step = step * min(1.0, _LONGEST_STEP / max(float(step.abs().max()), _CONVERGED))
        coefficients = coefficients + _not_above(posterior.loss, coefficients, step)
        if float(step.abs().max()) < _CONVERGED:
            break
    return coefficients.tolist()


class _Posterior(NamedTuple):
    r"""The loss of coefficients β, the offset first, and its derivatives.

    .. math:: L(\beta) = -\sum_i w_i \log P(y_i \mid g_i + x_i \beta) + \frac{1}{2} \sum_j \pi_j (\beta_j - c_j)^2

    Attributes:
        inputs: x, `(n, m + 1)`.
        answers: y, `(n,)`.
        weight: w, `(n,)`.
        log_odds: g, `(n,)`, to which those by the facts are added.
        centre: c, `(m + 1,)`.
        precision: π, `(m + 1,)`.
    """

    inputs: Tensor
    answers: Tensor
    weight: Tensor
    log_odds: Tensor
    centre: Tensor
    precision: Tensor

    def loss(self, coefficients: Tensor) -> float:
        """Compute the loss."""
        log_odds = self.log_odds + self.inputs @ coefficients
        cross_entropy = F.binary_cross_entropy_with_logits(log_odds, self.answers, reduction="none")
        return float(self.weight @ cross_entropy + 0.5 * self.precision @ (coefficients - self.centre).square())

    def gradient(self, coefficients: Tensor) -> Tensor:
        """Compute the direction in which the loss falls, `(m + 1,)`."""
        chance = (self.log_odds + self.inputs @ coefficients).sigmoid()
        from_cases = self.inputs.T @ (self.weight * (self.answers - chance))
        return from_cases - self.precision * (coefficients - self.centre)

    def curvature(self, coefficients: Tensor) -> Tensor:
        """Compute the second derivatives of the loss, `(m + 1, m + 1)`."""
        chance = (self.log_odds + self.inputs @ coefficients).sigmoid()
        of_cases = self.weight * chance * (1 - chance)
        return self.inputs.T @ (self.inputs * of_cases[:, None]) + self.precision.diag()


def _cases(
    facts: Tensor, right: Tensor, times: Tensor | None, known: Tensor | None, pseudo_weight: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Make inputs, answers, weights and known log odds of all cases, and of two pseudo-cases at their end.

    One pseudo-case for and one against, without any facts, keep the result finite where all cases are right or all are
    wrong.
    """
    count, width = facts.shape
    total = count + _PSEUDO_CASES
    inputs = torch.zeros(total, width + 1, dtype=torch.float64)
    inputs[:, 0] = 1  # of the offset
    inputs[:count, 1:] = facts
    answers = torch.zeros(total, dtype=torch.float64)
    answers[:count] = right
    answers[-1] = 1
    weight = torch.ones(total, dtype=torch.float64)
    if times is not None:
        weight[:count] = times
    weight[count:] = pseudo_weight
    log_odds = torch.zeros(total, dtype=torch.float64)
    if known is not None:
        log_odds[:count] = known
    return inputs, answers, weight, log_odds


def _normal_prior(width: int, ridge: float, prior: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor]:
    """Make centre and precision of the coefficients: the given ones, or those of weights near 0 and a free offset."""
    if prior is not None:
        centre, precision = prior
        # Cases that the facts separate must not push the coefficients to infinity.
        return centre, precision.clamp(min=_OF_OFFSET)
    precision = torch.full((width + 1,), ridge, dtype=torch.float64)
    precision[0] = _OF_OFFSET
    return torch.zeros_like(precision), precision


def _not_above(loss: Callable[[Tensor], float], start: Tensor, step: Tensor) -> Tensor:
    """Halve a step until the loss after it is not above that at its start."""
    before = loss(start)
    for _ in range(_HALVINGS):
        # Near the minimum the two differ by rounding alone.
        if loss(start + step) <= before + abs(before) * 1e-12:
            break
        step = step / 2
    return step
