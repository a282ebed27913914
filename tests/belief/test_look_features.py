"""The features of detections that learned evidence reads, against loops."""

import math

import pytest
import torch

from semfov import Detections, Grid, InputError
from semfov.belief.look_features import LOOK_FEATURES, class_features, highest_score, look_features, nothing_seen
from tests.refusals import refused

GRID = Grid(6, 4, (90, 60))


FIXATIONS = GRID.centres[[0, 9, 20, 5]]


def overlaps(box, cell):
    left, top = cell % 6 * 15, cell // 6 * 15
    return box[0] < left + 15 and box[2] > left and box[1] < top + 15 and box[3] > top


def weight_of(box, cell):
    """The `soft` footprint of a box of half sizes (a, b) and a cell of half sizes (7.5, 7.5)."""
    if not overlaps(box, cell):
        return 0.0
    x = cell % 6 * 15 + 7.5 - (box[0] + box[2]) / 2
    y = cell // 6 * 15 + 7.5 - (box[1] + box[3]) / 2
    across, down = ((box[2] - box[0]) / 2) ** 2 + 7.5**2, ((box[3] - box[1]) / 2) ** 2 + 7.5**2
    return math.exp(-(x**2) / (2 * across / 3) - y**2 / (2 * down / 3))


def features_by_loop(looks, look, target, cell):
    """The ten features of a cell, detection by detection."""
    centre = (cell % 6 * 15 + 7, cell // 6 * 15 + 7)
    distance = math.dist(centre, FIXATIONS[look].tolist()) / 90
    touching = []
    for box, scores, real in zip(
        looks.boxes[look].tolist(), looks.scores[look].tolist(), looks.mask[look].tolist(), strict=True
    ):
        weight = weight_of(box, cell)
        if real and weight > 0:
            size = math.sqrt((box[2] - box[0]) * (box[3] - box[1]) / (90 * 60))
            touching.append((scores[target], 1 - scores[0], weight, size))
    if not touching:
        floor = math.log(1e-6) / 4 + 1
        return [4 * distance, floor, floor, 0, 0, 0, 0, 0, 0, 1]
    score, objectness, weight, size = max(touching, key=lambda one: one[0] * one[2])
    return [
        4 * distance,
        math.log(max(score * weight, 1e-6)) / 4 + 1,
        math.log(max(one[0] for one in touching)) / 4 + 1,
        2 * objectness,
        2 * weight,
        3 * size,
        2 * score / objectness,
        2 * max(o * w for _, o, w, _ in touching),
        2 * max(max(o - s, 0) * w for s, o, w, _ in touching),
        0,
    ]


def test_features_of_several_classes_equal_a_loop(random_looks, dtype, device):
    centre = torch.tensor([7.0, 7.0])
    assert torch.equal(GRID.centres[0], centre)
    looks = random_looks(dtype=dtype)
    targets = torch.tensor([3, 1, 4])
    got = class_features(looks.to(device), FIXATIONS.to(device, dtype), GRID, targets.to(device))
    assert got.shape == (4, 3, 24, LOOK_FEATURES)
    assert got.dtype == dtype
    assert got.device.type == device.type
    close = 1e-4 if dtype == torch.float32 else 1e-9
    for look in range(4):
        for row, target in enumerate(targets.tolist()):
            for cell in range(24):
                expected = features_by_loop(looks, look, target, cell)
                assert got[look, row, cell].tolist() == pytest.approx(expected, abs=close), (look, target, cell)
    assert 0 < float(got[..., 9].mean()) < 1
    assert bool((got[2, ..., 9] == 1).all())


def test_features_do_not_depend_on_padding_order_or_other_classes(random_looks):
    looks, every = random_looks(), torch.arange(1, 5)
    together = class_features(looks, FIXATIONS, GRID, every)
    for target in range(1, 5):
        assert torch.equal(look_features(looks, FIXATIONS, GRID, target), together[:, target - 1])
        torch.testing.assert_close(
            class_features(looks, FIXATIONS, GRID, every[target - 1 : target])[:, 0], together[:, target - 1]
        )
    # The classes may be in any order and may repeat.
    mixed = torch.tensor([4, 2, 4])
    assert torch.equal(class_features(looks, FIXATIONS, GRID, mixed), together[:, mixed - 1])
    looks, every = random_looks(), torch.arange(1, 5)
    expected = class_features(looks, FIXATIONS, GRID, every)
    order = torch.tensor([3, 1, 4, 0, 2])
    turned = Detections(looks.boxes[:, order], looks.scores[:, order], looks.mask[:, order])
    torch.testing.assert_close(class_features(turned, FIXATIONS, GRID, every), expected)
    boxes = looks.boxes.masked_fill(~looks.mask[..., None], 0) + ~looks.mask[..., None] * torch.tensor([5.0, 5, 60, 50])
    scores = torch.where(looks.mask[..., None], looks.scores, torch.tensor([0.0, 1, 1, 1, 1]))
    assert torch.equal(class_features(Detections(boxes, scores, looks.mask), FIXATIONS, GRID, every), expected)


def test_features_of_boxes_smaller_than_a_pixel_equal_a_loop(random_looks):
    looks = random_looks(dtype=torch.float64)
    small = Detections(torch.cat([looks.boxes[..., :2], looks.boxes[..., :2] + 0.3], -1), looks.scores, looks.mask)
    got = class_features(small, FIXATIONS.double(), GRID, torch.tensor([2]))[:, 0]
    for look in range(4):
        for cell in range(24):
            assert got[look, cell].tolist() == pytest.approx(features_by_loop(small, look, 2, cell), abs=1e-9)


@pytest.mark.parametrize("most", [0, 3])
def test_features_without_detections_equal_a_loop(most):
    """No detections, with padding or without."""
    nothing = Detections(torch.zeros(4, most, 4), torch.zeros(4, most, 5), torch.zeros(4, most, dtype=torch.bool))
    got = class_features(nothing, FIXATIONS, GRID, torch.arange(1, 5))
    assert got.shape == (4, 4, 24, LOOK_FEATURES)
    for look in range(4):
        for cell in range(24):
            expected = features_by_loop(nothing, look, 1, cell)
            assert all(row.tolist() == pytest.approx(expected, abs=1e-5) for row in got[look, :, cell])


def test_highest_scores_equal_a_loop(random_looks, device):
    looks = random_looks()
    every = torch.tensor([2, 0, 4])
    several = highest_score(looks.to(device), every.to(device))
    assert several.shape == (4, 3)
    for look in range(4):
        for row, target in enumerate(every.tolist()):
            shown = [float(s[target]) for s, m in zip(looks.scores[look], looks.mask[look], strict=True) if m]
            assert float(several[look, row]) == max(shown, default=0.0)
    for target in range(5):
        one = highest_score(looks.to(device), target)
        assert one.shape == (4,)
        assert torch.equal(one, highest_score(looks.to(device), torch.tensor([target], device=device))[:, 0])
    empty = Detections.empty(3, 4, like=torch.empty(0, dtype=torch.float64, device=device))
    for target, shape in ((2, (3,)), (every, (3, 3))):
        none = highest_score(empty, target)
        assert none.shape == shape
        assert none.dtype == torch.float64
        assert not none.any()


def test_gradients_through_scores_and_boxes(random_looks):
    looks = random_looks(dtype=torch.float64)

    def features(scores, boxes):
        seen = Detections(boxes, scores, looks.mask)
        return class_features(seen, FIXATIONS.double(), GRID, torch.tensor([1, 3])), highest_score(seen, 2)

    values = [tensor.clone().requires_grad_() for tensor in (looks.scores, looks.boxes)]
    assert torch.autograd.gradcheck(features, values, fast_mode=True)


def test_bad_input(random_looks):
    looks = random_looks()
    for fixations in (FIXATIONS[:2], torch.zeros(4, 3)):
        with pytest.raises(InputError, match=r"^fixation: expected a tensor of shape \(..., 4, 2\)"):
            class_features(looks, fixations, GRID, torch.tensor([1]))
    for target in (0, 5):
        refused("target: expected a class from 1 to 4", look_features, looks, FIXATIONS, GRID, target)


def test_features_of_a_look_without_detections_equal_nothing_seen():
    grid, fixation = Grid(5, 4, (100, 60)), torch.tensor([[12.0, 34.0]])
    shown = look_features(Detections.empty(1, 3), fixation, grid, 2)
    assert torch.equal(nothing_seen(grid.distance(fixation)), shown)
