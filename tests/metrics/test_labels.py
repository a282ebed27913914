"""Outcomes and labels in every common type give the figures of booleans and of plain values; NaN is refused."""

import numpy as np
import pytest
import torch
from sklearn.metrics import roc_auc_score, roc_curve

from eval.bootstrap import Bootstrap
from eval.chance import errors_by_chance
from eval.presence import hits_at, roc
from semfov.metrics.calibration import BinarySums, calibration, calibration_error, reliability
from semfov.metrics.episodes import area_under_roc, cumulative_performance, right_cells, standard_error
from semfov.metrics.scanpath import (
    auc,
    cell_labels,
    cluster_labels,
    edit_distance,
    information_gain,
    length_distance,
    log_density,
    mean_performance,
    merge_close,
    nss,
    sequence_score,
    tfp_auc,
)
from tests.refusals import refused

SCORE = [0.9, 0.8, 0.35, 0.2, 0.1]
PRESENT = [0, 1, 0, 1, 1]
TYPES = {
    **{str(dtype): lambda values, dtype=dtype: torch.tensor(values).to(dtype) for dtype in (
        torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.float16, torch.bfloat16,
        torch.float32, torch.float64,
    )},
    **{str(np.dtype(dtype)): lambda values, dtype=dtype: np.array(values).astype(dtype) for dtype in (
        bool, np.uint8, np.uint16, np.int32, np.int64, np.float32, np.float64,
    )},
    "list": list, "tuple": tuple, "list of booleans": lambda values: [bool(each) for each in values],
    "list of tensors": lambda values: [torch.tensor(each) for each in values],
    "list of NumPy's numbers": lambda values: [np.int64(each) for each in values],
}  # fmt: skip


@pytest.mark.parametrize("kind", TYPES)
def test_outcomes_of_any_type(kind):
    present, score = TYPES[kind](PRESENT), torch.tensor(SCORE)
    expected = roc_auc_score(PRESENT, SCORE)
    assert area_under_roc(score, present) == area_under_roc(SCORE, present) == pytest.approx(expected)
    assert area_under_roc(np.array(SCORE), present) == pytest.approx(expected)
    alarms, hits, _ = roc_curve(PRESENT, SCORE, drop_intermediate=False)
    got = roc(score, present)
    np.testing.assert_allclose(got, [alarms, hits])
    assert hits_at(score, present, 0.5) == pytest.approx(1 / 3)
    sums = BinarySums.of(SCORE, present)
    np.testing.assert_allclose(sums.brier, np.square(np.array(SCORE) - PRESENT).mean())
    np.testing.assert_allclose(sums.nll, -np.log(np.where(PRESENT, SCORE, 1 - np.array(SCORE))).mean())
    assert torch.equal(reliability(score, present, 2), reliability(score, torch.tensor(PRESENT).bool(), 2))
    assert calibration_error(score, present) == calibration_error(score, torch.tensor(PRESENT).bool())
    figures = calibration([[0.9, 0.1], [0.2, 0.8], [0.3, 0.7]], TYPES[kind]([0, 1, 0]))
    assert (figures.accuracy, figures.brier) == pytest.approx((2 / 3, (0.02 + 0.08 + 0.98) / 3))
    beta = torch.tensor([[[0.5, 0.7], [0.9, 0.1], [0.2, 0.5]]])
    if "list" not in kind and kind != "tuple":
        assert right_cells(beta, TYPES[kind]([[0, 1]] * 3)).sum(-1).tolist() == [2]


@pytest.mark.parametrize("kind", TYPES)
def test_labels_of_any_type(kind):
    """Two tensors are equal where their elements are, and so are groups."""
    word, other = TYPES[kind]([1, 0, 1, 1]), TYPES[kind]([1, 1, 1])
    assert (sequence_score(word, word), edit_distance(word, word)) == (1.0, 0)
    assert (sequence_score(word, other), edit_distance(word, other)) == (0.75, 1)
    groups = TYPES[kind]([0, 0, 1])
    np.testing.assert_array_equal(mean_performance([1, -1, 0], groups, 1), [0.5, 0.75])
    assert tfp_auc(np.array([1, -1, 0]), groups, 1) == 1.25
    cases = torch.tensor([1.0, 1.0, 4.0])
    drawn = Bootstrap.of(lambda index: cases[index].sum(), groups, samples=50)
    assert set(drawn.samples.tolist()) == {4.0, 6.0, 8.0}  # of both groups, or of one of them twice


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: area_under_roc(SCORE, [0, 1, 2, 1, 0]), "present: expected true and false, or 1 and 0, got 2"),
        (lambda: area_under_roc(SCORE, [-1, 1, 1, 1, -1]), "present: expected true and false"),
        (lambda: area_under_roc(SCORE, [0.0, 1.0, float("nan"), 1, 0]), "present: expected true and false"),
        (lambda: area_under_roc(SCORE, ["yes"] * 5), "present: expected numbers, got list"),
        (lambda: area_under_roc(SCORE, [0, 1]), "present: expected one outcome for each score"),
        (lambda: area_under_roc([0.1, float("nan")], [0, 1]), "score: expected numbers, got NaN in 1 of 2"),
        (lambda: hits_at([0.1, float("nan")], [0, 1], 0.5), "score: expected numbers, got NaN"),
        (lambda: roc([0.1, float("nan")], [0, 1]), "score: expected numbers, got NaN"),
        (lambda: hits_at([0.1, 0.2], [0, 1], 5), "share: expected a number from 0 to 1"),
        (lambda: BinarySums.of([4.0, 0.1], [0, 1]), "probability: expected probabilities from 0 to 1, got 0.1 to 4"),
        (lambda: BinarySums.of([float("nan"), 0.1], [0, 1]), "probability: expected numbers, got NaN"),
        (lambda: BinarySums.of([0.4, 0.1], [0, 5]), "outcome: expected true and false"),
        (lambda: calibration([[4.0, -3.0]], [0]), r"probabilities from 0 to 1, got -3 to 4; give logits"),
        (lambda: calibration([[0.9, 0.8]], [0]), "probabilities: expected rows that sum to 1, got sums from 1.7"),
        (lambda: calibration([[0.9, 0.1]], [2]), "labels: expected numbers of classes from 0 to 1, got 2 to 2"),
        (lambda: calibration([[0.9, 0.1]], [-1]), "labels: expected numbers of classes from 0 to 1"),
        (lambda: calibration([[0.9, 0.1]], [0.5]), "labels: expected whole numbers, got 0.5"),
        (lambda: calibration_error([1.5], [1]), "confidence: expected probabilities from 0 to 1"),
        (lambda: calibration_error([0.5, 0.5], [1, 2]), "correct: expected true and false"),
        (lambda: errors_by_chance(torch.tensor([float("nan")])), "confidence: expected numbers, got NaN"),
        (lambda: sequence_score([0.0, float("nan")], [0.0]), "ours: expected labels, got NaN"),
        (lambda: sequence_score(torch.rand(2, 2), [0.0]), r"ours: expected labels in a row, got shape \(2, 2\)"),
        (lambda: edit_distance([[1, 2]], [[1, 2]]), "labels: expected names or numbers, got a list of shape"),
        (lambda: mean_performance([float("nan"), 1], [1, 2], 2), "found: expected numbers, got NaN"),
        (lambda: right_cells(torch.rand(1, 1, 2), torch.tensor([[2, 0]])), "answers: expected true and false"),
    ],
)  # fmt: skip
def test_what_is_neither_is_refused(call, named):
    refused(named, call)


def test_the_roc_is_that_of_every_threshold():
    """Beside scikit-learn on many scores with ties, and on few of any type."""
    draw = np.random.default_rng(0)
    present = draw.random(20_000) < 0.3
    score = np.round(draw.normal(size=20_000) + present, 2)
    alarms, hits, _ = roc_curve(present, score, drop_intermediate=False)
    np.testing.assert_allclose(roc(torch.tensor(score), torch.tensor(present)), [alarms, hits])
    assert roc([1.0, 1.0], [0, 1]) == ([0.0, 1.0], [0.0, 1.0])
    assert roc([float("-inf"), float("inf")], [0, 1])[1] == [0.0, 1.0, 1.0]


def test_measures_of_searches_take_lists_and_tensors():
    for found in ([1, 3, -1, 1], torch.tensor([1, 3, -1, 1]), np.array([1, 3, -1, 1], np.int16)):
        np.testing.assert_array_equal(cumulative_performance(found, 3), [0, 0.5, 0.5, 0.75])
        np.testing.assert_allclose(standard_error(found), np.std([1, 3, -1, 1], ddof=1) / 2)


def test_numbers_of_other_kinds_are_refused_by_name():
    """Complex ones, words, rows of several lengths, and outcomes in another shape; sparse and traced ones are read."""
    square, present = torch.tensor([[0.7, 0.3], [0.2, 0.8]]), torch.tensor(PRESENT)
    assert area_under_roc(SCORE, present.to_sparse()) == area_under_roc(SCORE, PRESENT)
    traced = torch.rand(4, 5).requires_grad_()
    np.testing.assert_array_equal(nss(traced, [1], [2]), nss(traced.detach().numpy(), [1], [2]))
    for call, said in (
        (lambda: area_under_roc(SCORE, present[None]), r"present: expected one outcome for each score \(5,\)"),
        (lambda: area_under_roc(torch.tensor(SCORE) + 1j, present), "score: expected real numbers, got complex"),
        (lambda: calibration(square, torch.eye(2)), "labels: expected 2 numbers, one for each row"),
        (lambda: edit_distance(3, 4), "ours: expected labels in a row, got an int"),
        (lambda: nss(np.ones((2, 2)) + 1j, [0], [0]), "maps: expected real numbers.*complex128"),
        (lambda: auc(np.ones((2, 2)), ["left"], [0]), "x, y: expected real numbers"),
        (lambda: information_gain([[1, 2], [3]], [[1, 2]], [0], [0]), "density: expected real numbers in rows of one"),
        (lambda: log_density([0.5, 0.5]), r"maps: expected an array of shape \(\.\.\., H, W\)"),
        (lambda: cell_labels([[1, 2, 3]], 2, 2, (9, 9)), r"points: expected fixations of shape \(n, 2\)"),
        (lambda: merge_close([[1, np.nan]], (9, 9)), "points: expected finite numbers"),
        (lambda: cluster_labels([], []), "others: expected at least one fixation"),
        (lambda: length_distance([1, np.nan], [1]), "ours: expected finite numbers"),
    ):
        refused(f"^{said}", call)
