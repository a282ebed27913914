"""The schedule of epochs and learning rates, on trainings with given losses."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semfov.training.foveal_epochs import Epoch, best_of, next_epoch
from semfov.training.foveal_settings import FinetuneConfig

CONFIG = FinetuneConfig(rates=(0.1, 0.9), epochs=8, patience=2)


def epoch(loss, rate=0.0, trial=False):
    return Epoch(rate, trial, training=1.0, objectness=loss, classes=0.0, boxes=0.0, seconds=1.0)


def simulate(losses, config=CONFIG):
    """The epochs of a training whose losses are given."""
    history = [epoch(losses[0])]
    for loss in losses[1:]:
        following = next_epoch(history, config)
        if following is None:
            break
        history.append(epoch(loss, *following))
    return history


def rates_and_trials(history):
    return [(pytest.approx(each.rate), each.trial) for each in history[1:]]


def test_each_rate_is_tried_for_one_epoch_and_training_continues_with_the_best():
    history = simulate([9, 8, 7, 6])
    assert rates_and_trials(history) == [(0.1, True), (0.9, True), (0.9, False)]
    assert rates_and_trials(simulate([9, 7, 8, 6]))[-1] == (0.1, False)


def test_an_epoch_without_improvement_divides_the_rate_and_two_end_training():
    history = simulate([9, 8, 7, 7.5, 6, 6.5, 6.5, 1])
    assert rates_and_trials(history)[2:] == [(0.9, False), (0.3, False), (0.3, False), (0.1, False)]
    assert len(history) == 7
    assert best_of(history) == 4


def test_the_untrained_detector_may_be_the_best():
    history = simulate([5, 8, 7, 6, 6, 1])
    assert len(history) == 5
    assert best_of(history) == 0


def test_trials_count_as_epochs():
    assert len(simulate([float(n) for n in range(30, 0, -1)])) == 1 + CONFIG.epochs
    few = FinetuneConfig(rates=(0.1, 0.2, 0.3), epochs=2)
    assert len(simulate([9, 8, 7, 6, 5, 4], few)) == 4


@given(st.lists(st.floats(0, 10), min_size=20, max_size=20))
def test_every_training_ends_and_rates_never_grow(losses):
    history = simulate(losses)
    assert next_epoch(history, CONFIG) is None
    rates = [each.rate for each in history[1:] if not each.trial]
    assert rates == sorted(rates, reverse=True)
    assert history[best_of(history)].loss == min(each.loss for each in history)
