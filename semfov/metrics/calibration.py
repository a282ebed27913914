"""How well predicted probabilities agree with outcomes: scoring rules and calibration errors."""

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from semfov.errors import check, check_shape
from semfov.metrics.labels import as_numbers, as_outcomes

_ROUNDING = 1e-3


@dataclass(frozen=True)
class Calibration:
    """Scoring rules and calibration errors of a set of predictions."""

    count: int
    nll: float
    brier: float
    ece: float
    classwise_ece: float
    accuracy: float


def calibration(probabilities: Tensor, labels: Tensor, *, bins: int = 15) -> Calibration:
    """Compute all measures of `Calibration` for predictions `(M, K+1)` of labels `(M,)`."""
    p = _probabilities(probabilities, "probabilities")
    check_shape(p, "probabilities", None, None)
    numbers = as_numbers(labels, "labels")
    labels = numbers.to(p.device, torch.int64)
    broken = numbers[numbers != numbers.floor()].tolist()
    check(not broken, "labels", "whole numbers", broken[0] if broken else "")
    check(labels.shape == p.shape[:1], "labels", f"{len(p)} numbers, one for each row", f"shape {(*labels.shape,)}")
    check(bins >= 1, "bins", "at least 1", bins)
    if not len(labels):
        return Calibration(0, *[float("nan")] * 5)
    total, last = p.detach().sum(1), p.shape[1] - 1
    least, most = float(total.min()), float(total.max())
    sums = least >= 1 - _ROUNDING and most <= 1 + _ROUNDING
    check(sums, "probabilities", "rows that sum to 1", f"sums from {least:g} to {most:g}; give logits.softmax(-1)")
    low, high = int(labels.min()), int(labels.max())
    check(low >= 0 and high <= last, "labels", f"numbers of classes from 0 to {last}", f"{low} to {high}")
    true = p.gather(1, labels[:, None])[:, 0]
    confidence, predicted = p.max(1)
    return Calibration(
        count=len(labels),
        nll=float(surprisal(true).mean()),
        brier=float((p.square().sum(1) - 2 * true + 1).mean()),
        ece=float(calibration_error(confidence, predicted == labels, bins)),
        classwise_ece=float(
            torch.stack([calibration_error(p[:, k], labels == k, bins) for k in range(p.shape[1])]).mean()
        ),
        accuracy=float((predicted == labels).double().mean()),
    )


def _probabilities(values: Tensor, argument: str) -> Tensor:
    """Probabilities as float64; refuses numbers outside [0, 1] and NaN."""
    p = as_numbers(values, argument).double()
    least, most = (float(p.detach().min()), float(p.detach().max())) if p.numel() else (0.0, 0.0)
    inside = least >= -_ROUNDING and most <= 1 + _ROUNDING
    got = f"{least:g} to {most:g}; give logits.sigmoid() or .softmax(-1)"
    check(inside, argument, "probabilities from 0 to 1", got)
    return p


def surprisal(probability: Tensor) -> Tensor:
    """Negative logarithm of probabilities in nats; one that has underflowed counts as the smallest positive float32."""
    return -probability.clamp(min=torch.finfo(torch.float32).tiny).log()


def calibration_error(confidence: Tensor, correct: Tensor, bins: int = 15) -> Tensor:
    """Calibration error in bins (Naeini, Cooper and Hauskrecht, 2015), Σ_b n_b / n |acc_b - conf_b|; inputs `(M,)`."""
    return _error_of(reliability(confidence, correct, bins))


def _error_of(bins: Tensor) -> Tensor:
    """Expected calibration error from the sums of `reliability`; bins `(3, bins)`."""
    count, confident, right = bins
    return (confident - right).abs().sum() / count.sum().clamp(min=1)


def reliability(confidence: Tensor, correct: Tensor, bins: int | Tensor = 15) -> Tensor:
    """Sums `(3, bins)` for a reliability diagram: what was predicted and came true, by bin of confidence `(M,)`."""
    edges = torch.arange(1, bins, dtype=torch.float64) / bins if isinstance(bins, int) else bins
    p = _probabilities(confidence, "confidence").detach().cpu().contiguous()
    right = as_outcomes(correct, "correct")
    check_shape(right, "correct", len(p))
    values = torch.stack([torch.ones_like(p), p, right.to(p)])
    return torch.zeros(3, len(edges) + 1, dtype=torch.float64).index_add_(1, torch.bucketize(p, edges), values)


_WIDE = torch.arange(1, 15, dtype=torch.float64) / 15
_RARE = torch.tensor([1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2], dtype=torch.float64)


@dataclass(frozen=True)
class BinarySums:
    """Sums over binary predictions, for their log likelihood and Brier score (1950); bins `(3, 21)`, the first in 7."""

    bins: Tensor
    surprisal: float
    square: float

    EDGES: ClassVar[Tensor] = torch.cat([_RARE, _WIDE])
    """Edges between the bins."""

    @classmethod
    def of(cls, probability: Tensor, outcome: Tensor) -> Self:
        """Sum over predictions; probability `(M,)`, outcome `(M,)`."""
        p = _probabilities(probability, "probability").detach()
        came = as_outcomes(outcome, "outcome").to(p.device)
        check_shape(p, "probability", None)
        check_shape(came, "outcome", len(p))
        cost = surprisal(torch.where(came, p, 1 - p))
        square = (p - came.double()).square()
        return cls(reliability(p, came, cls.EDGES), float(cost.sum()), float(square.sum()))

    @property
    def count(self) -> int:
        return int(self.bins[0].sum())

    @property
    def nll(self) -> float:
        """Mean negative log likelihood, in nats; this and all other means are NaN where there are no predictions."""
        return self.surprisal / (self.count or math.nan)

    @property
    def brier(self) -> float:
        """Mean squared error."""
        return self.square / (self.count or math.nan)

    @property
    def ece(self) -> float:
        """Expected calibration error over 15 equally wide bins (`calibration_error`)."""
        first = self.bins[:, : len(_RARE) + 1].sum(1, keepdim=True)
        error = float(_error_of(torch.cat([first, self.bins[:, len(_RARE) + 1 :]], 1)))
        return error if self.count else float("nan")
