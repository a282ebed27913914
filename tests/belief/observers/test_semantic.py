"""The observer of all classes, with its options beyond the published method, against loops over cells."""

import pytest
import torch

from semfov import Detections, FovealObservationModel, Grid
from semfov.belief import fusion, likelihoods
from semfov.belief.observers import Semantic
from semfov.belief.observers.semantic import SemanticLook
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


def test_invalid_settings_are_refused(looks):
    for options in [{"memory": "best"}, {"fusion": "max"}, {"prior": 0}]:
        refused(".", Semantic, 3, **options)
    refused("tempering", likelihoods, looks, FIXATIONS, GRID, tempering=0)
    refused("tempering", Semantic(4, tempering=0).weigh, looks, FIXATIONS, GRID)


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


def test_a_belief_keeps_its_dtype_whatever_the_dtype_of_the_look(looks):
    observer = Semantic(4, misses=MISSES)
    look = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    for dtype in (torch.float32, torch.float64):
        said = SemanticLook(look.likelihood.to(dtype), look.footprint, look.distance.to(dtype))
        for other in (torch.float32, torch.float64):
            start = observer.start(1, GRID, torch.empty(0, dtype=other))
            assert observer.update(start, said).beta.dtype == other


def test_a_look_has_the_dtype_of_the_scores(looks, dtype):
    seen = Detections(looks.boxes, looks.scores.to(dtype), looks.mask)
    for fixations in (FIXATIONS, FIXATIONS.double()):
        look = Semantic(4).weigh(seen, fixations, GRID)
        assert look.likelihood.dtype == look.distance.dtype == dtype
