"""Deciding whether a large picture holds a class: features of a search, and decisions."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F

from semfov.agents import ZoomAgent
from semfov.belief.target_evidence import Thresholds
from semfov.decision import OUTCOMES, settle
from semfov.fit.windows import _fit_judge, _judge_searches, _Searches
from semfov.metrics.calibration import calibration_error
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.decision import SearchFacts
from semfov.zoom.episode import look_for
from semfov.zoom.evidence import CASE, features
from semfov.zoom.glances import LiveGlances
from semfov.zoom.lattice import CELLS

SHARE = st.floats(0, 1, width=32)


@given(SHARE, st.booleans(), SHARE, SHARE, SHARE)
def test_decisions_follow_the_rule(presence, looked, left, confirm, give_up):
    ended = settle(*(torch.tensor([each]) for each in (presence, looked, left)), Thresholds(confirm, give_up))
    if presence >= confirm and looked:
        expected = 1
    elif left >= give_up:
        expected = 0
    else:
        expected = 2 if presence < 0.5 else 3
    assert int(ended) == expected


@pytest.fixture
def eye(detector):
    return WindowEye(detector)


def turns(eye, picture, target, most=6):
    torch.manual_seed(0)
    glances = LiveGlances(eye, eye.open(picture))
    steps = look_for(glances, GlimpseEvidence(3, 8).eval(), target)
    with torch.inference_mode():
        return [turn for turn, _ in zip(steps, range(most), strict=False)]


def test_features_of_a_search_equal_those_computed_from_its_looks(eye, picture):
    """Every feature, computed in another way from the looks."""
    target, seen = 1, turns(eye, picture, 1)
    facts = SearchFacts(seen[0].belief)
    for turn in seen:
        facts.add(turn.glance)
    scores = [float(turn.glance.show[target - 1]) for turn in seen]
    closest = [s for s, turn in zip(scores, seen, strict=True) if turn.glance.gist is None]
    named = [
        float(d.scores[0, n, target])
        for d in (turn.glance.detections for turn in seen)
        for n in range(d.scores.shape[1])
        if int(d.scores[0, n].argmax()) == target
    ]
    ordered = sorted(scores, reverse=True)
    case = facts.case(0.25)
    raw = torch.tensor([ordered[0], ordered[1], max([0.0, *closest]), scores[0], max([0.0, *named]), 0.25])
    torch.testing.assert_close(case[:6], features(raw))
    belief = seen[0].belief
    chances = belief.chances(belief.lattice.levels - 1)
    laid = [chances[row::CELLS, column::CELLS].sum() for row in range(CELLS) for column in range(CELLS)]
    assert case[6] == pytest.approx(math.log(sum(laid) / len(laid) + 1e-3) / 4)
    assert case[7] == pytest.approx(float(belief.left.mean()))
    assert case[8] == pytest.approx(math.log(1 + sum(score >= 0.1 for score in scores)) / 2)
    assert case[9] == pytest.approx(math.log(len(seen)) / 2)
    assert case.shape == (CASE,)
    boxes = torch.cat([turn.glance.detections.boxes[0] for turn in seen])
    confidence = torch.cat([turn.glance.detections.scores[0, :, target] for turn in seen])
    assert facts.box.tolist() == boxes[confidence.argmax()].tolist()


def test_before_fitting_the_probability_is_the_best_score(eye, picture):
    seen = turns(eye, picture, 1)
    facts = SearchFacts(seen[0].belief)
    for turn in seen:
        facts.add(turn.glance)
        assert facts.presence(turn.ahead) == pytest.approx(min(max(facts.best, 1e-4), 1 - 1e-4), abs=1e-5)


def test_decisions_use_the_thresholds_of_the_evidence(eye, picture, tmp_path):
    torch.manual_seed(0)
    evidence = GlimpseEvidence(3, 8, thresholds=Thresholds(0.3, 0.02))
    evidence.save(tmp_path / "own.safetensors")
    evidence = GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors")
    assert evidence.thresholds == Thresholds(0.3, 0.02)
    agent = ZoomAgent(eye, evidence)
    path = agent.search(picture, "red")
    assert path.decision.outcome == "found"
    assert path.decision.probability >= 0.3
    longer = agent.search(picture, "red", confirm=1.0, give_up=0.0, passes=path.passes + 2)
    assert longer.passes > path.passes
    assert longer.decision.outcome == "undecided"
    assert agent.search(picture, "green", give_up=1.0).passes == 1


def synthetic(count, seed):
    """Random searches; the probability that the target is present follows from their features."""
    generator = torch.Generator().manual_seed(seed)
    case = torch.randn(count, 1, CASE, generator=generator)
    best = torch.rand(count, 1, generator=generator)
    odds = torch.logit(best, eps=1e-4) + 2 * case[..., 2] - case[..., 6] - 1
    there = torch.rand(count, generator=generator) < odds[:, 0].sigmoid()
    return _Searches(best, case, best > 0.1, torch.zeros(count, 1), there), odds[:, 0]


@pytest.mark.parametrize("target", [1, 2, 3])
@pytest.mark.parametrize(("confirm", "give_up"), [(0.9, 0.005), (0.3, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_searches_end_as_if_every_look_were_judged(eye, picture, target, confirm, give_up):
    """A search computes the probability only where it can matter; here it is computed after every look."""
    most, thresholds = 6, Thresholds(confirm, give_up)
    torch.manual_seed(0)
    evidence, glances = GlimpseEvidence(3, 8).eval(), LiveGlances(eye, eye.open(picture))
    facts, passes, ended = None, 0, 0
    with torch.inference_mode():
        for turn in look_for(glances, evidence, target):
            facts = facts or SearchFacts(turn.belief)
            facts.add(turn.glance)
            presence, passes = facts.presence(turn.ahead), passes + 1
            state = torch.tensor([presence]), torch.tensor([facts.detected]), torch.tensor([turn.ahead])
            ended = int(settle(*state, thresholds))
            if ended or passes == most:
                break
        path = ZoomAgent(eye, evidence).search(picture, target, passes=most, confirm=confirm, give_up=give_up)
    assert path.passes == passes
    assert path.decision.outcome == OUTCOMES[ended]
    assert path.decision.probability == presence


def test_a_fitted_probability_is_calibrated():
    torch.manual_seed(0)
    model = GlimpseEvidence(3, 8)
    known, _ = synthetic(4000, 1)
    _fit_judge(model, known, steps=250)
    new, odds = synthetic(4000, 2)
    with torch.no_grad():
        log_odds = model.anywhere(new.best, new.case)[:, 0]
    best = F.binary_cross_entropy_with_logits(odds, new.there.float())
    loss = F.binary_cross_entropy_with_logits(log_odds, new.there.float())
    raw = F.binary_cross_entropy(new.best[:, 0], new.there.float())
    assert loss < best + 0.1 * (raw - best)
    assert calibration_error(log_odds.sigmoid(), new.there) < 0.03 < calibration_error(new.best[:, 0], new.there)

    class Bounds:
        false_alarms, surest, lost = 0.05, 1.0, 0.02

    rows = _judge_searches(model, new, Bounds())
    assert "ECE" in rows[0]
    sure = (log_odds.sigmoid() >= model.thresholds.confirm) & new.looked[:, 0]
    assert sure[~new.there].double().mean() <= 0.05
