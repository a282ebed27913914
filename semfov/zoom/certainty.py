"""The probability that an object of a large picture is there, from its score; their sum is the expected number."""

from typing import NamedTuple

import torch
from torch import Tensor

_SMALLEST = 1e-4


class Certainty(NamedTuple):
    r"""A logistic regression from the score s of a merged object to the probability that its box and class are right.

    .. math:: \operatorname{logit} p = a + b \operatorname{logit} s

    Attributes:
        offset: a.
        slope: b.

    >>> Certainty(0.0, 1.0).probability(torch.tensor([0.2, 0.7]))
    tensor([0.2000, 0.7000])
    """

    offset: float
    slope: float

    def probability(self, scores: Tensor) -> Tensor:
        """The probabilities of objects.

        Args:
            scores: `(...)`, their scores.

        Returns:
            `(...)`, in (0, 1).
        """
        return (self.offset + self.slope * scores.logit(_SMALLEST)).sigmoid()


def fit_certainty(scores: Tensor, right: Tensor, *, steps: int = 50) -> Certainty:
    """Fit a certainty by maximum likelihood, with Newton's method in float64.

    A weak prior (half an object for and against, at a score of one half) keeps the result finite where all objects are
    right or all wrong.

    Args:
        scores: `(n,)`, scores of objects.
        right: `(n,)` boolean, whether box and class of each are right.
        steps: number of Newton steps.

    Returns:
        The certainty.

    >>> torch.manual_seed(0)
    <torch._C.Generator object at ...>
    >>> scores = torch.rand(20_000)
    >>> fitted = fit_certainty(scores, torch.rand(20_000) < Certainty(-1.0, 0.5).probability(scores))
    >>> round(fitted.offset, 1), round(fitted.slope, 1)
    (-1.0, 0.5)
    """
    half = torch.tensor([0.5, 0.5], dtype=torch.float64)
    logits = torch.cat([scores.double().logit(_SMALLEST), torch.zeros(2, dtype=torch.float64)])
    there = torch.cat([right.double(), torch.tensor([0.0, 1.0], dtype=torch.float64)])
    weight = torch.cat([torch.ones(len(scores), dtype=torch.float64), half])
    inputs = torch.stack([torch.ones_like(logits), logits], -1)
    found, ridge = torch.tensor([0.0, 1.0], dtype=torch.float64), 1e-3 * torch.eye(2, dtype=torch.float64)
    start = found.clone()
    for _ in range(steps):
        chance = (inputs @ found).sigmoid()
        gradient = inputs.T @ (weight * (there - chance)) - ridge @ (found - start)
        curvature = inputs.T @ (inputs * (weight * chance * (1 - chance))[:, None]) + ridge
        found = found + torch.linalg.solve(curvature, gradient).clamp(-2, 2)
    return Certainty(*found.tolist())
