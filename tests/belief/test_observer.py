"""Observers beyond the published one, against loops over cells."""

import pytest
import torch

from semfov import Detections, Grid, SemanticMap
from semfov.belief import SemanticObserver, fusion, weigh
from semfov.errors import InputError

GRID = Grid(5, 4, (100, 80))
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]


@pytest.fixture
def looks():
    """Three looks with a few random detections each."""
    torch.manual_seed(0)
    corner = torch.rand(3, 4, 2) * 60
    boxes = torch.cat([corner, corner + 5 + torch.rand(3, 4, 2) * 30], -1)
    mask = torch.tensor([[True, True, True, False], [True, True, False, False], [True, True, True, True]])
    return Detections(boxes, torch.rand(3, 4, 4).softmax(-1), mask)


def misses(distance):
    """Background is missed always, class 3 never."""
    return torch.stack([torch.ones_like(distance), 0.2 + distance, distance.clamp(max=1), 0 * distance], -1)


def watch(observer, looks):
    belief = observer.start(1, GRID, torch.empty(0, dtype=torch.float64))
    for look in range(3):
        evidence = observer.weigh(looks[look : look + 1], FIXATIONS[look : look + 1], GRID)
        belief = observer.update(belief, evidence)
    return belief


def loop(looks, *, tempering=1.0, footprint="overlap", memory="all", missed=None):
    """The same in scalars."""
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
                    beta[cell] = fusion.kaplan(beta[cell], likelihood)
            if missed is not None and not covered:
                beta[cell] = fusion.kaplan(beta[cell], missed(offset[look]).double())
    return beta


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"tempering": 0.25},
        {"footprint": "soft"},
        {"footprint": "centre"},
        {"memory": "closest"},
        {"misses": misses},
    ],
    ids=["published", "tempered", "soft", "centre", "closest", "misses"],
)
def test_belief_equals_the_loop(looks, options):
    belief = watch(SemanticObserver(4, **options), looks)
    told = {("missed" if name == "misses" else name): value for name, value in options.items()}
    torch.testing.assert_close(belief.beta[0], loop(looks, **told), rtol=1e-5, atol=1e-6)
    offset = torch.cdist(GRID.centres, FIXATIONS) / 100
    torch.testing.assert_close(belief.closest[0].float(), offset.amin(1))


def test_the_same_look_twice_teaches_a_closest_memory_nothing(looks):
    observer = SemanticObserver(4, memory="closest")
    evidence = observer.weigh(looks[:1], FIXATIONS[:1], GRID)
    once = observer.update(observer.start(1, GRID, torch.empty(0)), evidence)
    assert torch.equal(observer.update(once, evidence).beta, once.beta)


def test_misses_move_clear_cells_towards_background():
    nothing = Detections.empty(1, 3)
    observer = SemanticObserver(4, misses=misses)
    evidence = observer.weigh(nothing, FIXATIONS[:1], GRID)
    after = observer.update(observer.start(1, GRID, torch.empty(0)), evidence).beta
    background = after[0, :, 0] / after[0].sum(-1)
    assert background.argmax() == 0
    assert (background > 0.25).all()


def test_map_takes_the_same_options(looks):
    own = SemanticMap(GRID, ["a", "b", "c"], tempering=0.5, memory="closest", footprint="soft").double()
    for look in range(3):
        own.update(looks[look : look + 1], FIXATIONS[look : look + 1])
    observer = SemanticObserver(4, tempering=0.5, memory="closest", footprint="soft")
    torch.testing.assert_close(own.beta, watch(observer, looks).beta)


@pytest.mark.parametrize("options", [{"memory": "best"}, {"fusion": "max"}, {"prior": 0}])
def test_bad_settings(options):
    with pytest.raises(InputError):
        SemanticObserver(3, **options)


def test_tempering_is_positive(looks):
    with pytest.raises(InputError, match="tempering"):
        weigh(looks, FIXATIONS, GRID, tempering=0)
