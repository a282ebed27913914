"""Logistic regression by maximum likelihood."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

_OF_OFFSET = 1e-6  # strength of the prior of the offset, which leaves it free
_LONGEST_STEP = 2.0
_CONVERGED = 1e-9
_HALVINGS = 30  # of a step that would raise the loss


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
    # Half a case for and against without any facts keeps the result finite where all cases are right or all wrong.
    inputs = torch.cat([facts.double(), facts.new_zeros(2, facts.shape[1], dtype=torch.float64)])
    inputs = torch.cat([torch.ones(len(inputs), 1, dtype=torch.float64), inputs], -1)
    answers = torch.cat([right.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    weight = torch.ones(len(inputs), dtype=torch.float64)
    weight[-2:] = 0.5 if prior is None else 0.0
    if times is not None:
        weight[:-2] = times
    given = torch.zeros_like(weight)
    if known is not None:
        given[:-2] = known
    if prior is None:
        centre = torch.zeros(inputs.shape[-1], dtype=torch.float64)
        precision = torch.full_like(centre, ridge)
        precision[0] = _OF_OFFSET
    else:
        # Cases that the facts separate must not push the coefficients to infinity.
        centre, precision = prior[0], prior[1].clamp(min=_OF_OFFSET)

    def loss(coefficients: Tensor) -> float:
        cross_entropy = F.binary_cross_entropy_with_logits(given + inputs @ coefficients, answers, reduction="none")
        return float(weight @ cross_entropy + 0.5 * precision @ (coefficients - centre).square())

    coefficients = centre.clone()
    for _ in range(steps):
        chance = (given + inputs @ coefficients).sigmoid()
        gradient = inputs.T @ (weight * (answers - chance)) - precision * (coefficients - centre)
        if float(gradient.abs().max()) < _CONVERGED:
            break
        curvature = inputs.T @ (inputs * (weight * chance * (1 - chance))[:, None]) + precision.diag()
        # Where facts separate the cases, and nothing holds the weights, the curvature vanishes.
        step = torch.linalg.pinv(curvature, hermitian=True) @ gradient
        # A shorter step keeps its direction, in which the loss falls.
        step = step * min(1.0, _LONGEST_STEP / max(float(step.abs().max()), _CONVERGED))
        coefficients = coefficients + _not_above(loss, coefficients, step)
        if float(step.abs().max()) < _CONVERGED:
            break
    return coefficients.tolist()


def _not_above(loss: Callable[[Tensor], float], start: Tensor, step: Tensor) -> Tensor:
    """Halve a step until the loss after it is not above that at its start."""
    before = loss(start)
    for _ in range(_HALVINGS):
        # Near the minimum the two differ by rounding alone.
        if loss(start + step) <= before + abs(before) * 1e-12:
            break
        step = step / 2
    return step
