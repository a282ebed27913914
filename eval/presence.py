"""Measures of telling whether a target is present, by thresholds."""

import math
from bisect import bisect_right

import numpy as np
import torch
from torch import Tensor

from semfov.errors import check, check_number
from semfov.metrics.episodes import scores_by_presence


def _threshold_for(absent: Tensor, share: float) -> float:
    """Compute the lowest threshold that keeps the false alarm rate at or below a limit; -inf for a limit of 1.

    Shapes: absent `(M,)`.
    """
    check(len(absent) > 0, "absent", "at least one case without the target", "none")
    check_number(share, "share", 0, 1)
    count = len(absent)
    # A product of floats can fall on the wrong side of a whole number: 0.29 · 100 is less than 29.
    allowed = bisect_right(range(1, count + 1), share, key=lambda alarms: alarms / count)
    if allowed >= count:
        return -math.inf
    order = absent.double().sort(descending=True).values
    return float(torch.nextafter(order[allowed], torch.tensor(torch.inf, dtype=torch.float64)))


def hits_at(score: Tensor, present: Tensor, share: float) -> float:
    """Compute the hit rate at a given false alarm rate: the share of the present targets that reach the threshold.

    Shapes: score `(M,)`, present `(M,)`.
    """
    hit, miss = scores_by_presence(score, present)
    return float((hit >= _threshold_for(miss, share)).double().mean())


def roc(score: Tensor, present: Tensor) -> tuple[list[float], list[float]]:
    """Compute the receiver operating characteristic: false alarm rate and hit rate at every threshold.

    Shapes: score `(M,)`, present `(M,)`.
    """
    # NumPy sorts faster than torch on one thread.
    with_target, without_target = scores_by_presence(score, present)
    of_present = np.sort(with_target.detach().cpu().numpy())
    of_absent = np.sort(without_target.detach().cpu().numpy())
    thresholds = np.unique(np.concatenate([of_present, of_absent]))[::-1]
    false_alarm_rate = 1 - np.searchsorted(of_absent, thresholds) / len(of_absent)
    hit_rate = 1 - np.searchsorted(of_present, thresholds) / len(of_present)
    return [0.0, *false_alarm_rate.tolist()], [0.0, *hit_rate.tolist()]
