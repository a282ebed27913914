"""Explorations by the semantic map that end when no look is worth its price."""

import math

import pytest
import torch

from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, Grid
from semfov.agents.fovea import _MIN_GAIN
from semfov.belief.observers import Semantic, SemanticMap
from semfov.gaze.acquisition.accuracy import _CORRECTED
from semfov.gaze.policies import Policy
from tests.refusals import refused
from tests.small import Coloured

SIZE = (160, 120)
FOVEA = 0.25  # 40 of 160 pixels


@pytest.fixture
def image():
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, 8:28, 8:28] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    return picture


@pytest.fixture
def model():
    return FovealObservationModel.identity(["red", "green"], [0.2], cell=(0.4, 1.0, 1.0)).requires_grad_(False).eval()


def agent_of(model, policy=None, grid=(5, 4)):
    eye, observer = Eye(Foveation(40.0), Coloured(), reference=160.0), SemanticMap(model)
    return ActivePerception(
        eye, (Semantic(3), Policy("non-predictive")), (observer, policy or Policy("closer-look", fovea=0.25)), grid=grid
    )


def largest_gains(scanpath):
    """The largest expected gain of a further look, in cells, after every look; computed by loops."""
    grid, answer = scanpath.grid, []

    def acuity(cell, fixation):
        distance = math.dist(grid.centres[cell].tolist(), grid.centres[fixation].tolist()) / SIZE[0]
        return math.exp(-max(distance / FOVEA - 1, 0))

    for number in range(len(scanpath)):
        before = scanpath.cells[: number + 1].tolist()
        best = -math.inf
        for fixation in set(range(len(grid))) - set(before):
            gain = 0.0
            for cell in range(len(grid)):
                wrong = 1 - float(scanpath.probabilities[number, cell].max())
                gain += _CORRECTED * wrong * max(acuity(cell, fixation) - max(acuity(cell, f) for f in before), 0)
            best = max(best, gain)
        answer.append(best)
    return answer


@pytest.mark.parametrize("policy", [None, Policy("random")], ids=["closer-look", "random"])
def test_exploration_ends_when_no_look_is_worth_its_price(model, image, policy):
    agent = agent_of(model, policy)
    whole = agent.explore(image, start=0, shifts=12, min_gain=0, seed=1)
    assert len(whole) == 13
    assert whole.ending == "shifts"
    expected = largest_gains(whole)
    assert max(expected) > 4 * min(expected)
    lengths = set()
    for limit in (0.15, 0.25, 0.35, 0.55, 0.85, 5.0):
        part = agent.explore(image, start=0, shifts=12, min_gain=limit, seed=1)
        last = next((number for number, value in enumerate(expected) if value < limit), None)
        assert part.ending == ("shifts" if last is None else "min_gain")
        assert len(part) == (13 if last is None else last + 1)
        assert torch.equal(part.cells, whole.cells[: len(part)])
        assert torch.equal(part.probabilities, whole.probabilities[: len(part)])
        assert part.target is None
        assert part.decision is None
        assert not part.found
        lengths.add(len(part))
    assert len(lengths) >= 4
    assert 1 in lengths


@pytest.mark.slow
def test_the_gain_policy_ends_when_its_largest_value_is_below_the_price(model, image):
    """After the last look every gain is below the price; after every earlier look at least one is not."""
    agent = agent_of(model, Policy("expected-gain", fovea=FOVEA))
    scanpath = agent.explore(image, start=7, shifts=19, min_gain=0.25)
    assert scanpath.ending == "min_gain"
    expected = largest_gains(scanpath)
    for number, values in enumerate(scanpath.values):
        left = values.clone()
        left[scanpath.cells[: number + 1]] = -math.inf
        assert (float(left.max()) < 0.25) == (number == len(scanpath) - 1)
        assert float(left.max()) == pytest.approx(expected[number], abs=1e-5)


def test_until_none_means_the_default_price(model, image):
    agent = agent_of(model)
    free, default, same = (
        agent.explore(image, start=0, shifts=19, min_gain=min_gain, seed=3) for min_gain in (0, None, _MIN_GAIN)
    )
    assert free.ending == "cells"
    assert default.ending == same.ending == "min_gain"
    assert torch.equal(default.cells, same.cells)
    assert 1 < len(default) < len(free) == 20


def test_price_zero_never_ends_an_exploration(image):
    """Not even with a map that is sure, so that no look is expected to gain anything."""
    classes = ["red", "green"]
    sure = FovealObservationModel.identity(classes, [0.2], cell=(1e-9, 1.0, 1e9)).requires_grad_(False).eval()
    agent = agent_of(sure)
    assert agent.explore(image, start=0, shifts=3, min_gain=0).ending == "shifts"
    assert len(agent.explore(image, start=0, shifts=30, min_gain=0)) == 20
    assert len(agent.explore(image, start=0, shifts=30, min_gain=0.01)) == 1
    assert len(agent.explore(image, start=0, shifts=30)) == 1


def test_exploration_without_gaze_shifts(model, image):
    assert agent_of(model).explore(image, start=0, shifts=0, min_gain=0.1).ending == "shifts"
    assert agent_of(model).explore(image, start=0, shifts=0, min_gain=1e3).ending == "min_gain"


def test_the_map_of_a_search_is_the_semantic_map(model, image):
    agent = agent_of(model)
    scanpath = agent.search(image, "green", start=3, shifts=3)
    grid, observer = Grid(5, 4, SIZE), SemanticMap(model)
    belief = observer.start(1, grid, image)
    for number, fixation in enumerate(scanpath.fixations):
        belief = observer(belief, scanpath.detections[number], fixation[None], grid)
        torch.testing.assert_close(belief.probabilities[0], scanpath.probabilities[number])
    assert scanpath.ending == "shifts"


def test_prices_are_numbers_for_an_agent_with_a_semantic_map(image, model):
    eye = Eye(Foveation(40.0), Coloured(), reference=160.0)
    agent = ActivePerception(eye, (Semantic(3), Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(5, 4))
    refused(r"^min_gain: expected None for an agent without a semantic map", agent.explore, image, min_gain=0.1)
    assert agent.explore(image, shifts=2).ending == agent.explore(image, shifts=2, min_gain=0).ending == "shifts"
    assert agent.explore(image, shifts=50).ending == "cells"
    for min_gain in [-0.1, math.inf, math.nan, "0.1", True, [0.1], 10**400]:
        refused("min_gain: expected a number from 0", agent_of(model).explore, image, min_gain=min_gain)
