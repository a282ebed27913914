"""Figures of merit of telling whether a target is there."""

import math

import torch
from torch import Tensor

from semfov.errors import check


def area_under_roc(score: Tensor, present: Tensor) -> float:
    r"""Probability that a case with the target scores higher than one without (Hanley and McNeil, 1982).

    .. math:: P(s_+ > s_-) + P(s_+ = s_-) / 2

    Args:
        score: `(M,)`.
        present: `(M,)` boolean; cases of both kinds are needed.

    >>> area_under_roc(torch.tensor([0.9, 0.4, 0.4, 0.1]), torch.tensor([True, True, False, False]))
    0.875
    """
    check(bool(present.any() and not present.all()), "present", "cases with and without the target", "one kind alone")
    hit, miss = score[present].double(), score[~present].double().sort().values
    below = torch.searchsorted(miss, hit) + torch.searchsorted(miss, hit, right=True)
    return float(below.double().mean() / (2 * len(miss)))


def threshold_for(absent: Tensor, share: float) -> float:
    """Least threshold that no more than this share of the cases without the target reach; -inf where all of them may.

    Args:
        absent: `(M,)`, scores of cases without the target.
        share: of false alarms.

    >>> threshold_for(torch.tensor([0.1, 0.2, 0.3, 0.9]), 0.25) <= 0.31
    True
    """
    check(len(absent) > 0, "absent", "at least one case", "none")
    allowed = int(share * len(absent))
    if allowed >= len(absent):
        return -math.inf
    order = absent.double().sort(descending=True).values
    return float(torch.nextafter(order[allowed], torch.tensor(torch.inf, dtype=torch.float64)))


def hits_at(score: Tensor, present: Tensor, share: float) -> float:
    """Share of the cases with the target that are told at this share of false alarms.

    >>> hits_at(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]), 0.0)
    0.5
    """
    return float((score[present].double() >= threshold_for(score[~present], share)).double().mean())


def roc(score: Tensor, present: Tensor) -> tuple[list[float], list[float]]:
    """Shares of false alarms and of hits at every threshold, from none to all.

    >>> roc(torch.tensor([0.9, 0.4, 0.5, 0.1]), torch.tensor([True, True, False, False]))
    ([0.0, 0.0, 0.5, 0.5, 1.0], [0.0, 0.5, 0.5, 1.0, 1.0])
    """
    check(bool(present.any() and not present.all()), "present", "cases with and without the target", "one kind alone")
    levels = score.unique(sorted=True).flip(0)[:, None]
    told = score >= levels
    shares = [(told[:, kind].double().mean(1)).tolist() for kind in (~present, present)]
    return [0.0, *shares[0]], [0.0, *shares[1]]
