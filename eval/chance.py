"""What chance alone gives: the searches of random gaze, and the errors of probabilities that are right."""

from math import comb

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.metrics.calibration import calibration_error
from semfov.metrics.labels import as_numbers


def errors_by_chance(confidence: Tensor, bins: int = 15, *, samples: int = 1000, seed: int = 0) -> Tensor:
    r"""Compute expected calibration errors of perfectly calibrated predictions, which are above 0 by chance.

    The outcomes are drawn from the predicted probabilities (Bröcker and Smith, 2007, consistency resampling):

    .. math:: y_i \sim \mathrm{Bernoulli}(p_i)

    Shapes: confidence `(M,)` → `(samples,)`.
    """
    p = as_numbers(confidence, "confidence").double().detach().cpu()
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.rand(samples, len(p), generator=generator, dtype=torch.float64) < p
    return torch.stack([calibration_error(p, outcome, bins) for outcome in drawn])


def random_search(targets: int, shifts: int, cells: int = 100) -> NDArray[np.float64]:
    r"""Probability that random search without return has hit one of `targets` cells after 0..`shifts` gaze shifts.

    The start is not a target cell, so n gaze shifts draw n of the other N = `cells - 1` cells, of which m are targets:

    .. math:: P(n) = 1 - \binom{N - m}{n} \Big/ \binom{N}{n}

    Shapes: → `(shifts+1,)`.
    """
    others = cells - 1
    misses = [comb(others - targets, n) / comb(others, n) if n <= others else 0.0 for n in range(shifts + 1)]
    return 1 - np.array(misses)
