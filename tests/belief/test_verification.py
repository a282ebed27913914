"""The verification of a decision by a closer look: its features against a loop, and the models that are shipped."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Detections, FovealObservationModel
from semfov.belief import Verification
from semfov.belief.verification import TRUE_CELLS, closer_features
from tests.refusals import refused
from tests.small import iou


def seen(count, seed):
    """Random detections of one look, some of them masked."""
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(1, count, 2, generator=generator) * 60
    boxes = torch.cat([corner, corner + 5 + torch.rand(1, count, 2, generator=generator) * 60], -1)
    scores = (2 * torch.randn(1, count, 4, generator=generator)).softmax(-1)
    return Detections(boxes, scores, torch.rand(1, count, generator=generator) < 0.8)


def logit(chance):
    chance = min(max(chance, 0.001), 0.999)
    return math.log(chance / (1 - chance))


@given(st.integers(0, 6), st.integers(0, 10_000), *[st.floats(0, 1)] * 3)
def test_features_equal_a_loop(count, seed, presence, cell, evidence):
    closer, box = seen(count, seed), torch.tensor([20.0, 30, 70, 90])
    target, best, match, chosen = 2, -1.0, None, box
    highest = other = 0.0
    for number in range(count):
        if not closer.mask[0, number]:
            continue
        shared = iou(closer.boxes[0, number].tolist(), box.tolist())
        scores = closer.scores[0, number].tolist()
        highest = max(highest, scores[target])
        other = max(other, shared * max(scores[1], scores[3]))
        if scores[target] * shared > best:
            best, match = scores[target] * shared, (scores[target], shared, number)
    if match is not None and match[1] >= 0.3:
        chosen = closer.boxes[0, match[2]]
    expected = [presence, cell, evidence, max(best, 0.0), highest, other, match[0] if match else 0.0]
    features, found = closer_features(presence, cell, evidence, closer, box, target)
    torch.testing.assert_close(features, torch.tensor([logit(each) for each in expected]), atol=2e-4, rtol=2e-4)
    assert torch.equal(found, chosen)


def test_shipped_models_are_loaded_by_name_and_others_are_none():
    assert Verification.if_shipped("no such model") is None
    shipped = sorted(path.stem for path in Verification.shipped.glob("*.safetensors"))
    assert shipped
    for name in shipped:
        model = Verification.if_shipped(name)
        assert model is not None
        assert model.thresholds is not None
        # It was fitted for the detector and the sensor of the map of the same name.
        model.check_compatible(FovealObservationModel.from_pretrained(name).metadata)


@pytest.mark.parametrize("name", ["yolox-nano", "yolov3-tiny", "nanodet-plus-m-1.5x"])
def test_a_better_closer_look_raises_both_shipped_probabilities(name):
    """More score for the target at the place and in the window, and less for other classes, never lower the place."""
    model = Verification.from_pretrained(name)
    weak = torch.tensor([0.0, 0.0, 0.0, -5.0, -5.0, 2.0, -5.0])
    strong = torch.tensor([0.0, 0.0, 0.0, 3.0, 3.0, -5.0, 3.0])
    assert bool((model(strong) > model(weak)).all())


def test_features_keep_double_precision_and_a_box_that_overlaps_by_exactly_the_least_share():
    box = torch.tensor([0.0, 0, 10, 10], dtype=torch.float64)
    part = torch.tensor([0.0, 0, 10, 3], dtype=torch.float64)
    closer = Detections(part[None, None], torch.tensor([[[0.2, 0.8]]], dtype=torch.float64), torch.ones(1, 1).bool())
    features, found = closer_features(0.5, 0.5, 0.5, closer, box, 1)
    assert torch.equal(found, part)
    assert features.dtype == torch.float64
    assert features[3:].tolist() == pytest.approx([logit(0.24), logit(0.8), logit(0.0), logit(0.8)], abs=1e-6)


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("amp", [torch.bfloat16, torch.float16])
def test_features_in_half_precision_suit_automatic_mixed_precision(half, amp):
    torch.manual_seed(0)
    model, features = Verification(), torch.randn(3, 7).to(half)
    expected = features.double() @ model.linear.weight.double().T + model.linear.bias.double()
    for enabled in (True, False):
        with torch.autocast("cpu", amp, enabled=enabled):
            torch.testing.assert_close(model(features), expected.float())


@pytest.mark.parametrize(
    ("name", "shown"), [("mine", "MODEL.onnx"), ("x; rm -rf y", "MODEL.onnx"), ("yolov3-tiny", "yolov3-tiny")]
)
def test_the_command_that_fits_again_names_published_detectors_alone(name, shown):
    searching = FovealObservationModel.identity(["cup"], [0.5], metadata={"detector": {"name": name}})
    verification = Verification(metadata={TRUE_CELLS: True})
    message = rf"verification: .* place of the file: semfov fit {shown} --data\.root PHOTOS .* --out mymodels$"
    refused(message, verification.check_searching, searching)
