"""Searches for any of several classes: the combined belief against one observer per class."""

import pytest
import torch

from semfov import Grid, TargetEvidence
from semfov.belief.observers import AnyOf, Semantic, Target
from semfov.belief.observers.any_of import class_meant
from semfov.belief.target_evidence import Thresholds
from semfov.gaze.policies import Policy
from semfov.strategy import Strategy
from tests.refusals import refused

GRID = Grid(5, 4, (100, 60))
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]
WEIGHTS = {1: 1.0, 3: 0.4}


@pytest.fixture(params=["evidence", "map"])
def inner(request):
    torch.manual_seed(3)
    if request.param == "map":
        return Semantic(4, tempering=0.25)
    model = TargetEvidence(8, 6, components=4, thresholds=Thresholds(0.8, 0.1))
    return Target(model.eval().requires_grad_(False))


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, most=4, components=4)


def believed(observer, looks, target):
    belief = observer.start(1, GRID, looks.scores)
    for look in range(3):
        part = slice(look, look + 1)
        belief = observer(belief, looks[part], FIXATIONS[part], GRID, target)
    return belief


def test_probability_of_any_class_is_one_minus_the_probability_of_none(inner, looks):
    several = believed(AnyOf(inner, WEIGHTS), looks, None)
    for what in ("probability", "chance", "presence"):
        missing = 1.0
        for index, weight in WEIGHTS.items():
            missing = missing * (1 - weight * getattr(believed(inner, looks, index), what)(index))
        for asked in (1, 2, 3):
            torch.testing.assert_close(getattr(several, what)(asked), 1 - missing)


def test_with_one_class_the_belief_equals_that_of_the_inner_observer(inner, looks):
    alone, single = believed(inner, looks, 2), believed(AnyOf(inner, {2: 1.0, 1: 0.0}), looks, None)
    torch.testing.assert_close(single.probability(2), alone.probability(2))
    torch.testing.assert_close(single.presence(2), alone.presence(2))
    torch.testing.assert_close(single.closest, alone.closest)
    assert class_meant(single, 1) == 2
    assert AnyOf(inner, {2: 1.0}).thresholds == inner.thresholds


def test_the_likeliest_class_takes_the_weights_into_account(inner, looks):
    peaks = {index: float(believed(inner, looks, index).probability(index).max()) for index in (1, 2, 3)}
    for low in (1.0, 0.01):
        weights = {1: low, 2: 1.0, 3: low}
        best = max(weights, key=lambda index: weights[index] * peaks[index])
        assert class_meant(believed(AnyOf(inner, weights), looks, None), 1) == best


def test_belief_fades_like_that_of_the_inner_observer(inner, looks):
    observer = AnyOf(inner, WEIGHTS)
    visited = torch.arange(20)[None] % 3 == 0
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    faded = observer.update(observer.fade(believed(observer, looks, None), look, 0.5, visited), look)
    missing = 1.0
    for index, weight in WEIGHTS.items():
        part = inner.weigh(looks[:1], FIXATIONS[:1], GRID, index)
        one = inner.update(inner.fade(believed(inner, looks, index), part, 0.5, visited), part)
        missing = missing * (1 - weight * one.chance(index))
    torch.testing.assert_close(faded.chance(1), 1 - missing)


def test_a_look_is_weighed_once_for_each_class_or_once_for_all(inner, looks):
    """Once for all if the evidence does not depend on the target; classes without weight are left out."""
    observer = AnyOf(inner, {1: 1.0, 2: 0.0, 3: 0.4})
    once = 2 if inner.by_target else 1
    assert len(observer.weigh(looks, FIXATIONS, GRID).inner) == len(observer.start(1, GRID, looks.scores).inner) == once
    assert observer.weights == {1: 1.0, 3: 0.4}


def test_bad_input(inner):
    for weights in ({}, {1: 0.0}, {1: 1.5}, {1: -0.1, 2: 1.0}):
        refused("weights", AnyOf, inner, weights)
    classes, strategy = ("background", "cup", "wine glass"), Strategy(Semantic(3), Policy("non-predictive"))
    assert strategy.sought({"Cups": 1, 2: 0.5}, classes)[2] == {1: 1, 2: 0.5}
    for target, message in (
        ({}, "several"),
        ({"cup": 1, 1: 1}, "twice"),
        ({"cat": 1}, "unknown class"),
        ({99: 1.0}, "^target:"),
    ):
        refused(message, strategy.sought, target, classes)
