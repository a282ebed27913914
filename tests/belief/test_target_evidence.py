"""Learned target evidence: features against a loop, the networks' inputs against scipy, memory against its rules."""

import numpy as np
import pytest
import scipy.ndimage
import torch

from semfov import Detections, FovealObservationModel, Grid
from semfov.belief import TargetEvidence
from semfov.belief.look_features import FEATURES, look_features
from semfov.belief.observers import Target
from semfov.belief.target_evidence import _blur, _peak
from semfov.errors import DataError, InputError
from semfov.gaze.acquisition import KLDivergence

GRID = Grid(6, 4, (90, 60))


@pytest.fixture
def looks():
    torch.manual_seed(0)
    corner = torch.rand(3, 5, 2) * 50
    boxes = torch.cat([corner, corner + 3 + torch.rand(3, 5, 2) * 30], -1)
    mask = torch.tensor([[True] * 5, [True] * 2 + [False] * 3, [False] * 5])
    return Detections(boxes, torch.rand(3, 5, 4).softmax(-1), mask)


@pytest.fixture
def model():
    torch.manual_seed(1)
    return TargetEvidence(8, 6).eval()


FIXATIONS = GRID.centres[torch.tensor([0, 9, 20])]


def test_features_equal_a_loop(looks):
    got = look_features(looks, FIXATIONS, GRID, 2)
    assert got.shape == (3, 24, FEATURES)
    for look in range(3):
        for cell in range(24):
            assert got[look, cell].tolist() == pytest.approx(describe(looks, look, cell), abs=1e-4)


def describe(looks, look, cell):
    distance = float(torch.linalg.vector_norm(GRID.centres[cell] - FIXATIONS[look])) / 90
    chosen, touched = None, []
    for detection in range(5):
        weight = float(GRID.footprint(looks.boxes[look, detection][None], "soft")[0, cell])
        if not looks.mask[look, detection] or weight == 0:
            continue
        background, score = (float(looks.scores[look, detection, k]) for k in (0, 2))
        box = looks.boxes[look, detection]
        size = float(((box[2] - box[0]) * (box[3] - box[1]) / 5400).sqrt())
        touched.append((score, 1 - background, weight))
        if chosen is None or score * weight > chosen[0] * chosen[2]:
            chosen = (score, 1 - background, weight, size)
    if chosen is None:
        floor = np.log(1e-6) / 4 + 1
        return [4 * distance, floor, floor, 0, 0, 0, 0, 0, 0, 1]
    score, objectness, weight, size = chosen
    return [
        4 * distance,
        np.log(score * weight) / 4 + 1,
        np.log(max(s for s, _, _ in touched)) / 4 + 1,
        2 * objectness,
        2 * weight,
        3 * size,
        2 * score / objectness,
        2 * max(o * w for _, o, w in touched),
        2 * max((o - s) * w for s, o, w in touched),
        0,
    ]


def test_looks_without_any_detection():
    nothing = look_features(Detections.empty(2, 3), FIXATIONS[:2], GRID, 1)
    assert torch.equal(nothing[..., 9], torch.ones(2, 24))
    assert torch.isfinite(nothing).all()


def test_neighbourhoods_are_those_of_scipy():
    torch.manual_seed(0)
    values = torch.rand(2, 24, dtype=torch.float64)
    steps = np.arange(-3, 4)
    kernel = np.exp(-(steps**2) / (2 * 0.8**2))
    kernel /= kernel.sum()
    for image, blurred, peak in zip(values, _blur(values, 6, 0.8), _peak(values, 6), strict=True):
        grid = image.reshape(4, 6).numpy()
        expected = scipy.ndimage.convolve(grid, np.outer(kernel, kernel), mode="constant")
        np.testing.assert_allclose(blurred.reshape(4, 6), expected, atol=1e-12)
        np.testing.assert_allclose(peak.reshape(4, 6), scipy.ndimage.maximum_filter(grid, 3, mode="nearest"))


def test_belief_keeps_the_closest_look_and_the_strongest(looks, model):
    observer = Target(model)
    belief = observer.start(1, GRID, torch.empty(0))
    with torch.no_grad():
        for look in range(3):
            evidence = observer.weigh(looks[look : look + 1], FIXATIONS[look : look + 1], GRID, 2)
            belief = observer.update(belief, evidence)
        said = model(looks, FIXATIONS, GRID, 2)
        offset = torch.cdist(GRID.centres, FIXATIONS)
        nearest = said.t().gather(1, offset.argmin(1)[:, None])[:, 0]
        torch.testing.assert_close(belief.nearest[0], nearest)
        torch.testing.assert_close(belief.best[0], said.amax(0))
        assert belief.visited[0].nonzero()[:, 0].tolist() == [0, 9, 20]
        odds = model.log_odds(belief.nearest, belief.best, offset.amin(1)[None] / 90, belief.visited, 6)
    torch.testing.assert_close(belief.present, odds.sigmoid())
    # It is about the target that was searched for, whatever is asked.
    assert belief.probability(7) is belief.probability(torch.tensor([2])) is belief.present


def test_an_acquisition_about_all_classes_refuses_a_belief_about_one_target(model):
    belief = Target(model).start(1, GRID, torch.empty(0))
    observation = FovealObservationModel.identity(["cup", "cat"], [0.2])
    with pytest.raises(InputError, match="belief: expected a belief about all classes"):
        KLDivergence(observation, GRID)(belief, belief.visited)


def test_gradients_reach_every_parameter(looks):
    torch.manual_seed(1)
    model = TargetEvidence(4, 4).double()
    seen = Detections(looks.boxes.double(), looks.scores.double(), looks.mask)
    features = look_features(seen, FIXATIONS.double(), GRID, 1)
    visited = torch.zeros(1, 24, dtype=torch.bool)

    def odds(features):
        evidence = model.evidence(features)
        return model.log_odds(evidence[:1], evidence.amax(0, keepdim=True), features[:1, :, 0] / 4, visited, 6)

    odds(features).sum().backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in model.parameters())
    small = features[:, :, :].detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda f: odds(f).sum(), small, atol=1e-4)


def test_saved_and_loaded_is_the_same(tmp_path, looks, model):
    model.metadata = {"detector": {"name": "toy"}, "sensor": {}}
    model.save(tmp_path / "model.safetensors")
    loaded = TargetEvidence.from_pretrained(tmp_path / "model.safetensors")
    assert loaded.metadata == model.metadata
    assert torch.equal(loaded(looks, FIXATIONS, GRID, 1), model(looks, FIXATIONS, GRID, 1))
    with pytest.raises(InputError, match="fitted for 'toy'"):
        loaded.check_compatible({"detector": {"name": "other"}, "sensor": {}})
    with pytest.raises(DataError):
        TargetEvidence.from_pretrained(tmp_path / "none.safetensors")


def test_bad_input(looks, model):
    with pytest.raises(InputError, match="target"):
        model(looks, FIXATIONS, GRID, 4)
    with pytest.raises(InputError, match="target"):
        Target(model).weigh(looks, FIXATIONS, GRID)
    with pytest.raises(InputError, match="fixation"):
        model(looks, FIXATIONS[:2], GRID, 1)
