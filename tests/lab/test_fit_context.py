"""`python -m train.fit_context`: counts and ratios against loops, weights against a grid search, and the command."""

import json

import pytest
import torch

from semfov import Grid
from semfov.belief import ContextPrior
from train.context.fit import count_pairs, cross_fit, judge_context, occupation, shrunk_ratio
from train.context.settings import FitContextConfig, ObjectPlaces
from train.context.weights import SIZES, Cases, fit_weights, hit, landed, likeliest_weights
from train.fit_context import main

EDGES = (0.0, 0.3)


@pytest.fixture
def places():
    """Pictures of 5 × 4 cells with up to three classes; the third is never searched for."""
    generator = torch.Generator().manual_seed(0)
    grid = Grid(5, 4, (100, 60))
    made = []
    for _ in range(12):
        occupied = torch.rand(20, 4, generator=generator) < 0.2
        occupied[:, 0] = False
        present = occupied.any(0).nonzero()[:, 0].tolist()
        made.append(ObjectPlaces(occupied, [k for k in present if k < 3], grid, 5))
    return made


def test_occupation_equals_a_loop_over_pictures(places):
    got = occupation(places, 3.0)
    pictures = sum(len(place.targets) for place in places)
    for cell in range(20):
        cells = sum(bool(place.occupied[cell, k]) for place in places for k in place.targets)
        average = (cells + 0.5) / (pictures + 1)
        for k in range(4):
            chosen = [place for place in places if k in place.targets]
            there = sum(bool(place.occupied[cell, k]) for place in chosen)
            assert float(got[k, cell]) == pytest.approx((there + 3 * average) / (len(chosen) + 3), rel=1e-5)


def test_pairs_equal_a_loop_over_cells(places):
    chance = occupation(places, 3.0)
    observed, expected = count_pairs(places, chance, EDGES)
    for k in range(4):
        for j in range(4):
            seen, due = [0.0] * 3, [0.0] * 3
            for place in places:
                if k == j or k not in place.targets or not place.occupied[:, j].any():
                    continue
                total = float(place.occupied[:, k].sum())
                for cell in range(20):
                    band = band_of(place, cell, j)
                    seen[band] += float(place.occupied[cell, k])
                    due[band] += total * float(chance[k, cell] / chance[k].sum())
            assert observed[k, j].tolist() == pytest.approx(seen)
            assert expected[k, j].tolist() == pytest.approx(due, abs=1e-4)


def band_of(place, cell, component):
    centres = place.grid.centres
    there = place.occupied[:, component].nonzero()[:, 0]
    nearest = float((centres[there] - centres[cell]).abs().amax(-1).min()) / 100
    return sum(nearest > edge + 1e-6 for edge in EDGES)


def test_ratios_are_shrunk_towards_those_of_all_classes():
    observed, expected = torch.full((3, 3, 1), 2.0), torch.full((3, 3, 1), 1.0)
    raw = shrunk_ratio(observed, expected, 1e-9, 1e-9)
    assert raw[1, 2, 0] == pytest.approx(2)
    assert raw[0].flatten().tolist() == raw[:, 0].flatten().tolist() == raw.diagonal().flatten().tolist() == [1] * 3
    observed[1, 2] = 8
    every = (24 + 1) / (9 + 1)
    k, j = ((12 + 5 * every) / (3 + 5) for _ in range(2))
    expect = (8 + 4 * k * j / every) / (1 + 4)
    assert float(shrunk_ratio(observed, expected, 5.0, 4.0)[1, 2, 0]) == pytest.approx(expect)


def test_likelihood_without_context_is_the_share_of_target_cells(places):
    prior = ContextPrior(["a", "b", "c"], torch.zeros(4, 2, 2), torch.zeros(4, 4, 3), EDGES)
    shares = [place.occupied[:, k].float().mean().log() for place in places for k in place.targets]
    for row in judge_context(prior, places, 4):
        assert row["log_likelihood"] == pytest.approx(float(torch.stack(shares).mean()), abs=1e-5)
        assert row["pairs"] == len(shares)
        assert (row["gain"], row["error"]) == pytest.approx((0, 0), abs=1e-6)


def test_gain_is_the_mean_over_photographs(places):
    place = torch.randn(4, 2, 2, generator=torch.Generator().manual_seed(5))
    prior = ContextPrior(["a", "b", "c"], place, torch.zeros(4, 4, 3), EDGES)
    judged = {row["context"]: row for row in judge_context(prior, places, 4)}
    gains = []
    for each in places:
        values = [prior.place_at(each.grid)[k].softmax(0)[each.occupied[:, k]].sum().log() for k in each.targets]
        shares = [each.occupied[:, k].float().mean().log() for k in each.targets]
        gains += [sum(float(v - s) for v, s in zip(values, shares, strict=True)) / len(values)] if values else []
    row = judged["place"]
    assert row["gain"] == pytest.approx(sum(gains) / len(gains), abs=1e-5)
    assert row["error"] == pytest.approx(torch.tensor(gains).std().item() / len(gains) ** 0.5, abs=1e-5)


def test_a_prior_is_weighted_on_pictures_that_it_did_not_count(places):
    config = FitContextConfig(resolution=4, edges=EDGES, weigh=6, folds=3)
    square = [ObjectPlaces(place.occupied[:16], place.targets, Grid(4, 4, (80, 60)), 5) for place in places]
    folds = cross_fit(square, range(1, 12), ("a", "b", "c"), config)
    assert sum(len(part) for _, part in folds) == 6
    others = [i for i in range(1, 12) if i not in folds[0][1]]
    odds = occupation([square[i] for i in others], config.place_smoothing).logit()
    expected = (odds - odds.mean(-1, keepdim=True)).reshape(4, 4, 4)
    torch.testing.assert_close(folds[0][0].place, expected)


def test_fitted_weights_have_the_highest_likelihood_in_their_neighbourhood():
    generator = torch.Generator().manual_seed(0)
    log_odds, place, cooccurrence = torch.randn(3, 400, 12, generator=generator)
    gumbel = -torch.log(-torch.log(torch.rand(400, 12, generator=generator)))
    best = (2 * log_odds + 1.0 * place + 0.5 * cooccurrence + gumbel).argmax(-1)
    goal = torch.nn.functional.one_hot(best, 12).bool()
    cases = Cases(log_odds, place, cooccurrence, goal, torch.zeros_like(goal))
    weights = likeliest_weights(cases)
    assert weights == pytest.approx((0.5, 0.25), abs=0.12)
    gammas = torch.linspace(1, 3, 81)
    top = max(float(hit(cases, g, g * weights[0], g * weights[1])) for g in gammas)
    for shift in ((0.1, 0), (-0.1, 0), (0, 0.1), (0, -0.1)):
        moved = [w + s for w, s in zip(weights, shift, strict=True)]
        assert max(float(hit(cases, g, g * moved[0], g * moved[1])) for g in gammas) < top


def test_the_size_of_weights_is_the_one_that_hits_the_target_most_often():
    generator = torch.Generator().manual_seed(1)
    log_odds, place, cooccurrence = torch.randn(3, 200, 12, generator=generator).round()
    visited = torch.rand(200, 12, generator=generator) < 0.2
    goal = (torch.rand(200, 12, generator=generator) < 0.2) & ~visited
    goal[:, 0], visited[:, 0] = True, False
    cases = Cases(log_odds, place, cooccurrence, goal, visited)
    rate = 0.0
    for row in range(200):
        free = [cell for cell in range(12) if not visited[row, cell]]
        value = {cell: float(log_odds[row, cell] + 0.5 * place[row, cell]) for cell in free}
        tied = [cell for cell in free if value[cell] == max(value.values())]
        rate += sum(bool(goal[row, cell]) for cell in tied) / len(tied) / 200
    assert landed(cases, 0.5, 0.0) == pytest.approx(rate, abs=1e-5)
    found, most = fit_weights(cases), likeliest_weights(cases)
    rates = [landed(cases, size * most[0], size * most[1]) for size in SIZES]
    assert landed(cases, *found) == max(rates)


def test_command_writes_a_prior_from_annotations(tmp_path):
    call = ["--data.limit", "8", "--holdout", "2", "--min_objects", "1", "--out", str(tmp_path)]
    assert main(call) == 0
    prior = ContextPrior.from_pretrained(tmp_path / "coco.safetensors")
    assert prior.weights == {"evidence": (1.0, 1.0), "map": (1.0, 1.0)}
    assert prior.place.shape == (81, 10, 10)
    rows = json.loads((tmp_path / "judged.json").read_text())
    names = ["nothing", "place", "co-occurrence", "both", "both, of other classes"]
    assert [row["context"] for row in rows] == names
    assert "not fitted on looks" in (tmp_path / "report.md").read_text()
    # The same command accepts a table.
    (tmp_path / "beside.csv").write_text(",dog,cat\nperson,2,1\ndog,,3\n")
    table = ["--table", str(tmp_path / "beside.csv"), "--source", "guesses", "--name", "shared"]
    assert main([*call[:-1], str(tmp_path / "again"), *table]) == 0
    shared = ContextPrior.from_pretrained(tmp_path / "again" / "shared.safetensors")
    assert shared.metadata["table"]["source"] == "guesses"
    assert str(tmp_path) not in json.dumps(shared.metadata)
    assert "From a table" in (tmp_path / "again" / "report.md").read_text()
