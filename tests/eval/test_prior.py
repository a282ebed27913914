"""The table of probabilities of one class over many photographs."""

import math

import pytest
import torch
from scipy.optimize import minimize

from eval.prior import PAIR, EnlargedScenes, _best_brier, prior_summary
from semfov.data import EmbeddedScenes

pytestmark = pytest.mark.usefixtures("few_samples")


def record(scene, question, present, of_fit, half, given=None):
    def searched(probability, passes):
        outcome = "found" if probability > 0.7 else "absent" if probability < 0.55 else "undecided"
        return {"probability": probability, "passes": passes, "outcome": outcome}

    return {
        "scene": scene,
        "question": question,
        "present": present,
        "fit": searched(of_fit, 2),
        "half": searched(half, 3),
        **({} if given is None else {"share": searched(given, 1)}),
    }


def table_rows(text):
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[1:]]


def test_the_table_has_means_errors_and_decisions_of_each_question_and_prior():
    records = [
        record(1, "always cup", True, 0.9, 0.8, 0.6),
        record(1, "always cup", False, 0.5, 0.4, 0.2),
        record(2, PAIR, True, 0.8, 0.6),
        record(2, PAIR, False, 0.4, 0.4),
    ]
    rows = table_rows(prior_summary(records))
    names = [row[:4] for row in rows]
    assert names[:5] == [
        ["always cup", "fit", "2", "0.500"],
        ["always cup", "0.5", "2", "0.500"],
        ["always cup", "share", "2", "0.500"],
        [PAIR, "fit", "2", "0.500"],
        [PAIR, "0.5", "2", "0.500"],
    ]
    missing = names[5:]
    assert {tuple(name[2:]) for name in missing} == {("1", "0.000")}
    assert [name[1] for name in missing] == ["fit", "0.5", "share", "fit", "0.5"]
    # Each probability is alone in its bin, so that the calibration error is the mean of the errors.
    errors = [(0.1, 0.5), (0.2, 0.4), (0.4, 0.2), (0.2, 0.4), (0.4, 0.4)]
    usual = [errors[0]] * 3 + [errors[3]] * 2
    for row, wrong, before in zip(rows[:5], errors, usual, strict=True):
        brier = (wrong[0] ** 2 + wrong[1] ** 2) / 2
        assert float(row[4]) == pytest.approx((1 - wrong[0] + wrong[1]) / 2, abs=1e-3)
        assert float(row[5].split(" ± ")[0]) == pytest.approx(brier, abs=1e-3)
        assert float(row[8]) == pytest.approx(sum(wrong) / 2, abs=1e-3)
        assert float(row[9]) == 1.0
        if row[1] == "fit":
            assert row[6] == ""
        else:
            change = brier - (before[0] ** 2 + before[1] ** 2) / 2
            assert float(row[6].split(" ± ")[0]) == pytest.approx(change, abs=1e-3)
    assert [row[10:] for row in rows[:5]] == [
        ["100.0", "0.0", "0.0", "100.0", "0.0", "0.0", "100.0", "2.0"],
        ["100.0", "0.0", "0.0", "100.0", "0.0", "0.0", "100.0", "3.0"],
        ["50.0", "0.0", "50.0", "0.0", "0.0", "0.0", "100.0", "1.0"],
        ["100.0", "0.0", "0.0", "100.0", "0.0", "0.0", "100.0", "2.0"],
        ["50.0", "0.0", "50.0", "0.0", "0.0", "0.0", "100.0", "3.0"],
    ]
    assert rows[5][7] == rows[5][9] == "-"  # nothing is there to be ranked


def test_the_best_brier_score_is_that_of_a_logistic_regression_of_the_log_odds():
    generator = torch.Generator().manual_seed(0)
    probability = torch.rand(60, generator=generator, dtype=torch.float64) * 0.98 + 0.01
    there = torch.rand(60, generator=generator) < probability.square()
    odds = probability.logit().numpy()
    sign = torch.where(there, 1.0, -1.0).numpy()

    def surprise(weights):
        return sum(math.log1p(math.exp(-s * (weights[0] + weights[1] * o))) for s, o in zip(sign, odds, strict=True))

    offset, slope = minimize(surprise, [0.0, 1.0]).x
    fitted = (offset + slope * probability.logit()).sigmoid()
    expected = float((fitted - there.double()).square().mean())
    # Half a case for and against without facts is added, so that the fit is always finite.
    assert _best_brier(probability, there) == pytest.approx(expected, abs=2e-3)


def test_enlarged_photographs_show_the_same_objects():
    scenes = EmbeddedScenes(("person", "cat"), count=2)
    enlarged = EnlargedScenes(scenes, 3)
    before = scenes[1]
    scene = enlarged[1]
    width, height = before.size
    assert scene.size == enlarged.annotation(1).size == (3 * width, 3 * height)
    assert torch.equal(scene.boxes, before.boxes * 3)
    assert torch.equal(enlarged.annotation(1).boxes, scene.boxes)
    assert torch.equal(scene.labels, before.labels)
    # The middle of each block of 3 x 3 pixels is the pixel itself.
    assert torch.allclose(scene.image[:, 1::3, 1::3], before.image, atol=1e-5)
    assert enlarged.digest(1) not in {scenes.digest(1), enlarged.digest(0)}
    assert enlarged.fingerprint != scenes.fingerprint
    assert (enlarged.ids, enlarged.classes) == (scenes.ids, scenes.classes)
