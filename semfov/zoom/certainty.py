"""The probability that an object of a large picture is there, and how many objects no look has shown yet."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.errors import check
from semfov.io.state import StatedModule
from semfov.precision import exact_product

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

# The least tenth with which four fifths of 12 mosaics of the fit were within two errors.
SPREAD = 0.3  # the spread of a certainty (`Certainty`) for which none was fitted

DISPERSION = 2.0
"""Variance of the number of right objects, in that of independent ones: what hides one of them hides its neighbours.

It is 2 where objects are there, or not, in pairs. Of people in photographs of the fit it has the largest likelihood.
"""

SEVERAL = 5  # the number of likely or clear objects from which on a detector reacts

LIKELY = 0.5  # probability from which on an object is likely
_LIKELY_SHARE = 0.6  # share of the sum of all probabilities that likely objects have where a detector reacts


class Certainty(StatedModule):
    r"""A logistic regression from facts about an object to the probability that its box and class are right.

    The number n of objects that looks would still show is negative binomial. The evidence expects :math:`R_1` in cells
    that clearly promise one and :math:`R_2` in others; looks have shown F new ones where it promised W:

    .. math:: R = R_1 + w R_2, \qquad E[c] = \frac{k c_0 + F}{k + u W}, \qquad
              E[n] = E[c] R, \qquad \operatorname{Var}[n] = E[c] R + \frac{E[c] R^2}{k + u W}

    Both are differentiable in the numbers of the fit but the spread, which are parameters.

    Args:
        offset: constant of the regression.
        weights: its weights, one for each of `FACTS`.
        scale: :math:`c_0`, share of the expected objects that looks show.
        strength: k, how little discoveries change the scale; infinite where they do not.
        faint: w, weight of objects that are expected in cells which do not clearly promise one.
        promise: u, weight of what was promised.
        spread: standard deviation of the share by which the model is off in a picture (`number_of`).

    Raises:
        InputError: there are more or fewer weights than facts, or the strength is not positive.

    >>> certainty = Certainty(0.0, [1.0] + 13 * [0.0])  # by the score alone
    >>> certainty.probability(torch.zeros(2, 14)).tolist()
    [0.5, 0.5]
    """

    def __init__(
        self,
        offset: float,
        weights: Sequence[float],
        scale: float = 0.0,
        strength: float = math.inf,
        faint: float = 1.0,
        promise: float = 1.0,
        spread: float = SPREAD,
    ) -> None:
        super().__init__()
        check(len(weights) == len(FACTS), "weights", f"{len(FACTS)} numbers", len(weights))
        check(strength > 0, "strength", "a number above 0", strength)
        self.offset = _parameter(offset)
        self.weights = _parameter(weights)
        self.scale = _parameter(scale)
        self.strength = _parameter(strength)
        self.faint = _parameter(faint)
        self.promise = _parameter(promise)
        self.spread = spread

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Self:
        """Make a certainty from the numbers in a file of a model.

        Args:
            numbers: as `numbers` lists them; two are an offset and the weight of the score.

        Returns:
            The certainty.

        Raises:
            InputError: there are too few or too many.
        """
        # Evidence of earlier versions has probabilities by the score alone.
        if len(numbers) == 2:
            offset, weight_of_score = numbers
            weights_of_others = [0.0] * (len(FACTS) - 1)
            return cls(offset, (weight_of_score, *weights_of_others))
        count = len(FACTS) + 6
        check(len(numbers) == count, "certainty", f"2 or {count} numbers", len(numbers))
        offset, *weights = numbers[:-5]
        return cls(offset, weights, *numbers[-5:])

    @property
    def numbers(self) -> list[float]:
        """The parameters and the spread as numbers for a file, which `of` reads."""
        regression = _decimals([self.offset, *self.weights])
        if self.strength.isinf():
            return regression[:2]
        counts = _decimals([self.scale, self.strength, self.faint, self.promise])
        return [*regression, *counts, self.spread]

    def probability(self, facts: Tensor) -> Tensor:
        """Compute the probabilities of objects.

        Args:
            facts: `(..., 14)`, `FACTS` about each object.

        Returns:
            `(...)`, in the type and on the device of the facts, differentiable in them and in the parameters.
        """
        return (self.offset.to(facts) + exact_product(facts, self.weights.to(facts))).sigmoid()

    def unseen(self, expected: tuple[float, float], *, promised: float, discoveries: float) -> tuple[Tensor, Tensor]:
        """Estimate n, the number of objects that only further looks would show.

        Args:
            expected: objects that the evidence still expects, in cells that clearly promise one and in others.
            promised: W, objects that the looks so far promised.
            discoveries: F, objects that they have shown for the first time.

        Returns:
            Mean and variance of n, `()` each, differentiable in the parameters.
        """
        clear, faint = expected
        number = clear + self.faint * faint
        weight_promised = self.promise * promised
        rate = self.strength + weight_promised
        # E[c] in a form that is c0 where the strength is infinite; n is Poisson there, and its variance is its mean.
        scale = self.scale + (discoveries - self.scale * weight_promised) / rate
        mean = scale * number
        return mean, mean * (1 + number / rate)

    def _fitted_values(self) -> dict[str, object]:
        return {"spread": self.spread}

    def _load_fitted_values(self, values: Mapping[str, Any]) -> None:
        self.spread = values["spread"]


def _parameter(numbers: float | Sequence[float]) -> nn.Parameter:
    """Make a parameter of the default type, of whole numbers, too."""
    return nn.Parameter(torch.tensor(numbers, dtype=torch.get_default_dtype()))


def _decimals(parameters: Sequence[Tensor]) -> list[float]:
    """List parameters `()` by the shortest decimals that are rounded to them: 0.1 in float32 is 0.1."""
    numbers = torch.stack([*parameters]).detach().cpu()
    if numbers.dtype == torch.bfloat16:
        numbers = numbers.float()  # NumPy has no such type
    return [float(str(number)) for number in numbers.numpy()]


BY_SCORE = Certainty.of([0.0, 1.0]).requires_grad_(False)
"""The certainty of an object whose probability is its score, where none was fitted."""


def reacts(chances: Tensor) -> bool:
    """Tell whether a detector reacts to objects: several are likely, or the likely ones have most of the sum.

    Args:
        chances: `(M,)`, probabilities of the objects.

    Returns:
        Whether it does.
    """
    likely = chances[chances >= LIKELY]
    return len(likely) >= SEVERAL or float(likely.sum()) >= _LIKELY_SHARE * float(chances.sum())


def number_of_faint(chances: Tensor) -> tuple[float, float]:
    r"""Estimate the number of objects of a class to which the detector hardly reacts.

    It misses as many as it shows: in 71 photographs of the fit in which it hardly reacts to people, the probabilities
    have a sum of 150, and there are 279 people. In 68 of them the true number is within two of the errors:

    .. math:: E = 2 \sum_i p_i, \qquad \sigma^2 = \sum_i p_i (1 - p_i) + (1 + E)^2

    Args:
        chances: `(M,)`, probabilities of the objects.

    Returns:
        Mean and variance.
    """
    p = chances.double()
    mean = 2 * float(p.sum())
    return mean, float((p * (1 - p)).sum()) + (1 + mean) ** 2


def number_of(chances: Tensor, unseen: tuple[float, float], spread: float) -> tuple[float, float]:
    r"""Estimate the number of objects in all, including those that no look has shown.

    .. math:: E = \sum_i p_i + E[n], \qquad
              \sigma^2 = \varphi \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2

    φ is `DISPERSION`.

    Args:
        chances: `(M,)`, probabilities of the objects.
        unseen: mean and variance of the number n of objects that no look has shown (`Certainty.unseen`).
        spread: τ, standard deviation of the share by which the model is off in a picture.

    Returns:
        Mean and variance.
    """
    p = chances.double()
    mean_unseen, variance_unseen = unseen
    mean = float(p.sum()) + mean_unseen
    variance_of_shown = DISPERSION * float((p * (1 - p)).sum())
    return mean, variance_of_shown + variance_unseen + (spread * mean) ** 2
