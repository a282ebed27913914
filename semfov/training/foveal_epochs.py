"""Which epoch of training comes next, from what came of those before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from semfov.training.foveal_settings import FinetuneConfig

LESS = 3.0
"""What the learning rate is divided by after an epoch that was no better."""


@dataclass(frozen=True)
class Epoch:
    """What came of an epoch.

    Attributes:
        rate: learning rate; 0 for the detector as it was.
        trial: whether it began with the detector as it was, to try a rate.
        training: mean loss of a view while training.
        objectness: mean of this part of the loss over held-out views, after the epoch.
        classes: the same of this part.
        boxes: and of this one.
        seconds: of a processor that it took.
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
        """Mean loss of a held-out view, by which epochs are chosen."""
        return self.objectness + self.classes + self.boxes


def best_of(history: Sequence[Epoch]) -> int:
    """The epoch whose weights are kept: the first of the least loss."""
    return min(range(len(history)), key=lambda number: history[number].loss)


def next_epoch(history: Sequence[Epoch], config: FinetuneConfig) -> tuple[float, bool] | None:
    """Learning rate of the next epoch and whether it is a trial; None at the end.

    Every rate is tried for an epoch from the detector as it was; then training goes on from the best epoch yet, with a
    third of the rate after each epoch that was no better.

    Args:
        history: what came of the epochs; the first is the detector as it was.
        config: settings.
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
