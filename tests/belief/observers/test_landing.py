"""The observer of where eyes land, against a loop over detections and cells."""

import math

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief.observers import Landing, LandingBelief
from semfov.errors import InputError
from semfov.gaze.acquisition import ObjectEvidence
from semfov.gaze.policies import ObjectSeeking


def draw(looks=3, count=5, classes=4, dtype=torch.float64):
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(looks, count, 2, generator=generator, dtype=dtype) * 200
    size = torch.rand(looks, count, 2, generator=generator, dtype=dtype) * 150 + 1
    scores = torch.rand(looks, count, classes + 1, generator=generator, dtype=dtype).softmax(-1)
    mask = torch.rand(looks, count, generator=generator) < 0.7
    return Detections(torch.cat([corner, corner + size], -1), scores, mask)


def evidence_by_loop(seen, look, grid, classes, person, reach):
    """Evidence of one look, in plain Python."""
    table = [[0.0] * classes for _ in range(len(grid))]
    floor = reach * max(grid.extent.tolist())
    for box, scores, there in zip(seen.boxes[look].tolist(), seen.scores[look].tolist(), seen.mask[look], strict=True):
        if not there:
            continue
        x1, y1, x2, y2 = box
        is_person = max(range(classes), key=lambda k: scores[k + 1]) + 1 == person
        share = 0.15 if is_person else 0.25
        sx, sy = max(floor, share * (x2 - x1)), max(floor, share * (y2 - y1))
        bx, by = (x1 + x2) / 2, y1 + (0.18 if is_person else 0.5) * (y2 - y1)
        for cell, (x, y) in enumerate(grid.centres.tolist()):
            peak = math.exp(-((x + 0.5 - bx) ** 2) / (2 * sx**2) - (y + 0.5 - by) ** 2 / (2 * sy**2))
            for k in range(classes):
                table[cell][k] = max(table[cell][k], scores[k + 1] * peak * floor / math.sqrt(sx * sy))
    return torch.tensor(table, dtype=torch.float64)


@pytest.mark.parametrize("person", [1, 3, None])
def test_evidence_is_the_strongest_of_all_detections(person):
    grid, seen = Grid(5, 4, (400, 300)), draw()
    observer = Landing(4, person)
    look = observer.weigh(seen, torch.zeros(3, 2, dtype=torch.float64), grid)
    for number in range(3):
        expected = evidence_by_loop(seen, number, grid, 4, person, 15 / 800)
        torch.testing.assert_close(look.evidence[number], expected)


def test_belief_keeps_the_strongest_evidence_and_the_smallest_distance():
    grid, seen = Grid(5, 4, (400, 300)), draw()
    observer, points = Landing(4), torch.tensor([[0.0, 0.0], [399.0, 299.0], [200.0, 10.0]], dtype=torch.float64)
    look = observer.weigh(seen, points, grid)
    belief = observer.start(1, grid, seen.scores)
    for number in range(3):
        belief = observer.update(belief, look[number : number + 1])
    torch.testing.assert_close(belief.evidence[0], look.evidence.amax(0))
    torch.testing.assert_close(belief.closest[0], grid.distance(points).amin(0))
    torch.testing.assert_close(belief.probability(2), belief.evidence[..., 1])
    shares = belief.class_probabilities()
    torch.testing.assert_close(shares[..., 0], 1 - belief.evidence.amax(-1))
    assert (shares >= 0).all()
    values = ObjectEvidence()(belief, torch.zeros(1, 20, dtype=torch.bool))
    torch.testing.assert_close(values, belief.evidence.sum(-1))
    torch.testing.assert_close(ObjectSeeking()(None, grid)(belief, belief.closest < 0), values)


def test_no_detections_give_no_evidence_and_other_beliefs_are_refused():
    grid, observer = Grid(2, 2, (40, 40)), Landing(3)
    nothing = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 4), torch.zeros(1, 0).bool())
    belief = observer(observer.start(1, grid, torch.zeros(1)), nothing, torch.zeros(1, 2), grid)
    assert isinstance(belief, LandingBelief)
    assert belief.evidence.eq(0).all()
    assert belief[torch.tensor([0, 0])].evidence.shape == (2, 4, 3)
    from semfov import DirichletBelief

    with pytest.raises(InputError, match=r"^belief:"):
        observer.update(DirichletBelief(torch.ones(1, 4, 4)), observer.weigh(nothing, torch.zeros(1, 2), grid))


@pytest.mark.parametrize(
    "bad", [{"classes": 0}, {"person": 4}, {"person": 0}, {"reach": 0}, {"reach": 1.01}, {"reach": -0.1}]
)
def test_invalid_settings_are_refused(bad):
    with pytest.raises(InputError, match=rf"^{next(iter(bad))}:"):
        Landing(**{"classes": 3} | bad)


def test_evidence_is_computed_in_the_precision_of_the_scores():
    grid, seen = Grid(5, 4, (400, 300)), draw()
    look = Landing(4, None, reach=0.013).weigh(seen, torch.zeros(3, 2, dtype=torch.float64), grid)
    for number in range(3):
        expected = evidence_by_loop(seen, number, grid, 4, None, 0.013)
        torch.testing.assert_close(look.evidence[number], expected, rtol=1e-12, atol=1e-300)
    wide = Grid(5, 4, torch.tensor([400.0, 300.0], dtype=torch.float64))
    single = Detections(seen.boxes.float(), seen.scores.float(), seen.mask)
    assert Landing(4).weigh(single, torch.zeros(3, 2), wide).evidence.dtype == torch.float32


def test_settings_at_their_limits():
    assert Landing(1, 1, 1).reach == 1
