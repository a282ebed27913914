"""How well probabilities agree with what happens: scoring rules and calibration errors."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.errors import check, check_shape


@dataclass(frozen=True)
class Calibration:
    """Figures of a set of predictions.

    Attributes:
        count: number of predictions.
        nll: mean negative log likelihood of the true class, in nats.
        brier: mean squared distance between prediction and truth, summed over classes, from 0 to 2.
        ece: expected calibration error of the most probable class.
        classwise_ece: calibration error of every class's probability, mean over classes.
        accuracy: share of predictions whose most probable class is true.
    """

    count: int
    nll: float
    brier: float
    ece: float
    classwise_ece: float
    accuracy: float


def calibration(probabilities: Tensor, labels: Tensor, *, bins: int = 15) -> Calibration:
    """All figures for predictions `(M, K+1)` and true classes `(M,)`; NaN where there are no predictions."""
    check_shape(probabilities, "probabilities", None, None)
    check_shape(labels, "labels", probabilities.shape[0])
    check(bins >= 1, "bins", "at least 1", bins)
    p = probabilities.double()
    if not len(labels):
        return Calibration(0, *[float("nan")] * 5)
    true = p.gather(1, labels[:, None])[:, 0]
    confidence, predicted = p.max(1)
    return Calibration(
        count=len(labels),
        # A probability that has underflowed to 0 costs what the smallest number costs, not infinity.
        nll=float(-true.clamp(min=torch.finfo(torch.float32).tiny).log().mean()),
        brier=float((p.square().sum(1) - 2 * true + 1).mean()),
        ece=float(calibration_error(confidence, predicted == labels, bins)),
        classwise_ece=float(
            torch.stack([calibration_error(p[:, k], labels == k, bins) for k in range(p.shape[1])]).mean()
        ),
        accuracy=float((predicted == labels).double().mean()),
    )


def calibration_error(confidence: Tensor, correct: Tensor, bins: int = 15) -> Tensor:
    r"""Expected calibration error over equally wide bins of confidence (Naeini, Cooper and Hauskrecht, 2015).

    .. math:: \sum_b \frac{n_b}{n} \, | \mathrm{acc}_b - \mathrm{conf}_b |

    Args:
        confidence: `(M,)`, predicted probabilities.
        correct: `(M,)` boolean, whether the prediction came true.
        bins: number of bins.
    """
    count, confident, right = reliability(confidence, correct, bins)
    return (confident - right).abs().sum() / count.sum().clamp(min=1)


def reliability(confidence: Tensor, correct: Tensor, bins: int = 15) -> tuple[Tensor, Tensor, Tensor]:
    """For every bin `(b/bins, (b+1)/bins]` of confidence: count, sum of confidence, number of correct predictions."""
    index = (confidence.double() * bins).ceil().long().sub(1).clamp(0, bins - 1)
    total = torch.zeros(3, bins, dtype=torch.float64)
    values = torch.stack([torch.ones_like(confidence), confidence, correct.to(confidence)]).double()
    total.index_add_(1, index, values)
    return total[0], total[1], total[2]
