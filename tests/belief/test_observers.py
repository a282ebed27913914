"""Observers: beliefs from detections against loops and numpy, and searches for any of several classes."""

from dataclasses import fields, replace

import numpy as np
import pytest
import scipy.special
import torch

from semfov import Detections, FovealObservationModel, Grid, InputError, MapEvidence, TargetEvidence
from semfov.belief import fusion, likelihoods
from semfov.belief.look_features import class_features, highest_score
from semfov.belief.observers import AnyOf, LearnedMap, Semantic, Target
from semfov.belief.observers.any_of import class_meant
from semfov.belief.observers.learned_map import MapBelief
from semfov.belief.observers.semantic import SemanticLook
from semfov.belief.target_evidence import Thresholds
from semfov.gaze.acquisition import KLDivergence
from semfov.gaze.policies import Policy
from semfov.strategy import Strategy
from tests.belief import reference
from tests.refusals import refused

GRID = Grid(5, 4, (100, 80))
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, most=4, components=4)


class Misses:
    """Miss rates: background is always missed, class 3 never."""

    def miss_likelihood(self, distance):
        return torch.stack([torch.ones_like(distance), 0.2 + distance, distance.clamp(max=1), 0 * distance], -1)


MISSES = Misses()


def watch(observer, looks):
    belief = observer.start(1, GRID, torch.empty(0, dtype=torch.float64))
    for look in range(3):
        said = observer.weigh(looks[look : look + 1], FIXATIONS[look : look + 1], GRID)
        belief = observer.update(belief, said)
    return belief


def believe_by_loop(looks, *, tempering=1.0, footprint="overlap", memory="all", missed=None, rule="kaplan"):
    """Belief after the three looks, cell by cell in scalars."""
    fuse = fusion.RULES[rule]
    beta = torch.full((20, 4), 0.5, dtype=torch.float64)
    for cell in range(20):
        order = range(3)
        offset = torch.linalg.vector_norm(GRID.centres[cell] - FIXATIONS, dim=-1) / 100
        if memory == "closest":
            order = [int(offset.argmin())]
        for look in order:
            covered = False
            for detection in looks.mask[look].nonzero()[:, 0].tolist():
                weight = float(GRID.footprint(looks.boxes[look, detection][None], footprint)[0, cell])
                if weight > 0:
                    covered = True
                    likelihood = looks.scores[look, detection].double() ** (tempering * weight)
                    beta[cell] = fuse(beta[cell], likelihood)
            if missed is not None and not covered:
                beta[cell] = fuse(beta[cell], missed.miss_likelihood(offset[look]).double())
    return beta


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"tempering": 0.25},
        {"footprint": "soft"},
        {"footprint": "centre"},
        {"memory": "closest"},
        {"misses": MISSES},
        {"fusion": "product"},
        {"fusion": "sum"},
        {"fusion": "sum", "misses": MISSES},
    ],
    ids=["published", "tempered", "soft", "centre", "closest", "misses", "product", "sum", "sum and misses"],
)
def test_belief_equals_the_loop(looks, options):
    belief = watch(Semantic(4, **options), looks)
    names = {"misses": "missed", "fusion": "rule"}
    loop_options = {names.get(name, name): value for name, value in options.items()}
    torch.testing.assert_close(belief.beta[0], believe_by_loop(looks, **loop_options), rtol=1e-5, atol=1e-6)
    offset = torch.cdist(GRID.centres, FIXATIONS) / 100
    torch.testing.assert_close(belief.closest[0].float(), offset.amin(1))


def test_repeating_a_look_does_not_change_a_memory_of_the_closest_look(looks):
    observer = Semantic(4, memory="closest")
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    once = observer.update(observer.start(1, GRID, torch.empty(0)), look)
    assert torch.equal(observer.update(once, look).beta, once.beta)


def test_models_are_submodules_of_the_observer():
    """The parameters of a fitted model are listed once, even if it is used twice; other objects are kept."""
    model = FovealObservationModel.identity(["a", "b"], [0.2], miss_rate=torch.full((3, 2), 0.5))
    observer = Semantic(3, model, misses=model)
    assert set(map(id, observer.parameters())) == set(map(id, model.parameters()))
    assert {name.removeprefix("observation.") for name in observer.state_dict()} >= set(model.state_dict())
    observer.double()
    assert model.edges.dtype == torch.float64
    assert Semantic(4, misses=MISSES).misses is MISSES
    assert not Semantic(4, misses=MISSES).state_dict()


@pytest.mark.parametrize("footprint", ["overlap", "soft"])
def test_looks_with_different_numbers_of_detections_can_be_joined(looks, footprint):
    observer = Semantic(4, footprint=footprint, misses=MISSES)
    few = Detections(looks.boxes[1:2, :2], looks.scores[1:2, :2], looks.mask[1:2, :2])
    many = Detections(looks.boxes.flatten(0, 1)[None], looks.scores.flatten(0, 1)[None], looks.mask.flatten()[None])
    parts = [
        observer.weigh(few, FIXATIONS[1:2], GRID),
        observer.weigh(many, FIXATIONS[2:], GRID),
        observer.weigh(Detections.empty(1, 3), FIXATIONS[:1], GRID),
    ]
    start = observer.start(3, GRID, looks.scores)
    together = observer.update(start, SemanticLook.join(parts))
    for row, part in enumerate(parts):
        alone = observer.update(start[row : row + 1], part)
        assert torch.equal(together.beta[row], alone.beta[0])
        assert torch.equal(together.closest[row], alone.closest[0])


def test_a_belief_keeps_its_dtype_and_a_look_has_that_of_the_scores(looks, dtype):
    observer = Semantic(4, misses=MISSES)
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    for given in (torch.float32, torch.float64):
        said = SemanticLook(look.likelihood.to(given), look.footprint, look.distance.to(given))
        for other in (torch.float32, torch.float64):
            start = observer.start(1, GRID, torch.empty(0, dtype=other))
            assert observer.update(start, said).beta.dtype == other
    seen = Detections(looks.boxes, looks.scores.to(dtype), looks.mask)
    for fixations in (FIXATIONS, FIXATIONS.double()):
        look = Semantic(4).weigh(seen, fixations, GRID)
        assert look.likelihood.dtype == look.distance.dtype == dtype


WEIGHTS = {1: 1.0, 3: 0.4}


@pytest.fixture(params=["evidence", "map"])
def inner(request):
    torch.manual_seed(3)
    if request.param == "map":
        return Semantic(4, tempering=0.25)
    model = TargetEvidence(8, 6, components=4, thresholds=Thresholds(0.8, 0.1))
    return Target(model.eval().requires_grad_(False))


def believed(observer, looks, target):
    belief = observer.start(1, GRID, looks.scores)
    for look in range(3):
        part = slice(look, look + 1)
        belief = observer(belief, looks[part], FIXATIONS[part], GRID, target)
    return belief


def test_the_belief_in_any_of_classes_is_made_of_those_of_the_inner_observer(inner, looks):
    alone, single = believed(inner, looks, 2), believed(AnyOf(inner, {2: 1.0, 1: 0.0}), looks, None)
    torch.testing.assert_close(single.probability(2), alone.probability(2))
    torch.testing.assert_close(single.presence(2), alone.presence(2))
    torch.testing.assert_close(single.closest, alone.closest)
    assert class_meant(single, 1) == 2
    assert AnyOf(inner, {2: 1.0}).thresholds == inner.thresholds
    peaks = {index: float(believed(inner, looks, index).probability(index).max()) for index in (1, 2, 3)}
    for low in (1.0, 0.01):
        weights = {1: low, 2: 1.0, 3: low}
        best = max(weights, key=lambda index: weights[index] * peaks[index])
        assert class_meant(believed(AnyOf(inner, weights), looks, None), 1) == best
    several = believed(AnyOf(inner, WEIGHTS), looks, None)
    for what in ("probability", "chance", "presence"):
        missing = 1.0
        for index, weight in WEIGHTS.items():
            missing = missing * (1 - weight * getattr(believed(inner, looks, index), what)(index))
        for asked in (1, 2, 3):
            torch.testing.assert_close(getattr(several, what)(asked), 1 - missing)


def test_belief_fades_like_that_of_the_inner_observer(inner, looks):
    observer = AnyOf(inner, WEIGHTS)
    visited = torch.arange(20)[None] % 3 == 0
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    faded = observer.update(observer.fade(believed(observer, looks, None), look, 0.5, visited), look)
    missing = 1.0
    for index, weight in WEIGHTS.items():
        part = inner.weigh(looks[:1], FIXATIONS[:1], GRID, index)
        one = inner.update(inner.fade(believed(inner, looks, index), part, 0.5, visited), part)
        missing = missing * (1 - weight * one.chance(index))
    torch.testing.assert_close(faded.chance(1), 1 - missing)


def test_a_look_is_weighed_once_for_each_class_or_once_for_all(inner, looks):
    """Once for all if the evidence does not depend on the target; classes without weight are left out."""
    observer = AnyOf(inner, {1: 1.0, 2: 0.0, 3: 0.4})
    once = 2 if inner.by_target else 1
    assert len(observer.weigh(looks, FIXATIONS, GRID).inner) == len(observer.start(1, GRID, looks.scores).inner) == once
    assert observer.weights == {1: 1.0, 3: 0.4}


def test_bad_input(inner, looks):
    for weights in ({}, {1: 0.0}, {1: 1.5}, {1: -0.1, 2: 1.0}):
        refused("weights", AnyOf, inner, weights)
    classes, strategy = ("background", "cup", "wine glass"), Strategy(Semantic(3), Policy("non-predictive"))
    assert strategy.sought({"Cups": 1, 2: 0.5}, classes)[2] == {1: 1, 2: 0.5}
    for target, message in (
        ({}, "several"),
        ({"cup": 1, 1: 1}, "twice"),
        ({"cat": 1}, "unknown class"),
        ({99: 1.0}, "^target:"),
    ):
        refused(message, strategy.sought, target, classes)
    for options in [{"memory": "best"}, {"fusion": "max"}, {"prior": 0}]:
        refused(".", Semantic, 3, **options)
    refused("tempering", likelihoods, looks, FIXATIONS, GRID, tempering=0)
    refused("tempering", Semantic(4, tempering=0).weigh, looks, FIXATIONS, GRID)


LEARNED = Grid(6, 4, (90, 60))
FIXATED = [0, 9, 20, 5]
SEEN_FROM = LEARNED.centres[FIXATED]
CLASSES = torch.arange(1, 5)


def believe(observer, looks, order, grid=LEARNED, fixations=SEEN_FROM):
    """Belief of one episode after looks in the given order."""
    belief = observer.start(1, grid, looks.scores)
    for look in order:
        part = slice(look, look + 1)
        belief = observer(belief, looks[part], fixations[part].to(looks.scores), grid)
    return belief


def gather_in_numpy(model, looks, order, stands_for=None):
    """The same in numpy: the gathered evidence, and the probabilities computed from it."""
    fixations, cells = SEEN_FROM.to(looks.scores), 24
    features = class_features(looks, fixations, LEARNED, CLASSES)
    said = reference.run_network(model.look, reference.array(features))
    shown = reference.array(highest_score(looks, CLASSES))
    nearest, best, total = np.zeros((4, cells)), np.full((4, cells), -np.inf), np.zeros((4, cells))
    closest, weight, score, visited = np.full(cells, np.inf), np.zeros(cells), np.zeros(4), [False] * cells
    for look in order:
        for cell in range(cells):
            distance = (
                float(np.hypot(*(reference.array(LEARNED.centres)[cell] - reference.array(fixations)[look]))) / 90
            )
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
        look = observer.weigh(looks[:1], SEEN_FROM[:1].double(), LEARNED)
        look = replace(look, stands_for=torch.tensor([stands_for]))
        belief = observer.update(observer.start(1, LEARNED, looks.scores), look)
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
    refused("target", belief.probability, 5)


def sequence(looks):
    """Three looks of each of four episodes."""
    for order in ([0, 1, 2, 3], [1, 2, 3, 0], [3, 3, 0, 2]):
        index = torch.tensor(order)
        yield looks[index], SEEN_FROM[index]


def test_gradients_reach_every_parameter(random_looks, toy_map):
    model = toy_map().double()
    looks = random_looks(dtype=torch.float64)
    belief = LearnedMap(model, together=True).start(4, LEARNED, looks.scores)
    for seen, fixation in sequence(looks):
        belief = LearnedMap(model, together=True)(belief, seen, fixation.double(), LEARNED)
    gain = model.gain(belief.probabilities, belief.closest, belief.looks, LEARNED.cell_distance.double())
    (belief.probabilities.sum() + gain.sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert bool(parameter.grad.isfinite().all()), name
        assert float(parameter.grad.abs().sum()) > 0, name
    # In the prior only the classes have gradients: background has none.
    assert model.prior.grad.nonzero()[:, 0].tolist() == [1, 2, 3, 4]


def test_policies_that_need_a_dirichlet_belief_refuse_the_map(toy_map, random_looks):
    observer = LearnedMap(toy_map())
    belief = observer.start(4, LEARNED, random_looks().scores)
    observation = FovealObservationModel.identity(["a", "b", "c", "d"], [0.2])
    with pytest.raises(InputError, match="belief: expected a belief about all classes \\(DirichletBelief\\)"):
        KLDivergence(observation, LEARNED)(belief, torch.zeros(4, 24, dtype=torch.bool))
    assert observer.thresholds is None
    assert not observer.by_target
