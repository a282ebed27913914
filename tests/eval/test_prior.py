"""The table of probabilities of one class over many photographs."""

import pytest

from eval.prior import PAIR, prior_summary


def record(question, present, without, given=None):
    return {
        "question": question,
        "present": present,
        "without": {"probability": without, "passes": 2},
        "with": None if given is None else {"probability": given, "passes": 1},
    }


def cells(line):
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_table_has_means_and_errors_of_each_question():
    records = [
        record("always cup", True, 0.9, 0.6),
        record("always cup", False, 0.5, 0.2),
        record(PAIR, True, 0.8),
        record(PAIR, False, 0.4),
    ]
    lines = [cells(line) for line in prior_summary(records).splitlines() if line.startswith("| ")]
    always, pair = lines[1], lines[2]
    assert always[:3] == ["always cup", "2", "0.500"]
    # Each probability is alone in its bin, so that the calibration error is the mean of the errors.
    errors = {"without": (0.1, 0.5), "with": (0.4, 0.2)}
    for values, (mean, number) in zip((always[3:7], always[7:11]), ((0.7, 2), (0.4, 1)), strict=True):
        first, second = errors["without" if number == 2 else "with"]
        expected = [mean, (first**2 + second**2) / 2, (first + second) / 2, number]
        assert [float(value) for value in values] == pytest.approx(expected, abs=1e-3)
    assert pair[0] == PAIR
    assert pair[7:] == ["-"] * 4
