"""`python -m train.fit_verification`: small on the embedded scenes, and its parts against loops and SciPy."""

import json

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from semfov import Eye, Foveation
from semfov.belief import TargetEvidence, Verification
from semfov.belief.observers import Target
from semfov.data.scenes import EmbeddedScenes
from semfov.errors import DataError
from semfov.training.closer_looks import photographs, search
from semfov.training.verification_decisions import LEVELS, Verified, choose_confirm, value, verify
from semfov.training.verification_fit import SHIPPED, STRENGTH, Examined, examine, fit, shipped_mean
from semfov.training.verification_settings import FitVerificationConfig
from tests.small import CLASSES, Blobs
from train.fit_verification import main


def examined(count=200, seed=0):
    """Closer looks whose outcome depends on two of the features."""
    generator = torch.Generator().manual_seed(seed)
    features = 2 * torch.randn(count, 7, generator=generator)
    noise = torch.randn(2, count, generator=generator)
    return Examined(features, features[:, 3] + noise[0] > 0.5, features[:, 0] + noise[1] > -1, torch.arange(count) % 4)


def test_the_fit_minimises_the_penalised_cross_entropy():
    known = examined()
    chosen = known.fold != 1
    model = fit(known, chosen)
    phi = known.features[chosen].double().numpy()
    mean, scale = phi.mean(0), phi.std(0, ddof=1)
    for row, goal in enumerate((known.right, known.present)):
        there = goal[chosen].numpy()

        def loss(parameters, there=there):
            odds = (phi - mean) / scale @ parameters[:7] + parameters[7]
            return np.logaddexp(0, np.where(there, -odds, odds)).mean() + 1e-4 * (parameters[:7] ** 2).sum()

        best = minimize(loss, np.zeros(8), tol=1e-12).x
        weight = best[:7] / scale
        np.testing.assert_allclose(model.linear.weight[row].numpy(), weight, atol=2e-3)
        assert float(model.linear.bias[row]) == pytest.approx(best[7] - weight @ mean, abs=2e-3)


def test_the_fit_ignores_the_closer_looks_that_are_held_out():
    known = examined()
    other = known.features.clone()
    other[known.fold == 2] = 100.0
    changed = Examined(other, known.right, known.present, known.fold)
    assert torch.equal(fit(known, known.fold != 2).linear.weight, fit(changed, known.fold != 2).linear.weight)


PLACES = st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=3)


@given(PLACES, st.sampled_from(LEVELS))
def test_the_decision_at_a_threshold_equals_a_walk_through_the_closer_looks(places, confirm):
    ends = tuple(range(2, 2 + len(places)))
    verified = Verified(True, tuple(places), ends, 0.5, 9)
    expected = None, 9
    best = 0.0
    for (place, right), end in zip(places, ends, strict=True):
        if place >= confirm + (1 - confirm) / 2:
            expected = right, end
            break
        if place >= confirm and (place > best or (place == best and right)):
            expected, best = (right, 9), place
    assert verified.found(confirm) == expected


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12), st.floats(0, 1))
def test_the_threshold_is_the_least_with_few_enough_false_alarms(places, share):
    searches = [Verified(False, ((place, False),), (2,), place, 3) for place in places]
    searches.append(Verified(True, ((1.0, True),), (2,), 1.0, 2))
    chosen = choose_confirm(searches, share)

    def alarms(confirm):
        return sum(place >= confirm for place in places) / len(places)

    fits = [level for level in LEVELS if alarms(level) <= share + 1e-12]
    assert chosen == (fits[0] if fits else LEVELS[-1])


@pytest.fixture
def seen():
    """Three embedded scenes with classes to search for, and the evidence of an untrained model."""
    eye = Eye(Foveation(9.0), Blobs(), reference=64.0).requires_grad_(False)
    scenes = EmbeddedScenes(CLASSES, count=3)
    options = {"classes": 2, "absent": None, "max_area": 1.0, "seed": 0}
    torch.manual_seed(0)
    evidence = TargetEvidence(4, 4, components=4).eval().requires_grad_(False)
    return photographs(eye, scenes, [0, 1, 2], (4, 3), **options), evidence


def test_looks_that_are_remembered_equal_those_of_the_eye(seen):
    found, evidence = seen
    photograph = found[0]
    first = list(search(photograph, photograph.sought[0], Target(evidence), 3))
    count = len(photograph.seen)
    again = list(search(photograph, photograph.sought[0], Target(evidence), 3))
    assert len(photograph.seen) == count == 3
    view = photograph.eye.open(photograph.image)
    for one, other in zip(first, again, strict=True):
        assert torch.equal(one.belief.probability(1), other.belief.probability(1))
        assert torch.equal(one.detections.scores, photograph.eye.look(view, one.fixation).scores)
    box = torch.tensor([3.0, 4.0, 30.0, 40.0])
    expected = photograph.eye.close_up(photograph.image, box)
    assert torch.equal(photograph.close_up(box).boxes, expected.boxes)
    photograph.close()
    assert torch.equal(photograph.close_up(box + 1).scores, photograph.eye.close_up(photograph.image, box + 1).scores)


def test_classes_are_present_and_absent_as_the_goal_says(seen):
    for photograph in seen[0]:
        annotation = photograph.scenes.annotation(photograph.index)
        for sought in photograph.sought:
            assert sought.present == (sought.target in annotation.labels.tolist())
            for cell in range(len(photograph.grid)):
                alone = torch.zeros(len(photograph.grid)).bool()
                alone[cell] = True
                boxes = annotation.boxes[annotation.labels == sought.target]
                covered = len(boxes) > 0 and bool(photograph.grid.footprint(boxes)[:, cell].any())
                assert bool(sought.goal[cell]) == covered


def test_closer_looks_are_labelled_by_the_annotated_boxes(seen):
    found, evidence = seen
    config = FitVerificationConfig(columns=4, rows=3, looks=3, folds=2)
    known = examine(found, evidence, config)
    assert known.features.shape == (len(known.right), 7)
    assert set(known.fold.tolist()) == {0, 1}
    # A place can only be right in a photograph that holds the target.
    assert bool((known.present | ~known.right).all())
    models = [fit(known, known.fold != fold) for fold in (0, 1)]
    searches = list(verify(found, models, evidence, config))
    assert len(searches) == sum(len(photograph.sought) for photograph in found)
    for each in searches:
        assert len(each.places) == len(each.ends) <= 2
        assert list(each.ends) == sorted(each.ends)
        assert each.looks >= max(each.ends, default=1)
    with pytest.raises(DataError, match="got only one kind"):
        examine([], evidence, config)


@pytest.mark.weights
@pytest.mark.slow
def test_the_command_fits_a_model_that_the_agent_can_load(tmp_path, capsys):
    small = ["--data.limit", "3", "--looks", "2", "--folds", "2", "--data.min_instances", "0"]
    assert main([*small, "--out", str(tmp_path)]) == 0
    model = Verification.from_pretrained(tmp_path / "yolov3-tiny.safetensors")
    assert model.thresholds is not None
    assert model.metadata["training"]["looks"] == 2
    figures = json.loads((tmp_path / "judged.json").read_text())
    assert figures["area"] >= 0
    report = (tmp_path / "report.md").read_text()
    assert "(chosen)" in report
    assert report in capsys.readouterr().out


def test_too_few_photographs_are_refused(tmp_path, capsys):
    assert main(["--data.limit", "2", "--folds", "5", "--data.min_instances", "0", "--out", str(tmp_path)]) == 1
    assert "expected at least 5 photographs" in capsys.readouterr().err
