"""The learned map: gathered evidence and belief against numpy, look by look; episodes, gradients, dtypes, devices."""

from dataclasses import fields, replace

import numpy as np
import pytest
import scipy.special
import torch

from semfov import FovealObservationModel, Grid, InputError, MapEvidence, TargetEvidence
from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import LearnedMap, Target
from semfov.belief.observers.learned_map import MapBelief
from semfov.gaze.acquisition import KLDivergence
from tests.belief import reference

GRID = Grid(6, 4, (90, 60))
FIXATED = [0, 9, 20, 5]
FIXATIONS = GRID.centres[FIXATED]
CLASSES = torch.arange(1, 5)


def believe(observer, looks, order, grid=GRID, fixations=FIXATIONS):
    """Belief of one episode after looks in the given order."""
    belief = observer.start(1, grid, looks.scores)
    for look in order:
        part = slice(look, look + 1)
        belief = observer(belief, looks[part], fixations[part].to(looks.scores), grid)
    return belief


def gather_in_numpy(model, looks, order, stands_for=None):
    """The same in numpy: the gathered evidence, and the probabilities computed from it."""
    fixations, cells = FIXATIONS.to(looks.scores), 24
    features = class_features(looks, fixations, GRID, CLASSES)
    said = reference.run_network(model.look, reference.array(features))
    shown = reference.array(highest_score(looks, CLASSES))
    nearest, best, total = np.zeros((4, cells)), np.full((4, cells), -np.inf), np.zeros((4, cells))
    closest, weight, score, visited = np.full(cells, np.inf), np.zeros(cells), np.zeros(4), [False] * cells
    for look in order:
        for cell in range(cells):
            distance = float(np.hypot(*(reference.array(GRID.centres)[cell] - reference.array(fixations)[look]))) / 90
            if distance < closest[cell]:
                closest[cell], nearest[:, cell] = distance, said[look, :, cell]
            best[:, cell] = np.maximum(best[:, cell], said[look, :, cell])
            total[:, cell] += np.exp(-6 * distance) * said[look, :, cell]
            weight[cell] += np.exp(-6 * distance)
        score = np.maximum(score, shown[look])
        visited[FIXATED[look]] = True
    odds = reference.class_odds(model, nearest, best, total / weight, closest, len(order), [1, 2, 3, 4], 6)
    nothing = reference.emptiness(model, odds, closest, len(order), 6, stands_for)
    probabilities = scipy.special.expit(np.concatenate([nothing[None], odds])).T
    return {
        "probabilities": probabilities,
        "closest": closest,
        "nearest": nearest,
        "best": best,
        "total": total,
        "weight": weight,
        "score": score,
        "looks": float(len(order)),
        "visited": visited,
    }


@pytest.mark.parametrize("order", [(2,), (0, 1, 2, 3), (1, 1, 0, 1)], ids=str)
def test_belief_equals_a_reference_in_numpy(random_looks, toy_map, order, dtype, device):
    looks, model = random_looks(dtype=dtype), toy_map().to(dtype=dtype)
    with torch.no_grad():
        belief = believe(LearnedMap(model).to(device), looks.to(device), order)
    expected = gather_in_numpy(model.cpu(), looks, order)
    assert set(expected) == {part.name for part in fields(MapBelief)}
    close = 2e-4 if dtype == torch.float32 else 1e-6
    for name, value in expected.items():
        tensor = getattr(belief, name)
        assert tensor.device.type == device.type, name
        assert tensor.dtype in (dtype, torch.bool), name
        np.testing.assert_allclose(reference.array(tensor[0]), np.asarray(value), atol=close, rtol=close, err_msg=name)


def test_classes_that_stand_for_several_count_several_times_for_background(random_looks, toy_map):
    looks, model, stands_for = random_looks(dtype=torch.float64), toy_map().double(), [1, 3, 9, 2]
    observer = LearnedMap(model)
    with torch.no_grad():
        look = observer.weigh(looks[:1], FIXATIONS[:1].double(), GRID)
        look = replace(look, stands_for=torch.tensor([stands_for]))
        belief = observer.update(observer.start(1, GRID, looks.scores), look)
    expected = gather_in_numpy(model, looks, (0,), stands_for)
    np.testing.assert_allclose(reference.array(belief.probabilities[0]), expected["probabilities"], atol=1e-6)


@pytest.mark.parametrize("make", [LearnedMap, Target])
def test_episodes_are_computed_one_by_one_unless_together_is_set(make):
    model = (MapEvidence if make is LearnedMap else TargetEvidence)(4, 4, components=4)
    for observer, sizes in ((make(model), [1, 1, 1]), (make(model, together=True), [3])):
        assert observer.each(lambda rows: torch.tensor([len(rows)]), torch.zeros(3, 2)).tolist() == sizes


def test_belief_has_a_probability_for_every_class(random_looks, toy_map):
    with torch.no_grad():
        belief = believe(LearnedMap(toy_map()), random_looks(), (0, 1, 3))[torch.tensor([0, 0, 0])]
    assert belief.class_probabilities() is belief.probabilities
    assert bool(((belief.probabilities > 0) & (belief.probabilities < 1)).all())
    for target in range(5):
        assert torch.equal(belief.probability(target), belief.probabilities[..., target])
    several = belief.probability(torch.tensor([4, 0, 2]))
    for row, target in enumerate((4, 0, 2)):
        assert torch.equal(several[row], belief.probabilities[row, :, target])
    assert torch.equal(belief.chance(2), belief.probability(2))
    assert torch.equal(belief.presence(2), belief.probability(2).amax(-1))
    with pytest.raises(InputError, match="target"):
        belief.probability(5)


def sequence(looks):
    """Three looks of each of four episodes."""
    for order in ([0, 1, 2, 3], [1, 2, 3, 0], [3, 3, 0, 2]):
        index = torch.tensor(order)
        yield looks[index], FIXATIONS[index]


def test_gradients_reach_every_parameter(random_looks, toy_map):
    model = toy_map().double()
    looks = random_looks(dtype=torch.float64)
    belief = LearnedMap(model, together=True).start(4, GRID, looks.scores)
    for seen, fixation in sequence(looks):
        belief = LearnedMap(model, together=True)(belief, seen, fixation.double(), GRID)
    gain = model.gain(belief.probabilities, belief.closest, belief.looks, GRID.cell_distance.double())
    (belief.probabilities.sum() + gain.sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert float(parameter.grad.abs().sum()) > 0, name
    # In the prior only the classes have gradients: background has none.
    assert model.prior.grad.nonzero()[:, 0].tolist() == [1, 2, 3, 4]


def test_policies_that_need_a_dirichlet_belief_refuse_the_map(toy_map, random_looks):
    observer = LearnedMap(toy_map())
    belief = observer.start(4, GRID, random_looks().scores)
    observation = FovealObservationModel.identity(["a", "b", "c", "d"], [0.2])
    with pytest.raises(InputError, match="belief: expected a belief about all classes \\(DirichletBelief\\)"):
        KLDivergence(observation, GRID)(belief, torch.zeros(4, 24, dtype=torch.bool))
    assert observer.thresholds is None
    assert not observer.by_target
