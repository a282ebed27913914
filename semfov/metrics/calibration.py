"""How well predicted probabilities agree with outcomes: scoring rules and calibration errors."""

import math
from dataclasses import dataclass
from typing import ClassVar, Self

import torch
from torch import Tensor

from semfov.errors import check, check_whole
from semfov.metrics.labels import as_numbers, as_outcomes

_ROUNDING = 1e-3
_MOST_BINS = 1_000_000


@dataclass(frozen=True)
class Calibration:
    """Scoring rules and calibration errors of a set of predictions.

    Attributes:
        count: number of predictions.
        nll: mean negative log likelihood, in nats.
        brier: mean Brier score, over all classes.
        ece: expected calibration error of the most probable class (`calibration_error`).
        classwise_ece: mean over classes of the expected calibration error of each.
        accuracy: share of predictions whose most probable class is right.
    """

    count: int
    nll: float
    brier: float
    ece: float
    classwise_ece: float
    accuracy: float


def calibration(probabilities: Tensor, labels: Tensor, *, bins: int = 15) -> Calibration:
    """Compute all measures of `Calibration`.

    Args:
        probabilities: `(M, K+1)`, of all classes.
        labels: `(M,)`, numbers of classes from 0.
        bins: number of equally wide bins of confidence.

    Returns:
        The measures; NaN where there are no predictions.

    Raises:
        InputError: a row is no distribution, a label is no class, or the shapes do not fit together.
    """
    p = _probabilities(probabilities, "probabilities")
    check(p.ndim == 2, "probabilities", "a tensor of shape (M, K+1)", f"shape {(*p.shape,)}")
    check_whole(bins, "bins", 1, _MOST_BINS)
    classes = _class_numbers(labels, p)
    if not len(classes):
        return Calibration(0, *[float("nan")] * 5)
    _check_distributions(p)
    last = p.shape[1] - 1
    low = int(classes.min())
    high = int(classes.max())
    check(low >= 0 and high <= last, "labels", f"numbers of classes from 0 to {last}", f"{low} to {high}")

    p_true = p.gather(1, classes[:, None])[:, 0]  # (M,)
    # Σ_k (p_k - y_k)², with y = 1 for the true class and 0 for all others.
    brier = p.square().sum(1) - 2 * p_true + 1
    confidence, predicted = p.max(1)
    is_right = predicted == classes
    error_by_class = [calibration_error(p[:, k], classes == k, bins) for k in range(p.shape[1])]
    return Calibration(
        count=len(classes),
        nll=float(surprisal(p_true).mean()),
        brier=float(brier.mean()),
        ece=float(calibration_error(confidence, is_right, bins)),
        classwise_ece=float(torch.stack(error_by_class).mean()),
        accuracy=float(is_right.double().mean()),
    )


def _class_numbers(labels: Tensor, probabilities: Tensor) -> Tensor:
    """Take labels as whole numbers `(M,)`, one for each row of probabilities, on their device."""
    numbers = as_numbers(labels, "labels")
    broken = numbers[numbers != numbers.floor()].tolist()
    check(not broken, "labels", "whole numbers", broken[0] if broken else "")
    expected = f"{len(probabilities)} numbers, one for each row"
    check(numbers.shape == probabilities.shape[:1], "labels", expected, f"shape {(*numbers.shape,)}")
    return numbers.to(probabilities.device, torch.int64)


def _check_distributions(p: Tensor) -> None:
    """Check that the rows of probabilities sum to 1, up to rounding."""
    total = p.detach().sum(1)
    least = float(total.min())
    most = float(total.max())
    got = f"sums from {least:g} to {most:g}; give logits.softmax(-1)"
    check(least >= 1 - _ROUNDING and most <= 1 + _ROUNDING, "probabilities", "rows that sum to 1", got)


def _probabilities(values: Tensor, argument: str) -> Tensor:
    """Take probabilities as float64; refuse numbers outside [0, 1] and NaN."""
    p = as_numbers(values, argument).double()
    if p.numel():
        least = float(p.detach().min())
        most = float(p.detach().max())
        got = f"{least:g} to {most:g}; give logits.sigmoid() or .softmax(-1)"
        check(least >= -_ROUNDING and most <= 1 + _ROUNDING, argument, "probabilities from 0 to 1", got)
    return p


def _check_row(tensor: Tensor, argument: str, count: int | None = None) -> None:
    """Raise `InputError` unless a tensor has one dimension, and so many numbers; None stands for any."""
    expected = "numbers in a row" if count is None else f"{count} in a row"
    is_row = tensor.ndim == 1 and count in (None, len(tensor))
    check(is_row, argument, expected, f"shape {(*tensor.shape,)}")


def surprisal(probability: Tensor) -> Tensor:
    """Compute the negative logarithm of probabilities.

    Args:
        probability: `(...)`; one that has underflowed counts as the smallest positive float32.

    Returns:
        `(...)`, in nats.
    """
    return -probability.clamp(min=torch.finfo(torch.float32).tiny).log()


def calibration_error(confidence: Tensor, correct: Tensor, bins: int = 15) -> Tensor:
    r"""Compute the calibration error in bins (Naeini, Cooper and Hauskrecht, 2015).

    .. math:: \sum_b \frac{n_b}{n} |\mathrm{acc}_b - \mathrm{conf}_b|

    Args:
        confidence: `(M,)`, predicted probabilities.
        correct: `(M,)`, whether they came true.
        bins: number of equally wide bins.

    Returns:
        The error, a scalar.
    """
    return _error_of(reliability(confidence, correct, bins))


def _error_of(bins: Tensor) -> Tensor:
    """Compute the calibration error from the sums of `reliability`; bins `(3, bins)`."""
    count, predicted, came_true = bins
    return (predicted - came_true).abs().sum() / count.sum().clamp(min=1)


def reliability(confidence: Tensor, correct: Tensor, bins: int | Tensor = 15) -> Tensor:
    """Sum up predictions and outcomes by bins of confidence, for a reliability diagram.

    Args:
        confidence: `(M,)`, predicted probabilities.
        correct: `(M,)`, whether they came true.
        bins: number of equally wide bins, or their inner edges `(bins - 1,)`.

    Returns:
        `(3, bins)`: numbers of predictions, sums of their probabilities, and numbers that came true.
    """
    if isinstance(bins, Tensor):
        edges = as_numbers(bins, "bins").detach().cpu()
        _check_row(edges, "bins")
        check(bool((edges.diff() > 0).all()), "bins", "edges that ascend", edges.tolist())
    else:
        check_whole(bins, "bins", 1, _MOST_BINS)
        edges = torch.arange(1, bins, dtype=torch.float64) / bins
    p = _probabilities(confidence, "confidence").detach().cpu().contiguous()
    _check_row(p, "confidence")
    came_true = as_outcomes(correct, "correct")
    _check_row(came_true, "correct", len(p))
    bin_of_prediction = torch.bucketize(p, edges)
    values = torch.stack([torch.ones_like(p), p, came_true.to(p)])  # (3, M)
    sums = torch.zeros(3, len(edges) + 1, dtype=torch.float64)
    return sums.index_add_(1, bin_of_prediction, values)


_EQUAL_EDGES = torch.arange(1, 15, dtype=torch.float64) / 15  # of the bins of `calibration_error`
_RARE_EDGES = torch.tensor([1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2], dtype=torch.float64)  # within the first of them


@dataclass(frozen=True)
class BinarySums:
    """Sums over binary predictions, for their log likelihood and Brier score (1950).

    Attributes:
        bins: `(3, 21)`, sums by bins of probability (`reliability`), of which seven divide the first of 15 equal ones.
        surprisal: sum of the negative log likelihoods, in nats.
        square: sum of the squared errors.
    """

    bins: Tensor
    surprisal: float
    square: float

    EDGES: ClassVar[Tensor] = torch.cat([_RARE_EDGES, _EQUAL_EDGES])
    """Edges between the bins."""

    @classmethod
    def of(cls, probability: Tensor, outcome: Tensor) -> Self:
        """Sum up predictions.

        Args:
            probability: `(M,)`.
            outcome: `(M,)`, whether it came true.

        Returns:
            The sums.
        """
        p = _probabilities(probability, "probability").detach()
        came_true = as_outcomes(outcome, "outcome").to(p.device)
        _check_row(p, "probability")
        _check_row(came_true, "outcome", len(p))
        cost = surprisal(torch.where(came_true, p, 1 - p))
        square = (p - came_true.double()).square()
        return cls(reliability(p, came_true, cls.EDGES), float(cost.sum()), float(square.sum()))

    @property
    def count(self) -> int:
        """Number of predictions."""
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
        if not self.count:
            return float("nan")
        parts = len(_RARE_EDGES) + 1  # bins that divide the first of the equally wide ones
        first = self.bins[:, :parts].sum(1, keepdim=True)
        return float(_error_of(torch.cat([first, self.bins[:, parts:]], 1)))
