"""Measures of deciding whether a target is present."""

import torch
from torch import Tensor

from semfov.errors import check
from semfov.metrics.labels import as_numbers, as_outcomes


def scores_by_presence(score: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Scores of the cases with the target, and of those without; there is at least one of each."""
    scores = as_numbers(score, "score")
    there = as_outcomes(present, "present").to(scores.device)
    check(there.shape == scores.shape, "present", f"one outcome for each score {(*scores.shape,)}", (*there.shape,))
    check(bool(there.any() and not there.all()), "present", "both true and false values", "only one of the two")
    return scores[there].double(), scores[~there].double()


def area_under_roc(score: Tensor, present: Tensor) -> float:
    """Area under the receiver operating characteristic (Hanley and McNeil, 1982); score `(M,)`, present `(M,)`.

    It is the probability that a case with the target scores higher than one without:

    .. math:: P(s_+ > s_-) + P(s_+ = s_-) / 2
    """
    hit, miss = scores_by_presence(score, present)
    miss = miss.sort().values
    below = torch.searchsorted(miss, hit) + torch.searchsorted(miss, hit, right=True)
    return float(below.double().mean() / (2 * len(miss)))
