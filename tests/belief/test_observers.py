"""Observers: beliefs from detections against loops and numpy, and searches for any of several classes."""

import pytest
import torch

from semfov import Detections, FovealObservationModel, Grid
from semfov.belief import fusion, likelihoods
from semfov.belief.observers import AnyOf, Semantic, SemanticSearch
from semfov.belief.observers.any_of import class_meant
from semfov.belief.observers.semantic import SemanticEvidence
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.strategy import Strategy
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
    together = observer.update(start, SemanticEvidence.join(parts))
    for row, part in enumerate(parts):
        alone = observer.update(start[row : row + 1], part)
        assert torch.equal(together.beta[row], alone.beta[0])
        assert torch.equal(together.closest[row], alone.closest[0])


def test_a_belief_keeps_its_dtype_and_a_look_has_that_of_the_scores(looks, dtype):
    observer = Semantic(4, misses=MISSES)
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    for given in (torch.float32, torch.float64):
        said = SemanticEvidence(look.likelihood.to(given), look.footprint, look.distance.to(given))
        for other in (torch.float32, torch.float64):
            start = observer.start(1, GRID, torch.empty(0, dtype=other))
            assert observer.update(start, said).beta.dtype == other
    seen = Detections(looks.boxes, looks.scores.to(dtype), looks.mask)
    for fixations in (FIXATIONS, FIXATIONS.double()):
        look = Semantic(4).weigh(seen, fixations, GRID)
        assert look.likelihood.dtype == look.distance.dtype == dtype


WEIGHTS = {1: 1.0, 3: 0.4}


class ByTarget(Semantic):
    """An observer that weighs looks for one target."""

    by_target = True


@pytest.fixture(params=["search", "map", "by target"])
def inner(request):
    if request.param == "map":
        return Semantic(4, tempering=0.25)
    if request.param == "by target":
        return ByTarget(4, tempering=0.25)
    odds = 0.1 + 0.4 * torch.rand(4, 2, generator=torch.Generator().manual_seed(3))
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5), Thresholds(0.8, 0.1))
    model = FovealObservationModel.identity(
        ["cup", "cat", "dog"], [0.3], miss_odds=odds, refutation=0.6, presence=presence
    )
    return SemanticSearch(model.eval().requires_grad_(False))


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


def test_an_observer_is_called_with_a_look_of_each_episode(looks):
    observer = Semantic(4)
    belief = observer.start(2, GRID, looks.scores)
    refused("^belief: .*got a Tensor", observer, looks.scores, looks, FIXATIONS, GRID)
    refused(
        r"^detections: .*got a Tensor; .*semfov\.Detections\(boxes, scores\)",
        observer,
        belief,
        looks.scores,
        FIXATIONS,
        GRID,
    )
    refused("^grid: .*got a tuple", observer, belief, looks, FIXATIONS, (4, 3))
    refused("^fixation: expected a tensor", observer, belief, looks, (3.0, 4.0), GRID)
    refused("^fixation: expected one for each of 2 looks, got 1", observer, belief, looks[:2], FIXATIONS[:1], GRID)
    refused(
        "^detections: expected a look for each of 3 episodes, got 2",
        observer,
        observer.start(3, GRID, looks.scores),
        looks[:2],
        FIXATIONS[:2],
        GRID,
    )
    refused(
        "^detections: expected a look for each of 2 episodes, got 1", observer, belief, looks[:1], FIXATIONS[:1], GRID
    )
