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

    >>> area_under_roc(torch.tensor([0.9, 0.4, 0.4, 0.1]), torch.tensor([True, True, False, False]))
    0.875

    Shapes: score `(M,)`, present `(M,)`.
    """
    check(bool(present.any() and not present.all()), "present", "both true and false values", "only one of the two")
    hit, miss = score[present].double(), score[~present].double().sort().values
    below = torch.searchsorted(miss, hit) + torch.searchsorted(miss, hit, right=True)
    return float(below.double().mean() / (2 * len(miss)))


def _threshold_for(absent: Tensor, share: float) -> float:
    """The lowest threshold that keeps the false alarm rate at or below a limit; -inf for a limit of 1.

    >>> threshold_for(torch.tensor([0.1, 0.2, 0.3, 0.9]), 0.25) <= 0.31
    True

    Shapes: absent `(M,)`.
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

    >>> hits_at(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]), 0.0)
    0.5

    Shapes: score `(M,)`, present `(M,)`.
    """
    return float((score[present].double() >= _threshold_for(score[~present], share)).double().mean())


def roc(score: Tensor, present: Tensor) -> tuple[list[float], list[float]]:
    """The receiver operating characteristic: false alarm rate and hit rate at every threshold.

    >>> roc(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]))
    ([0.0, 0.0, 0.5, 0.5, 1.0], [0.0, 0.5, 0.5, 1.0, 1.0])

    Shapes: score `(M,)`, present `(M,)`.
    """
    check(bool(present.any() and not present.all()), "present", "both true and false values", "only one of the two")
    levels = score.unique(sorted=True).flip(0)[:, None]
    positive = score >= levels
    shares = [(positive[:, kind].double().mean(1)).tolist() for kind in (~present, present)]
    return [0.0, *shares[0]], [0.0, *shares[1]]
