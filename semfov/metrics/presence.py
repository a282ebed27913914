"""Measures of deciding whether a target is present."""

import math
from bisect import bisect_right

import torch
from torch import Tensor

from semfov.errors import check


def area_under_roc(score: Tensor, present: Tensor) -> float:
    """Area under the receiver operating characteristic (Hanley and McNeil, 1982).

    It is the probability that a case with the target scores higher than one without:

    .. math:: P(s_+ > s_-) + P(s_+ = s_-) / 2

    Args:
        score: `(M,)`, higher where the target is more likely present.
        present: `(M,)` boolean, whether it is; some must be true and some false.

    Returns:
        The area, from 0 to 1; 0.5 for scores without information.

    Raises:
        InputError: the target is present in all cases or in none.

    >>> area_under_roc(torch.tensor([0.9, 0.4, 0.4, 0.1]), torch.tensor([True, True, False, False]))
    0.875
    """
    check(bool(present.any() and not present.all()), "present", "both true and false values", "only one of the two")
    hit, miss = score[present].double(), score[~present].double().sort().values
    below = torch.searchsorted(miss, hit) + torch.searchsorted(miss, hit, right=True)
    return float(below.double().mean() / (2 * len(miss)))


def threshold_for(absent: Tensor, share: float) -> float:
    """The lowest threshold that keeps the false alarm rate at or below a limit; -inf for a limit of 1.

    Args:
        absent: `(M,)`, scores of the cases without the target.
        share: largest false alarm rate: the fraction of these cases that may reach the threshold, from 0 to 1.

    Returns:
        The threshold. A score at or above it reports the target as present.

    Raises:
        InputError: there is no case without the target.

    >>> threshold_for(torch.tensor([0.1, 0.2, 0.3, 0.9]), 0.25) <= 0.31
    True
    """
    check(len(absent) > 0, "absent", "at least one case without the target", "none")
    count = len(absent)
    # A product of floats can fall on the wrong side of a whole number: 0.29 · 100 is less than 29.
    allowed = bisect_right(range(1, count + 1), share, key=lambda alarms: alarms / count)
    if allowed >= count:
        return -math.inf
    order = absent.double().sort(descending=True).values
    return float(torch.nextafter(order[allowed], torch.tensor(torch.inf, dtype=torch.float64)))


def hits_at(score: Tensor, present: Tensor, share: float) -> float:
    """Hit rate at a given false alarm rate: the fraction of the cases with the target that reach the threshold.

    Args:
        score: `(M,)`, higher where the target is more likely present.
        present: `(M,)` boolean, whether it is.
        share: largest false alarm rate, from 0 to 1.

    Returns:
        The hit rate, from 0 to 1.

    >>> hits_at(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]), 0.0)
    0.5
    """
    return float((score[present].double() >= threshold_for(score[~present], share)).double().mean())


def roc(score: Tensor, present: Tensor) -> tuple[list[float], list[float]]:
    """The receiver operating characteristic: false alarm rate and hit rate at every threshold.

    Args:
        score: `(M,)`, higher where the target is more likely present.
        present: `(M,)` boolean, whether it is; some must be true and some false.

    Returns:
        False alarm rates and hit rates, both ascending from 0 to 1.

    Raises:
        InputError: the target is present in all cases or in none.

    >>> roc(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]))
    ([0.0, 0.0, 0.5, 0.5, 1.0], [0.0, 0.5, 0.5, 1.0, 1.0])
    """
    check(bool(present.any() and not present.all()), "present", "both true and false values", "only one of the two")
    levels = score.unique(sorted=True).flip(0)[:, None]
    positive = score >= levels
    shares = [(positive[:, kind].double().mean(1)).tolist() for kind in (~present, present)]
    return [0.0, *shares[0]], [0.0, *shares[1]]
