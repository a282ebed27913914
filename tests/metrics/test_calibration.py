"""Calibration figures against loops, known cases and torch's own losses."""

import math

import pytest
import torch

from semfov.errors import InputError
from semfov.metrics.calibration import calibration, calibration_error, reliability


def ece_by_loop(confidence, correct, bins):
    total = 0.0
    for b in range(bins):
        inside = [i for i, c in enumerate(confidence) if (b / bins < c <= (b + 1) / bins) or (b == 0 and c == 0)]
        if inside:
            conf = sum(confidence[i] for i in inside) / len(inside)
            acc = sum(correct[i] for i in inside) / len(inside)
            total += len(inside) / len(confidence) * abs(acc - conf)
    return total


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_figures_equal_loops(dtype):
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


def test_calibrated_predictions_have_a_small_error():
    torch.manual_seed(1)
    confidence = torch.rand(100_000)
    correct = torch.rand(100_000) < confidence
    assert calibration_error(confidence, correct) < 0.01
    assert calibration_error(confidence, torch.ones(100_000, dtype=torch.bool)) == pytest.approx(0.5, abs=0.01)


def test_bins_are_open_below_and_closed_above():
    count, confident, right = reliability(torch.tensor([0.0, 0.5, 0.51, 1.0]), torch.tensor([0, 1, 0, 1]).bool(), 2)
    assert count.tolist() == [2, 2]
    assert confident.tolist() == pytest.approx([0.5, 1.51])
    assert right.tolist() == [1, 1]


def test_certain_and_wrong_is_finite():
    assert math.isfinite(calibration(torch.tensor([[1.0, 0.0]]), torch.tensor([1])).nll)


def test_nothing_to_judge():
    assert math.isnan(calibration(torch.zeros(0, 3), torch.zeros(0, dtype=torch.long)).ece)


def test_shapes_must_fit():
    with pytest.raises(InputError, match="labels"):
        calibration(torch.ones(3, 2) / 2, torch.zeros(2, dtype=torch.long))
