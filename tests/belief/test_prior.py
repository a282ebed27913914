"""Probabilities for another share of searches whose target is there."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from semfov.belief import Grid
from semfov.belief.observers import SemanticSearch
from semfov.belief.prior import Prior, check_share, with_prior
from semfov.detection import Detections
from semfov.errors import InputError
from semfov.fit.photographs import measured_shares
from semfov.gaze.policies import Policy
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.presence import Presence
from semfov.strategy import Strategy
from semfov.zoom.evidence import PhotographEvidence
from tests.refusals import refused

shares = st.floats(0.01, 0.99)
chances = st.floats(1e-6, 1 - 1e-6)


def bayes(likelihoods, prior):
    """Posterior of presence, from the likelihoods of what was seen with the target there and not."""
    there, missing = likelihoods
    return prior * there / (prior * there + (1 - prior) * missing)


@given(st.tuples(st.floats(1e-3, 1), st.floats(1e-3, 1)), shares, shares)
def test_log_odds_for_another_prior_are_those_of_bayes_rule(likelihoods, fitted, prior):
    odds = torch.tensor(bayes(likelihoods, fitted), dtype=torch.float64).logit()
    assert float(with_prior(odds, prior, fitted).sigmoid()) == pytest.approx(bayes(likelihoods, prior), abs=1e-9)
    assert with_prior(float(odds), prior, fitted) == pytest.approx(float(with_prior(odds, prior, fitted)))


@given(chances, chances, shares, shares)
def test_a_place_keeps_its_share_of_the_picture(place, presence, fitted, share):
    prior = Prior(share, fitted)
    assert prior(presence) == pytest.approx(bayes((presence / fitted, (1 - presence) / (1 - fitted)), share), abs=1e-9)
    whole = max(place, presence)
    assert prior.at_place(place, presence) == pytest.approx(place / whole * prior(whole))
    assert prior.at_place(place, presence) <= prior(whole) + 1e-12
    exact = torch.tensor([place, presence], dtype=torch.float64)
    assert prior.at_place(place, presence) == float(prior.at_place(exact[0], exact[1]))
    assert prior.inverse(prior(presence)) == pytest.approx(presence, rel=1e-6)
    assert prior.inverse.at_place(prior.at_place(place, whole), prior(whole)) == pytest.approx(place, rel=1e-6)


def test_the_share_of_the_fit_changes_nothing_and_without_one_half_is_assumed():
    chances = torch.rand(9)
    unknown = [Prior.of(None, None), Prior.of("fit", None)]
    fitted = Prior.of("fit", 0.75)
    for prior in (Prior(), Prior(0.3, 0.3), fitted, *unknown):
        assert prior(chances) is chances
        assert prior.at_place(chances, chances) is chances
    assert (fitted.assumed, [prior.assumed for prior in unknown]) == (0.75, [None, None])
    assert Prior.of(0.2, 0.75) == Prior.of(0.2, 0.75, 0.3) == Prior(0.2, 0.75)
    assert Prior.of("fit", 0.5, 0.3) == Prior(0.3, 0.5)
    usual = Prior.of(None, 0.75)
    assert (usual, usual.assumed) == (Prior(0.5, 0.75), 0.5)
    assert usual(0.75) == pytest.approx(0.5)


def test_certain_probabilities_stay():
    prior = Prior(0.1, 0.7)
    assert [prior(0.0), prior(1.0), prior.at_place(0.0, 0.0)] == [0.0, 1.0, 0.0]


def test_bad_input():
    for share in (0, 1, 1.5, -0.1, math.nan, True, "0.2"):
        refused("prior: expected a share above 0 and below 1", check_share, share)
        refused("prior: expected a share above 0 and below 1", Prior.of, share, 0.5)
    refused("prior: expected None for models without the share of their fit, got 0.2", Prior.of, 0.2, None)


CLASSES = ["person", "bicycle", "car"]


def searching(**settings):
    return FovealObservationModel.identity(CLASSES, [], miss_odds=torch.full((4, 1), 0.3), **settings)


PRESENCE = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.tensor([0.5, 0.75, 0.1]))


def belief_of(prior):
    model = searching(presence=PRESENCE).double().requires_grad_(False)
    observer, grid = SemanticSearch(model, prior=prior), Grid(4, 3, (80, 60))
    boxes = torch.tensor([[[5.0, 5, 30, 30]]], dtype=torch.float64)
    scores = torch.tensor([[[0.1, 0.7, 0.1, 0.1]]], dtype=torch.float64)
    seen, fixation = Detections(boxes, scores, torch.ones(1, 1).bool()), torch.tensor([[30.0, 10.0]]).double()
    return observer(observer.start(1, grid, fixation[:, 0]), seen, fixation, grid, target=1)


def test_a_belief_has_the_numbers_of_another_prior():
    plain = belief_of(None)
    rare = belief_of(Prior(0.1, 0.6))
    for value, before in ((rare.presence(1), plain.presence(1)), (rare.chance(1), plain.chance(1))):
        assert torch.allclose(value, with_prior(before.logit(), 0.1, 0.6).sigmoid())
    whole = torch.maximum(plain.probability(1), plain.presence(1)[:, None])
    expected = plain.probability(1) / whole * with_prior(whole.logit(), 0.1, 0.6).sigmoid()
    assert torch.allclose(rare.probability(1), expected)


def test_a_strategy_changes_a_presence_that_assumes_even_searches():
    strategy = Strategy(SemanticSearch(searching(presence=PRESENCE)), Policy("non-predictive"))
    changed, prior = strategy.with_prior(0.3, 2)
    assert prior == Prior(0.3, 0.5)
    assert changed.observer.prior == prior
    assert strategy.with_prior(None, 2)[1] == Prior(0.5, 0.5)
    assert strategy.with_prior("fit", 2)[1] == Prior(0.75, 0.5)
    assert strategy.with_prior("fit", 1)[1].changes_nothing
    assert strategy.observer.prior == Prior()
    several, _, _ = strategy.sought(["person", "bicycle"], ("background", *CLASSES))
    with pytest.raises(InputError, match="prior: expected None for a search for any of several classes"):
        several.with_prior(0.3, 2)
    unfitted = Strategy(SemanticSearch(searching()), Policy("non-predictive"))
    assert unfitted.with_prior("fit", 2)[1] == Prior(known=False)
    refused("prior: expected None for models without the share of their fit, got 0.3", unfitted.with_prior, 0.3, 2)


def test_measured_shares_maximise_the_penalised_likelihood_of_each_class():
    """The shift of each class is that of scipy's minimiser."""
    torch.manual_seed(0)
    evidence = PhotographEvidence(3).requires_grad_(False)
    evidence.usual.copy_(torch.tensor([0.0, -1.0, -2.0]))
    held = torch.rand(60, 3) < torch.tensor([0.5, 0.3, 0.1])
    scores = (0.1 + 0.6 * held + 0.3 * torch.rand(60, 3)).clamp(max=0.99)
    before = torch.tensor([0.6, 0.5, 0.2])
    shares = measured_shares(evidence, scores, held, before)
    for number in range(3):
        odds = evidence.presence(scores[:, number], torch.full((60,), number + 1)).double()
        there = held[:, number]
        usual = float(((there.sum() + 0.5) / 61).double().logit())
        expected = usual - float(before[number].double().logit())

        def cost(shift, odds=odds, there=there, expected=expected):
            right = torch.where(there, odds + shift, -odds - shift)
            return float(-torch.nn.functional.logsigmoid(right).sum()) + 2.5 * (shift - expected) ** 2

        shift = minimize_scalar(cost, bounds=(-20, 20), method="bounded", options={"xatol": 1e-8}).x
        assert usual - shift == pytest.approx(float(shares[number].double().logit()), abs=1e-3)
