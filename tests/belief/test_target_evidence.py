"""Learned target evidence: memory against loops in scalars, read-out against numpy and scipy."""

import math

import numpy as np
import pytest
import torch

from semfov import Detections, Grid, TargetEvidence
from semfov.belief.observers import Target
from tests.belief import reference
from tests.refusals import refused

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
