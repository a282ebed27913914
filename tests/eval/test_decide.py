"""The table and the records of decisions: those of a small run, and by hand."""

import json

import pytest
import torch

from eval.chance import errors_by_chance
from eval.decide.plain import PLAIN, plain_rules
from eval.decide.report import decision_summary
from eval.presence import hits_at
from semfov.decision import OUTCOMES
from semfov.metrics.episodes import area_under_roc
from semfov.runs.tables import mean_or_dash, share
from tests.lab.commands.table import small_run
from tests.small import cells_of

pytestmark = pytest.mark.usefixtures("few_samples")

POLICIES = ["non-predictive-learned", "random gaze", "published belief", "published belief, a detection at the gaze"]
SCORES = ["one unfoveated pass, highest score", "unfoveated pass and its quarters, highest score"]
REFERENCES = [*SCORES, *PLAIN, "class frequency"]


def rows_of(text):
    """The cells of all tables without their heads and rules."""
    return [row for row in cells_of(text) if not set("".join(row)) <= set("-:") and row[0]]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of four photographs on 3 × 2 cells with untrained models."""
    model = ("--belief.model", "HERE/observation.safetensors")
    return small_run("eval.decide", tmp_path_factory.mktemp("decide"), *model)


def records_in(out):
    return [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]


def test_run_writes_table_and_records(finished):
    records = records_in(finished)
    assert len(records) == 24
    for record in records:
        assert record["policy"] in POLICIES
        assert record["outcome"] in OUTCOMES
        assert 1 <= record["looks"] <= 4
        assert 0 < record["probability"] < 1
    # Two photographs hold all three classes, so that none is absent.
    there = {(record["scene"], record["target"]): record["present"] for record in records}
    assert sorted(there.values()) == [False] * 2 + [True] * 4
    text = (finished / "decisions.md").read_text()
    rows = rows_of(text)
    places, lands = [*POLICIES, "one unfoveated pass", *PLAIN], POLICIES
    compared = ["difference to non-predictive-learned", *POLICIES[1:], *REFERENCES]
    assert [row[0] for row in rows] == [*POLICIES, *REFERENCES, *places, *compared, *lands]
    assert (finished / "roc.png").stat().st_size > 1000
    assert "6 searches" in text
    assert "4 of them for a present class" in text
    for row in rows[:4]:
        group = [record for record in records if record["policy"] == row[0]]
        score = torch.tensor([record["probability"] for record in group])
        there = torch.tensor([record["present"] for record in group])
        assert row[1].startswith(f"{area_under_roc(score, there):.3f} ± ")


def test_without_references_the_agent_searches_as_with_them(finished, tmp_path):
    """Its looks are then made one by one, when a search needs them; without plain rules none is at a quarter."""
    model = ("--belief.model", "HERE/observation.safetensors")
    out = small_run("eval.decide", tmp_path, *model, "--references", "false", "--rules", "false", "--store", "false")
    nothing = {"tiled": None, "plain": None}
    agent = [record | nothing for record in records_in(finished) if record["policy"] == "non-predictive-learned"]
    assert records_in(out) == agent
    rows = rows_of((out / "decisions.md").read_text())
    assert [row[0] for row in rows[:3]] == ["non-predictive-learned", SCORES[0], "class frequency"]


def test_plain_rules_are_regressions_in_folds_of_scenes():
    """Present targets have higher scores; places are right where the closer look is sure."""
    torch.manual_seed(0)
    records = []
    for scene in range(60):
        for present in (True, False):
            sharp = float(torch.rand(()) * 0.5 + 0.4 * present)
            looks = [
                {"facts": [float(torch.randn(())), 2.0 * right - 1, 0.0, 0.0, 0.0], "right": right}
                for right in (present, False)
            ]
            records.append(record("a", present, "found", 0.5, 1, sharp=sharp, tiled=sharp, plain=looks, scene=scene))
    rules = plain_rules(records)
    there = torch.tensor([each["present"] for each in records])
    sharp = torch.tensor([each["sharp"] for each in records])
    presence, _, _, passes = rules["one unfoveated pass"]
    # In each fold the probability rises with the score, and it is the mean share of present targets.
    for fold in range(5):
        mine = torch.tensor([each["scene"] % 5 == fold for each in records])
        order = sharp[mine].argsort()
        assert bool((presence[mine][order].diff() >= 0).all())
    assert float(presence.mean()) == pytest.approx(0.5, abs=0.05)
    assert passes.tolist() == [1.0] * 120
    presence, place, right, passes = rules["one unfoveated pass, two closer looks"]
    assert passes.tolist() == [3.0] * 120
    assert right.tolist() == there.tolist()
    assert float(place[there].min()) > float(place[~there].max())
    assert rules["one unfoveated pass, four quarters"][3].tolist() == [5.0] * 120


def record(policy, present, outcome, probability, looks, **more):
    base = {"right_place": None, "overlap": None, "landing": None, "landing_seen": None, "sharp_place": None}
    base |= {"plain": None, "place": None, "closer": 0, "scene": 1, "frequency": 1 - probability}
    base |= {"sharp": probability / 2, "tiled": probability / 4}
    return {"policy": policy, "present": present, "outcome": outcome, "probability": probability, "looks": looks} | (
        base | more
    )


def test_table_matches_hand_calculations(monkeypatch):
    """Four searches for a present target, two for an absent one; the second policy decides nothing."""
    monkeypatch.setitem(errors_by_chance.__kwdefaults__, "samples", 1000)  # whose mean is compared
    landed = {"landing_seen": True}
    first = [
        record("a", True, "found", 0.9, 3, right_place=True, place=0.9, overlap=0.75, landing=[0.2, 0.8], **landed),
        record("a", True, "found", 0.8, 5, right_place=False, place=0.7, overlap=0.25, landing=[0.4, 0.9], **landed),
        record("a", True, "absent", 0.3, 4, landing=[0.3, 0.1], landing_seen=False),
        record("a", True, "undecided", 0.6, 8),
        record("a", False, "found", 0.85, 2, right_place=False, place=0.8),
        record("a", False, "absent", 0.1, 3),
    ]
    # `a` finds two of four targets. A sharp look does so from a score of 0.4 on, which the absent 0.425 exceeds.
    fits = {
        0: {"right": True, "overlap": 0.5},
        1: {"right": False, "overlap": 0.1},
        4: {"right": False, "overlap": None},
    }
    first = [{**each, "sharp_place": fits.get(number)} for number, each in enumerate(first)]
    second = [record("b", each["present"], "undecided", 0.5, 9) for each in first]
    text = decision_summary([*first, *second], "sensed")
    assert "Closer looks" not in text
    assert "6 searches (sensed), 4 of them for a present class." in text
    area, other, sharp, tiled, frequency, a, b, look, *differences, landed, nowhere = rows_of(text)
    there = torch.tensor([each["present"] for each in first])
    score = torch.tensor([each["probability"] for each in first])
    hits = [f"{100 * hits_at(score, there, share):.0f}" for share in (0.01, 0.02, 0.05)]
    assert hits == ["25", "25", "25"]
    # One scene: all samples are the same.
    hits = [f"{each} ({each} to {each})" for each in hits]
    # 5 of 8 pairs are in order: 0.9 is above both absent targets, the other scores are above only the lower one.
    # Of 15 bins, 0.8 and 0.85 share one, in which half of the targets are there; the others are alone.
    ece = f"{(0.1 + 2 * (0.825 - 0.5) + 0.7 + 0.4 + 0.1) / 6:.3f}"
    assert area[:-1] == ["a", "0.625 ± 0.000", *hits, ece]
    # All in one bin: 0.5 for a share of 4 in 6. By chance N of 6 come true with the odds of six coins, |N - 3| / 6.
    assert other[:-1] == ["b", "0.500 ± 0.000", *["0 (0 to 0)"] * 3, "0.167"]
    mean, limit = other[-1].split(", to ")
    assert float(mean) == pytest.approx((2 * 3 + 12 * 2 + 30 * 1) / 64 / 6, abs=0.01)
    assert limit == f"{2 / 6:.3f}"
    assert sharp == [SCORES[0], "0.625 ± 0.000", *hits, "-", "-"]
    assert tiled == [SCORES[1], "0.625 ± 0.000", *hits, "-", "-"]
    assert frequency[:2] == ["class frequency", "0.375 ± 0.000"]
    place = "33.3 (33.3 to 33.3)"
    assert a == ["a", "50.0", "50.0", "16.7", "5.0", "2.5", place, "80.0", "0.50"]
    assert b == ["b", "0.0", "0.0", "100.0", "9.0", "9.0", "-", "-", "-"]
    assert look == ["one unfoveated pass", "50.0", "50.0", "-", "1.0", "1.0", place, "-", "0.30"]
    assert [row[0] for row in differences] == ["difference to a", "b", *SCORES, "class frequency"]
    assert differences[1][1:] == ["-0.125 ± 0.000", *["-25 (-25 to -25)"] * 3, "-"]
    assert differences[2][1:] == ["+0.000 ± 0.000", *["+0 (+0 to +0)"] * 3, "+0.0 (+0.0 to +0.0)"]
    assert landed == ["a", "3", "0.300 → 0.600", "2", "0.300 → 0.850", "1", "0.300 → 0.100"]
    assert nowhere == ["b", "0", "-", "0", "-", "0", "-"]


def test_the_table_counts_closer_looks_and_shows_nothing_as_a_dash():
    agent = [
        record("non-predictive-learned", present, "found", 0.9, 4, right_place=present, closer=2 - present)
        for present in (1, 0)
    ]
    alone = [{**each, "policy": "non-predictive-learned, no closer looks", "looks": 2, "closer": 0} for each in agent]
    text = decision_summary([*agent, *alone], "sensed")
    assert "Closer looks count as looks; non-predictive-learned makes 1.50 of them in a search." in text
    assert (share(1, 8), share(0, 3), share(0, 0)) == ("12.5", "0.0", "-")
    assert (mean_or_dash([1, 2]), mean_or_dash([0.125], 2), mean_or_dash([])) == ("1.5", "0.12", "-")
