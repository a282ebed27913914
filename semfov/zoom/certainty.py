"""The probability that an object of a large picture is there, and how many objects no look has shown yet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from torch import Tensor

from semfov.errors import check

FACTS = (
    "score",
    "best",
    "sharpest",
    "shown",
    "missed",
    "cut",
    "size",
    "size squared",
    "agreement",
    "double",
    "inside",
    "around",
    "octaves",
    "rival",
)
"""Facts about an object, from which its probability is predicted (`semfov.zoom.objects`)."""

SPREAD = 0.3  # the spread of a certainty (`Certainty`) for which none was fitted

SEVERAL = 5  # the number of likely or clear objects from which on a detector reacts

_SURE, _PART = 0.5, 0.6
"""Probability and share of the objects to which a detector reacts (`reacts`)."""


@dataclass(frozen=True)
class Certainty:
    r"""A logistic regression from facts about an object to the probability that its box and class are right.

    The number n of objects that looks would still show is negative binomial. The evidence expects :math:`R_1` in cells
    that clearly promise one and :math:`R_2` in others; looks have shown F new ones where it promised W:

    .. math:: R = R_1 + w R_2, \qquad E[c] = \frac{k c_0 + F}{k + u W}, \qquad
              E[n] = E[c] R, \qquad \operatorname{Var}[n] = E[c] R + \frac{E[c] R^2}{k + u W}

    The `spread` is the standard deviation of the share by which the model is off in a picture.
    """

    offset: float
    weights: tuple[float, ...]
    scale: float = 0.0
    strength: float = math.inf
    faint: float = 1.0
    promise: float = 1.0
    spread: float = SPREAD

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Self:
        if len(numbers) == 2:
            return cls(numbers[0], (numbers[1], *[0.0] * (len(FACTS) - 1)))
        count = len(FACTS) + 6
        check(len(numbers) == count, "certainty", f"2 or {count} numbers", len(numbers))
        return cls(numbers[0], tuple(numbers[1:-5]), *numbers[-5:])

    @property
    def numbers(self) -> list[float]:
        """The numbers of a file, as `of` reads them."""
        if math.isinf(self.strength):
            return [self.offset, self.weights[0]]
        return [self.offset, *self.weights, self.scale, self.strength, self.faint, self.promise, self.spread]

    def probability(self, facts: Tensor) -> Tensor:
        """The probabilities of objects; facts `(M, 14)` → `(M,)`."""
        return (self.offset + facts @ facts.new_tensor(self.weights)).sigmoid()

    def unseen(self, expected: tuple[float, float], *, promised: float, discoveries: float) -> tuple[float, float]:
        """How many objects further looks would show."""
        clear, faint = expected
        number = clear + self.faint * faint
        if math.isinf(self.strength):
            return self.scale * number, self.scale * number
        rate = self.strength + self.promise * promised
        scale = (self.strength * self.scale + discoveries) / rate
        return scale * number, scale * number * (1 + number / rate)


def reacts(chances: Tensor) -> bool:
    """Whether a detector reacts to objects of these probabilities `(M,)`: several are likely, or most of their sum."""
    sure = chances[chances >= _SURE]
    return len(sure) >= SEVERAL or float(sure.sum()) >= _PART * float(chances.sum())


def number_of_faint(chances: Tensor) -> tuple[float, float]:
    r"""Mean and variance of the number of objects of a class to which the detector hardly reacts.

    It misses as many as it shows: in 71 photographs of the fit in which it hardly reacts to people, the probabilities
    have a sum of 150, and there are 279 people. In 68 of them the true number is within two of the errors:

    .. math:: E = 2 \sum_i p_i, \qquad \sigma^2 = \sum_i p_i (1 - p_i) + (1 + E)^2
    """
    each = chances.double()
    mean = 2 * float(each.sum())
    return mean, float((each * (1 - each)).sum()) + (1 + mean) ** 2


def number_of(chances: Tensor, unseen: tuple[float, float], spread: float) -> tuple[float, float]:
    r"""Mean and variance of the number of objects with probabilities `(M,)`, and of those that no look has shown.

    .. math:: E = \sum_i p_i + E[n], \qquad \sigma^2 = \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2
    """
    each = chances.double()
    mean = float(each.sum()) + unseen[0]
    return mean, float((each * (1 - each)).sum()) + unseen[1] + (spread * mean) ** 2
