"""Decide on the next epoch of training from the results of the epochs before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from semfov.training.foveal_settings import FinetuneConfig

LESS = 3.0
"""Divisor of the learning rate after an epoch without improvement."""


@dataclass(frozen=True)
class Epoch:
    """The results of an epoch.

    Attributes:
        rate: learning rate; 0 for the original detector.
        trial: whether the epoch started from the original detector, to try a learning rate.
        training: mean loss of a training view during the epoch.
        objectness: objectness loss after the epoch, as a mean over held-out views.
        classes: classification loss after the epoch, as a mean over held-out views.
        boxes: box loss after the epoch, as a mean over held-out views.
        seconds: processor seconds that the epoch took.
    """

    rate: float
    trial: bool
    training: float
    objectness: float
    classes: float
    boxes: float
    seconds: float

    @property
    def loss(self) -> float:
        """Mean loss of a held-out view, the criterion for choosing epochs."""
        return self.objectness + self.classes + self.boxes


def best_of(history: Sequence[Epoch]) -> int:
    """Return the number of the epoch with the lowest loss on held-out views, the first one if there are several."""
    return min(range(len(history)), key=lambda number: history[number].loss)


def next_epoch(history: Sequence[Epoch], config: FinetuneConfig) -> tuple[float, bool] | None:
    """Choose the learning rate of the next epoch.

    First, each learning rate is tried for one epoch from the original detector. Then training continues from the best
    epoch so far. After each epoch without improvement, the learning rate is divided by 3.

    Args:
        history: results of the epochs so far. The first entry is the original detector.
        config: the settings.

    Returns:
        The learning rate and whether the epoch is a trial, or None if training is over.
    """
    tried = sum(epoch.trial for epoch in history)
    if tried < len(config.rates):
        return config.rates[tried], True
    rate = min(history[1 : tried + 1], key=lambda epoch: epoch.loss).rate
    worse = 0
    for number in range(tried + 1, len(history)):
        better = history[number].loss < min(epoch.loss for epoch in history[:number])
        worse = 0 if better else worse + 1
        rate = history[number].rate / (1 if better else LESS)
    ended = worse >= config.patience or len(history) > max(config.epochs, tried)
    return None if ended else (rate, False)
