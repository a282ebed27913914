"""Figures of episodes and of their calibration against simulation, counts by hand, sklearn and closed forms."""

import json
import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu

from eval.calibration.sums import AddedSums
from eval.chance import errors_by_chance, random_search
from eval.presence import _threshold_for, hits_at
from semfov import Grid
from semfov.data import Annotation
from semfov.errors import InputError
from semfov.metrics.calibration import calibration, calibration_error, reliability
from semfov.metrics.episodes import answers_of, area_under_roc, cumulative_performance, right_cells, standard_error
from tests.refusals import refused


def test_standard_error():
    values = np.array([[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]])
    np.testing.assert_allclose(standard_error(values), [2 / np.sqrt(3), 0])
    assert np.isnan(standard_error(values[:1])).all()
    assert standard_error(values.T[:1]).shape == (3,)
    # For a and b the standard deviation is |a - b| / √2, and the standard error of their mean |a - b| / 2.
    np.testing.assert_allclose(standard_error(np.array([[1.0, 2.0], [4.0, 2.0]])), [1.5, 0])


def test_curves_by_hand_and_random_search_equals_simulation():
    found = np.array([[1, -1, 2], [0, 0, 5]])
    curves = cumulative_performance(found, 3)
    np.testing.assert_allclose(curves, [[0, 1 / 3, 2 / 3, 2 / 3], [2 / 3] * 4])
    # By default there are 100 cells, and the search starts in one of them.
    np.testing.assert_allclose(random_search(1, 2), [0, 1 / 99, 2 / 99])
    np.testing.assert_allclose(random_search(0, 4, cells=5), 0)
    generator = np.random.default_rng(0)
    hits = np.array([min(np.flatnonzero(np.isin(generator.permutation(19), range(3)))) + 1 for _ in range(20_000)])
    simulated = [(hits <= n).mean() for n in range(20)]
    np.testing.assert_allclose(random_search(3, 19, cells=20), simulated, atol=0.015)
    assert random_search(3, 25, cells=20)[-1] == 1


def test_a_cell_is_right_if_an_object_of_its_single_most_probable_class_overlaps_it():
    # Section IV-A: the "highest categorical score" must fit an overlapping object, and background has a score, too.
    answers = torch.tensor([[False, True, False]] * 4)
    beta = torch.tensor([[[0.2, 0.7, 0.1], [0.6, 0.3, 0.1], [0.1, 0.3, 0.6], [0.4, 0.35, 0.25]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [1]
    # Without the background column, classes slightly less probable than background are right, too.
    assert right_cells(beta[..., 1:], answers[:, 1:]).sum(-1).tolist() == [3]
    answers = torch.tensor([[False, True], [False, True], [True, True]])
    beta = torch.tensor([[[0.5, 0.5], [0.5, 0.6], [0.6, 0.5]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [2]


def test_answers_are_the_classes_of_overlapping_objects():
    annotation = Annotation(
        torch.tensor([[1.0, 1, 19, 19], [15, 5, 45, 15], [62, 42, 78, 58]]),
        torch.tensor([1, 2, 3]),
        torch.zeros(3, dtype=torch.bool),
        (80, 60),
    )
    answers = answers_of(annotation, Grid(4, 3, (80, 60)), 4)
    found = {cell: set(row.nonzero()[:, 0].tolist()) for cell, row in enumerate(answers) if row.any()}
    assert found == {0: {1, 2}, 1: {2}, 2: {2}, 11: {3}}
    # Also if the picture shows none of the last classes.
    annotation = Annotation(
        torch.tensor([[1.0, 1, 5, 5]]), torch.tensor([1]), torch.zeros(1, dtype=torch.bool), (20, 10)
    )
    answers = answers_of(annotation, Grid(2, 1, (20, 10)), 5)
    assert answers.tolist() == [[False, True, False, False, False], [False] * 5]


# Few values, so that many are tied.
scores = st.lists(st.sampled_from([0.0, 0.1, 0.25, 0.5, 0.9, 1.0]) | st.floats(0, 1), min_size=1, max_size=25)
shares = st.sampled_from([0.0, 0.01, 0.05, 0.25, 0.5, 0.9]) | st.floats(0, 0.99)


def cases(hits, misses, seed=0):
    """Scores of present and absent targets in random order, and which are present."""
    order = torch.randperm(len(hits) + len(misses), generator=torch.Generator().manual_seed(seed))
    values = torch.tensor([*hits, *misses], dtype=torch.float64)
    return values[order], (torch.arange(len(values)) < len(hits))[order]


@given(scores, scores, st.integers(0, 100))
def test_area_equals_the_mann_whitney_statistic(hits, misses, seed):
    statistic = mannwhitneyu(hits, misses, method="asymptotic").statistic if len({*hits, *misses}) > 1 else None
    expected = 0.5 if statistic is None else statistic / (len(hits) * len(misses))
    assert area_under_roc(*cases(hits, misses, seed)) == pytest.approx(expected, abs=1e-12)


@given(scores, shares)
def test_threshold_is_the_smallest_that_keeps_the_allowed_false_alarms(misses, share):
    values = torch.tensor(misses, dtype=torch.float64)
    got = _threshold_for(values, share)

    def alarms(threshold):
        return sum(value >= threshold for value in misses)

    assert alarms(got) / len(misses) <= share
    # The next smaller number gives too many false alarms.
    assert alarms(math.nextafter(got, -math.inf)) / len(misses) > share


def test_the_allowed_false_alarms_are_those_of_exact_fractions():
    """As many as the decimal share of all cases, also where the product of floats is below a whole number."""
    assert 0.29 * 100 < 29
    for count in range(1, 130):
        misses = torch.arange(count, dtype=torch.float64)
        for percent in (0, 1, 2, 5, 7, 29, 57, 58, 99):
            allowed = Fraction(percent, 100) * count // 1
            assert int((misses >= _threshold_for(misses, percent / 100)).sum()) == allowed
        for alarms in range(count):
            assert int((misses >= _threshold_for(misses, alarms / count)).sum()) == alarms


@given(scores, scores, shares)
def test_hits_equal_trying_every_threshold(hits, misses, share):
    candidates = [*hits, *misses, 2.0]
    passing = [t for t in candidates if sum(m >= t for m in misses) / len(misses) <= share]
    expected = max(sum(h >= t for h in hits) for t in passing) / len(hits)
    assert hits_at(*cases(hits, misses), share) == pytest.approx(expected, abs=1e-12)


def test_hits_lie_above_the_false_alarms():
    # The threshold is the next double above the absent case, so an equal score does not reach it.
    score = torch.tensor([0.3, 0.3, 0.30000004])
    assert hits_at(score, torch.tensor([True, False, True]), 0.0) == 0.5
    score = torch.tensor([0.3, math.nextafter(0.3, 1)], dtype=torch.float64)
    assert hits_at(score, torch.tensor([False, True]), 0.0) == 1
    score = torch.tensor([0.5, 0.7, 0.1], dtype=torch.float64)
    assert _threshold_for(score, 1.0) == -math.inf
    assert hits_at(score, torch.tensor([False, True, True]), 1.0) == 1
    for present in [[True, True], [False, False], []]:
        with pytest.raises(InputError, match="present: expected both true and false values"):
            area_under_roc(torch.zeros(len(present)), torch.tensor(present, dtype=torch.bool))
    refused("absent: expected at least one case", _threshold_for, torch.zeros(0), 0.1)


def ece_by_loop(confidence, correct, bins):
    total = 0.0
    for b in range(bins):
        inside = [i for i, c in enumerate(confidence) if (b / bins < c <= (b + 1) / bins) or (b == 0 and c == 0)]
        if inside:
            conf = sum(confidence[i] for i in inside) / len(inside)
            acc = sum(correct[i] for i in inside) / len(inside)
            total += len(inside) / len(confidence) * abs(acc - conf)
    return total


def test_metrics_equal_loops(dtype):
    torch.manual_seed(0)
    p = (3 * torch.randn(500, 4, dtype=dtype)).softmax(1)
    labels = torch.randint(0, 4, (500,))
    got = calibration(p, labels, bins=10)
    assert got.nll == pytest.approx(float(torch.nn.functional.nll_loss(p.log(), labels)), rel=1e-5)
    one_hot = torch.nn.functional.one_hot(labels, 4)
    assert got.brier == pytest.approx(float((p - one_hot).square().sum(1).mean()), rel=1e-5)
    assert got.accuracy == pytest.approx(float((p.argmax(1) == labels).double().mean()))
    top = p.double().max(1)
    assert got.ece == pytest.approx(ece_by_loop(top.values.tolist(), (top.indices == labels).tolist(), 10), rel=1e-6)
    by_class = [ece_by_loop(p.double()[:, k].tolist(), (labels == k).tolist(), 10) for k in range(4)]
    assert got.classwise_ece == pytest.approx(sum(by_class) / 4, rel=1e-6)
    assert got.count == 500


def test_sums_equal_loops(dtype, device):
    """Metrics of rare events in numpy, prediction by prediction."""
    generator = np.random.default_rng(0)
    p = generator.beta(0.2, 2, 3000).astype(np.float32)
    y = generator.random(3000) < p**1.3
    sums = AddedSums.of(torch.tensor(p, dtype=dtype, device=device), torch.tensor(y, device=device))
    q = p.astype(np.float64)
    nll = [-math.log(max(b if so else 1 - b, np.finfo(np.float32).tiny)) for b, so in zip(q, y, strict=True)]
    assert sums.count == 3000
    assert sums.nll == pytest.approx(np.mean(nll))
    assert sums.brier == pytest.approx(np.mean((q - y) ** 2))
    assert sums.ece == pytest.approx(ece_by_loop(q.tolist(), y.tolist(), 15))
    assert sums.ece == pytest.approx(float(calibration_error(torch.tensor(p), torch.tensor(y))))
    assert (sums.probability, sums.rate) == pytest.approx((q.mean(), y.mean()))
    # As predictions of two classes: the second class adds as much to the Brier score as the first.
    both = calibration(torch.tensor(np.stack([1 - q, q], 1)), torch.tensor(y).long())
    assert (sums.nll, 2 * sums.brier) == pytest.approx((both.nll, both.brier))
    for number, (low, high) in enumerate(zip([-1, *sums.EDGES.tolist()], [*sums.EDGES.tolist(), 1], strict=True)):
        inside = (q > low) & (q <= high)
        assert sums.bins[:, number].tolist() == pytest.approx([inside.sum(), q[inside].sum(), y[inside].sum()])


predictions = st.lists(st.tuples(st.floats(0, 1, width=32), st.booleans()), max_size=30)


def sums_of(pairs):
    p, y = torch.tensor([p for p, _ in pairs]), torch.tensor([y for _, y in pairs], dtype=torch.bool)
    return AddedSums.of(p, y)


def assert_equal_sums(a, b):
    assert a.bins[0].tolist() == b.bins[0].tolist()
    torch.testing.assert_close(a.bins, b.bins)
    assert (a.surprisal, a.square) == pytest.approx((b.surprisal, b.square))


@given(predictions, predictions, predictions)
def test_sums_of_parts_add_up(a, b, c):
    whole = sums_of(a + b + c)
    assert_equal_sums((sums_of(a) + sums_of(b)) + sums_of(c), whole)
    assert_equal_sums(sums_of(c) + (sums_of(b) + sums_of(a)), whole)
    assert_equal_sums(whole + AddedSums.nothing(), whole)


@given(predictions)
def test_sums_are_exact_after_json(pairs):
    sums = sums_of(pairs)
    back = AddedSums.from_record(json.loads(json.dumps(sums.record())))
    assert torch.equal(back.bins, sums.bins)
    assert (back.surprisal, back.square) == (sums.surprisal, sums.square)


def test_sums_of_few_and_of_certain_but_wrong_predictions():
    nothing = AddedSums.nothing()
    assert nothing.count == 0
    for name in ("nll", "brier", "ece", "probability", "rate"):
        assert math.isnan(getattr(nothing, name))
    sums = AddedSums.of(torch.tensor([1.0, 0.0]), torch.tensor([False, True]))
    assert math.isfinite(sums.nll)
    assert (sums.brier, sums.ece) == (1, 1)
    refused("outcome", AddedSums.of, torch.rand(3), torch.ones(2).bool())


def test_calibration_with_settings_at_their_limits_of_few_and_of_certain_but_wrong_predictions():
    p, labels = torch.tensor([[0.9, 0.1], [0.4, 0.6], [0.7, 0.3]]), torch.tensor([0, 0, 1])
    # All in one bin: the mean confidence against the share that is right.
    assert calibration(p, labels, bins=1).ece == pytest.approx(abs((0.9 + 0.6 + 0.7) / 3 - 1 / 3))
    many = torch.rand(300, 2, generator=torch.Generator().manual_seed(0)).softmax(1)
    truth = (torch.arange(300) % 3 == 0).long()
    assert calibration(many, truth) == calibration(many, truth, bins=15) != calibration(many, truth, bins=16)
    refused("bins: expected a whole number from 1 to 1,000,000, got 0", calibration, p, labels, bins=0)
    refused("probabilities: expected a tensor of shape", calibration, torch.rand(3), labels)
    assert calibration(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)).count == 0
    assert math.isfinite(calibration(torch.tensor([[1.0, 0.0]]), torch.tensor([1])).nll)
    assert math.isnan(calibration(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)).ece)
    refused("labels", calibration, torch.ones(3, 2) / 2, torch.zeros(2, dtype=torch.long))
    assert float(calibration_error(torch.tensor([0.8]), torch.tensor([False]))) == pytest.approx(0.8)
    assert float(calibration_error(torch.zeros(0), torch.zeros(0, dtype=torch.bool))) == 0


def test_bins_are_open_below_and_closed_above_at_any_edges():
    count, confident, right = reliability(torch.tensor([0.0, 0.5, 0.51, 1.0]), torch.tensor([0, 1, 0, 1]).bool(), 2)
    assert count.tolist() == [2, 2]
    assert confident.tolist() == pytest.approx([0.5, 1.51])
    assert right.tolist() == [1, 1]
    p, right = torch.tensor([0.0, 0.1, 0.2, 0.3, 0.9]), torch.tensor([1, 0, 1, 1, 1]).bool()
    bins = reliability(p, right, torch.tensor([0.1, 0.5]))
    torch.testing.assert_close(bins, torch.tensor([[2.0, 2, 1], [0.1, 0.5, 0.9], [1, 2, 1]], dtype=torch.float64))
    edges = torch.arange(1, 15, dtype=torch.float64) / 15
    for p in (edges, torch.nextafter(edges, torch.zeros_like(edges))):
        assert reliability(p, p > 0.5)[0].tolist() == [1] * 14 + [0]
    assert reliability(torch.nextafter(edges, torch.ones_like(edges)), edges > 0.5)[0].tolist() == [0] + [1] * 14


def test_errors_by_chance_are_those_of_every_possible_outcome():
    """The mean over all outcomes of four predictions, each weighted by its probability."""
    p = torch.tensor([0.1, 0.35, 0.38, 0.9], dtype=torch.float64)
    expected = 0.0
    for number in range(16):
        outcome = torch.tensor([bool(number >> bit & 1) for bit in range(4)])
        weight = float(torch.where(outcome, p, 1 - p).prod())
        expected += weight * ece_by_loop(p.tolist(), outcome.tolist(), 5)
    drawn = errors_by_chance(p, 5, samples=5_000)
    assert float(drawn.mean()) == pytest.approx(expected, abs=3 * float(drawn.std()) / 5_000**0.5)
    assert torch.equal(drawn[:9], errors_by_chance(p, 5, samples=5_000)[:9])
    assert len(errors_by_chance(p, samples=7, seed=1)) == 7
