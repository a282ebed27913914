"""Target evidence, the networks of evidence, and the verification of a decision, against loops and numpy."""

import math

import numpy as np
import pytest
import scipy.ndimage
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from semfov import Detections, Grid, TargetEvidence
from semfov.belief import Verification
from semfov.belief.evidence import READOUT, blur, logarithm, nearness, network
from semfov.belief.observers import Target
from semfov.belief.verification import closer_features
from tests.belief import reference
from tests.refusals import refused
from tests.small import iou

GRID = Grid(6, 4, (90, 60))


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, components=4)


@pytest.fixture
def model():
    torch.manual_seed(1)
    return TargetEvidence(8, 6, components=4).eval()


FIXATED = [0, 9, 20]
FIXATIONS = GRID.centres[FIXATED]


def sigmoid(value):
    return 1 / (1 + math.exp(-value))


def read_out(model, known, target):
    """Log odds of all cells, of all cells if no fixated cell holds the target, and of presence."""
    nearest, best, mean, closest, visited = (
        np.array(known[name]) for name in ("nearest", "best", "mean", "closest", "visited")
    )
    prior = float(model.prior[target])

    def read(network, values, *more):
        features = reference.readout_features(values, best, mean, closest, known["looks"], prior, 6)
        return values + reference.run_network(network, np.column_stack([features, *more]))

    cells = read(model.read, nearest)
    following = read(model.guide, np.where(visited, -8.0, nearest), reference.blurred(visited.astype(float), 6, 0.6))
    inputs = [
        max(cells) / 3,
        math.log(sum(math.exp(value) for value in cells)) / 3,
        sorted(cells)[-5] / 3,
        max(best) / 3,
        max(nearest) / 3,
        4 * sum(closest) / 24,
        math.log(known["looks"]) / 2,
        prior,
        reference.log_scaled(known["score"]),
    ]
    return cells, following, max(cells) + reference.run_network(model.judge, inputs)


def gather_by_loop(looks, model, order, target):
    """Evidence gathered from looks in this order, look by look and cell by cell."""
    evidence = model(looks, FIXATIONS, GRID, target)
    cells = range(24)
    known = {"nearest": [0.0] * 24, "best": [-math.inf] * 24, "closest": [math.inf] * 24, "score": 0.0, "looks": 0}
    known["visited"] = [False] * 24
    total, weight = [0.0] * 24, [0.0] * 24
    for look in order:
        for cell in cells:
            said = float(evidence[look, cell])
            distance = math.dist(GRID.centres[cell].tolist(), FIXATIONS[look].tolist()) / 90
            if distance < known["closest"][cell] - 1e-6:
                known["closest"][cell], known["nearest"][cell] = distance, said
            known["best"][cell] = max(known["best"][cell], said)
            total[cell] += math.exp(-6 * distance) * said
            weight[cell] += math.exp(-6 * distance)
        for detection in range(5):
            if looks.mask[look, detection]:
                known["score"] = max(known["score"], float(looks.scores[look, detection, target]))
        known["looks"] += 1
        known["visited"][FIXATED[look]] = True
    return {**known, "total": total, "weight": weight, "mean": [t / w for t, w in zip(total, weight, strict=True)]}


def believe(observer, looks, order, target):
    """Belief after looks in this order."""
    belief = observer.start(1, GRID, looks.scores)
    for look in order:
        part = slice(look, look + 1)
        belief = observer.update(belief, observer.weigh(looks[part], FIXATIONS[part], GRID, target))
    return belief


@pytest.mark.parametrize("order", [(0,), (2,), (0, 1, 2), (2, 1, 0), (1, 1, 0)], ids=str)
@pytest.mark.parametrize("target", [1, 3])
def test_belief_equals_a_loop_over_looks_and_cells(looks, model, order, target):
    with torch.no_grad():
        model.prior.copy_(torch.tensor([0.3, -1.0, 2.0, 0.7]))
        belief = believe(Target(model), looks, order, target)
        known = gather_by_loop(looks, model, order, target)
        cells, following, anywhere = read_out(model, known, target)
    for name in ("nearest", "best", "closest", "total", "weight"):
        assert getattr(belief, name)[0].tolist() == pytest.approx(known[name], abs=1e-5), name
    assert float(belief.score) == pytest.approx(known["score"])
    assert float(belief.looks) == len(order)
    assert belief.visited[0].tolist() == known["visited"]
    assert belief.present[0].tolist() == pytest.approx([sigmoid(value) for value in cells], abs=1e-5)
    assert belief.following[0].tolist() == pytest.approx([sigmoid(value) for value in following], abs=1e-5)
    assert float(belief.anywhere) == pytest.approx(sigmoid(anywhere), abs=1e-5)
    # The belief is about the target of the search, whichever class is asked for.
    assert belief.probability(7) is belief.probability(torch.tensor([2])) is belief.present
    assert belief.chance(7) is belief.chance(torch.tensor([2])) is belief.following
    assert belief.presence(7) is belief.presence(torch.tensor([2])) is belief.anywhere


def test_gradients_reach_every_parameter(looks):
    torch.manual_seed(1)
    model = TargetEvidence(4, 4, components=4).double()
    torch.nn.init.normal_(model.prior)
    seen = Detections(looks.boxes.double(), looks.scores.double(), looks.mask)
    observer = Target(model)
    belief = observer.start(3, GRID, seen.scores)
    for order in (torch.tensor([0, 1, 2]), torch.tensor([1, 0, 2])):
        belief = observer(belief, seen[order], FIXATIONS.double()[order], GRID, 1)
    (belief.present.sum() + belief.following.sum() + belief.anywhere.sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert float(parameter.grad.abs().sum()) > 0, name
    # In the prior only the target has a gradient.
    assert model.prior.grad.nonzero()[:, 0].tolist() == [1]


def test_bad_input(looks, model):
    refused("target", model, looks, FIXATIONS, GRID, 4)
    refused("target", Target(model).weigh, looks, FIXATIONS, GRID)
    refused("fixation", model, looks, FIXATIONS[:2], GRID, 1)


def test_the_default_classes_are_those_of_coco():
    assert TargetEvidence().prior.shape == (81,)
    assert TargetEvidence().widths == (48, 24)


class Recorder(nn.Module):
    """Records its inputs, one table for each of 8 episodes, and corrects every cell by 0.5."""

    def forward(self, inputs):
        self.read = inputs.unflatten(0, (8, -1))
        return inputs.new_full((*inputs.shape[:-1], 1), 0.5)


@pytest.mark.parametrize("columns", [1, 2, 6, 12, 24])
def test_inputs_of_a_network_equal_a_reference_in_numpy(toy_evidence, gathered, dtype, device, columns):
    said = gathered(dtype=dtype)
    said = type(said)(*(each.to(device) for each in said))
    model, recorder = toy_evidence().to(device, dtype), Recorder()
    more = torch.arange(24.0, device=device).to(dtype)
    got = model.read_out(recorder, said.nearest, said, columns, more, 2 * more)
    torch.testing.assert_close(got, said.nearest + 0.5)
    assert recorder.read.shape == (8, 24, READOUT + 2)
    assert recorder.read.dtype == dtype
    for row in range(8):
        expected = reference.readout_features(
            *(reference.array(getattr(said, name)[row]) for name in ("nearest", "best", "mean", "distance")),
            float(said.looks[row]),
            float(model.prior[said.target[row]].detach()),
            columns,
        )
        close = 1e-5 if dtype == torch.float32 else 1e-7
        np.testing.assert_allclose(reference.array(recorder.read[row, :, :READOUT]), expected, atol=close, rtol=close)
        assert torch.equal(recorder.read[row, :, READOUT:], torch.stack([more, 2 * more], -1))


def test_inputs_of_a_network_have_the_precision_of_the_evidence(toy_evidence, gathered):
    model, recorder, said = toy_evidence().bfloat16(), Recorder(), gathered(dtype=torch.bfloat16)
    assert model.read_out(recorder, said.nearest, said, 6).dtype == recorder.read.dtype == torch.bfloat16


@pytest.mark.parametrize("sigma", [0.3, 0.6, 1.5, 4.0])
@pytest.mark.parametrize("columns", [1, 2, 6, 8, 24])
def test_blur_matches_scipy(columns, sigma, device):
    values = torch.rand(3, 24, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    got = blur(values.to(device), columns, sigma).cpu()
    assert got.shape == values.shape
    for image, blurred in zip(values.numpy(), got.numpy(), strict=True):
        table = image.reshape(-1, columns)
        filtered = scipy.ndimage.gaussian_filter(table, sigma, mode="constant", radius=3)
        np.testing.assert_allclose(blurred.reshape(table.shape), filtered, atol=1e-12)


def test_nearness_and_logarithms_of_odds_follow_their_formulas(dtype):
    distance = torch.tensor([0.0, 1 / 6, 1 / 3, 1.25, math.inf], dtype=dtype)
    got = nearness(distance)
    assert got.dtype == dtype
    assert got.tolist() == pytest.approx([math.exp(-6 * d) for d in distance.tolist()], rel=1e-6)
    assert got[-1] == 0
    odds = torch.tensor([0.0, 1e-12, 1e-3, 0.5, 1.0, 80.0], dtype=torch.float64)
    expected = [math.log(value + 1e-3) / 2 + 1 for value in odds.tolist()]
    assert logarithm(odds).tolist() == pytest.approx(expected)
    assert bool(logarithm(odds).isfinite().all())


def test_networks_have_two_hidden_layers():
    torch.manual_seed(0)
    made = network(5, 7).double()
    assert [layer.in_features for layer in made if isinstance(layer, nn.Linear)] == [5, 7, 7]
    inputs = torch.randn(4, 3, 5, dtype=torch.float64)
    np.testing.assert_allclose(
        reference.array(made(inputs))[..., 0], reference.run_network(made, inputs.numpy()), atol=1e-12
    )


def test_all_classes_start_with_the_same_prior():
    model = TargetEvidence(4, 5, components=7)
    assert torch.equal(model.prior, torch.zeros(7))
    assert model.widths == (4, 5)
    assert model.metadata == {}
    features = torch.randn(2, 3, 10)
    assert model.evidence(features).shape == (2, 3)


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
        evidence = TargetEvidence.from_pretrained(name)
        # It was fitted for the detector and the sensor of the evidence of the same name.
        assert model.metadata["sensor"] == evidence.metadata["sensor"]
        model.check_compatible(evidence.metadata)


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
