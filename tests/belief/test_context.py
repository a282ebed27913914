"""Context: places and co-occurrence against loops over cells, and its effect on other observers."""

import math

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief import ContextPrior, TargetEvidence
from semfov.belief.context import presence_of, reaches
from semfov.belief.observers import Context, Semantic, Target
from semfov.belief.observers.context import log_odds
from semfov.belief.target_evidence import Thresholds
from semfov.errors import InputError

GRID = Grid(5, 4, (100, 60))
EDGES = [0.0, 0.2, 0.45]
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def presence(request):
    generator = torch.Generator().manual_seed(0)
    sparse = torch.rand(2, 20, 4, generator=generator, dtype=request.param)
    return sparse * (torch.rand(2, 20, 4, generator=generator) < 0.2)


@pytest.fixture
def prior():
    generator = torch.Generator().manual_seed(1)
    place, pairs = torch.randn(4, 4, 4, generator=generator), torch.randn(4, 4, 4, generator=generator)
    pairs.diagonal().zero_()
    weights = {"evidence": (0.5, 0.25), "map": (1.0, 2.0)}
    return ContextPrior(["cup", "cat", "car"], place, pairs, EDGES, weights=weights, metadata={"data": "toy"})


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, most=4, components=4)


def highest_presence_within(presence, cell, edge):
    """Highest presence of each class within a distance of a cell, `(K+1,)`."""
    offset = (GRID.centres - GRID.centres[cell]).abs().amax(-1) / 100
    return presence[offset <= edge + 1e-6].amax(0)


def test_cooccurrence_equals_the_loop(prior, presence):
    got = prior(presence, GRID, torch.tensor([1, 3]), (0.0, 1.0))
    assert got.dtype == presence.dtype
    for row, target in enumerate([1, 3]):
        for cell in range(20):
            expected, nearer = 0.0, torch.zeros_like(presence[row, cell])
            for band, edge in enumerate([*EDGES, math.inf]):
                within = highest_presence_within(presence[row], cell, edge)
                expected += float((within - nearer) @ prior.cooccurrence[target, :, band].to(within))
                nearer = within
            assert float(got[row, cell]) == pytest.approx(expected, abs=1e-5)


def test_place_maps_are_interpolated_at_the_centres_of_cells(prior):
    same = prior.place_at(Grid(4, 4, (30, 20)))
    torch.testing.assert_close(same, prior.place.flatten(1))
    grid = Grid(3, 7, (30, 20))
    got = prior.place_at(grid)
    for cell in range(21):
        # Centre of the cell in coordinates of the map, whose first centre is at 0, clamped to the outermost centres.
        x = min(max((cell % 3 + 0.5) / 3 * 4 - 0.5, 0), 3)
        y = min(max((cell // 3 + 0.5) / 7 * 4 - 0.5, 0), 3)
        left, top = min(int(x), 2), min(int(y), 2)
        u, v = x - left, y - top
        corner = prior.place[:, top : top + 2, left : left + 2]
        expected = (
            corner[:, 0, 0] * (1 - u) * (1 - v)
            + corner[:, 0, 1] * u * (1 - v)
            + corner[:, 1, 0] * (1 - u) * v
            + corner[:, 1, 1] * u * v
        )
        torch.testing.assert_close(got[:, cell], expected)


def test_weights_scale_place_and_cooccurrence(prior, presence):
    place, cooccurrence = (prior(presence, GRID, 2, weights) for weights in ((1.0, 0.0), (0.0, 1.0)))
    torch.testing.assert_close(prior(presence, GRID, 2, (0.3, 0.7)), 0.3 * place + 0.7 * cooccurrence)
    torch.testing.assert_close(place[0].float(), prior.place_at(GRID)[2])
    assert place.dtype == cooccurrence.dtype == prior.double()(presence, GRID, 2).dtype == presence.dtype
    assert torch.equal(prior(presence, GRID, 2, (0.0, 0.0)), torch.zeros_like(place))


def test_presence_equals_a_loop(looks):
    got = presence_of(looks, GRID)
    expected = torch.zeros(3, 20, 4)
    for look, detection in looks.mask.nonzero().tolist():
        for cell in GRID.footprint(looks.boxes[look, detection][None])[0].nonzero()[:, 0].tolist():
            expected[look, cell] = torch.maximum(expected[look, cell], looks.scores[look, detection])
    assert torch.equal(got, expected)
    assert torch.equal(presence_of(Detections.empty(2, 3), GRID), torch.zeros(2, 20, 4))


def observers():
    torch.manual_seed(3)
    evidence = Target(TargetEvidence(8, 6, thresholds=Thresholds(0.8, 0.1)).eval().requires_grad_(False))
    return [evidence, Semantic(4, tempering=0.25, footprint="box_centre")]


@pytest.mark.parametrize("kind", [0, 1], ids=["evidence", "map"])
def test_observer_adds_context_to_the_log_odds(prior, looks, kind):
    inner = observers()[kind]
    observer = Context(inner, prior)
    assert observer.weights == ((0.5, 0.25), (1.0, 2.0))[kind]
    belief, plain = observer.start(1, GRID, looks.scores), inner.start(1, GRID, looks.scores)
    for look in range(3):
        part = slice(look, look + 1)
        belief = observer.update(belief, observer.weigh(looks[part], FIXATIONS[part], GRID, 2))
        plain = inner.update(plain, inner.weigh(looks[part], FIXATIONS[part], GRID, 2))
    present = plain.probability(2)
    context = prior(presence_of(looks, GRID).amax(0, keepdim=True), GRID, 2, observer.weights)
    expected = (present.log() - torch.log1p(-present) + context).sigmoid()
    torch.testing.assert_close(belief.probability(2), expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(belief.closest, plain.closest)
    # The same holds for where to look next; the presence of the target is that of the inner observer.
    chance = plain.chance(2)
    expected = (chance.log() - torch.log1p(-chance) + context).sigmoid()
    torch.testing.assert_close(belief.chance(2), expected, rtol=1e-4, atol=1e-6)
    assert torch.equal(belief.presence(2), plain.presence(2))
    assert torch.equal(belief.chance(2), belief.probability(2)) == (kind == 1)
    assert observer.thresholds == inner.thresholds


@pytest.mark.parametrize("kind", [0, 1], ids=["evidence", "map"])
def test_belief_before_the_first_look_has_even_odds_and_shows_nothing(prior, kind):
    belief = Context(observers()[kind], prior).start(2, GRID, torch.empty(0, dtype=torch.float64))
    even = torch.full((2, 20), 0.5, dtype=torch.float64)
    assert torch.equal(belief.probability(1), even)
    assert torch.equal(belief.chance(1), even)
    assert torch.equal(belief.scores, torch.zeros(2, 20, 4, dtype=torch.float64))


def test_log_odds_of_certain_cells_are_finite():
    got = log_odds(torch.tensor([0.0, 0.2, 0.5, 1.0], dtype=torch.float64))
    assert got.tolist() == pytest.approx([math.log(1e-6), math.log(0.25), 0, -math.log(1e-6)], rel=1e-6)


def test_bad_input(prior, looks):
    nothing = torch.zeros(1, 20, 4)
    with pytest.raises(InputError, match="target"):
        prior(nothing, GRID, 4)
    for presence in (nothing[:, :5], nothing[..., :3], nothing[0]):
        with pytest.raises(InputError, match=r"^presence:"):
            prior(presence, GRID, 1)
    with pytest.raises(InputError, match="size of one image"):
        prior(nothing, Grid(5, 4, torch.tensor([[100.0, 60.0]])), 1)
    with pytest.raises(InputError, match="target"):
        Context(observers()[0], prior).weigh(looks, FIXATIONS, GRID)
    with pytest.raises(InputError, match="evidence"):
        prior.weights_for("evidnce")
    with pytest.raises(InputError, match="class 2"):
        prior.check_compatible(["cup", "dog", "car"])
    with pytest.raises(InputError, match="edges"):
        ContextPrior(["cup"], torch.zeros(2, 3, 3), torch.zeros(2, 2, 3), [0.3, 0.1])


@pytest.mark.parametrize("size", [(60, 100), (100, 60)], ids=["tall", "wide"])
def test_distances_between_cells_are_in_units_of_the_longer_side(presence, size):
    """Cell by cell, in a tall and in a wide picture."""
    grid = Grid(4, 5, size)
    edges = [*EDGES, 0.9]
    for edge, got in zip(edges, reaches(presence, grid, edges), strict=False):
        for cell in range(20):
            offset = (grid.centres - grid.centres[cell]).abs().amax(-1) / 100
            near = presence[:, offset <= edge + 1e-6].amax(1)
            assert torch.equal(got[:, cell], near)


def test_tables_must_be_square(prior):
    for place in (torch.zeros(4, 2, 3), torch.zeros(3, 2, 2), torch.zeros(2, 2), torch.zeros(4)):
        with pytest.raises(InputError, match=r"^place:"):
            ContextPrior(prior.classes, place, prior.cooccurrence, EDGES)
    for pairs in (torch.zeros(4, 3, 4), torch.zeros(3, 4, 4), torch.zeros(4, 4, 3)):
        with pytest.raises(InputError, match=r"^cooccurrence:"):
            ContextPrior(prior.classes, prior.place, pairs, EDGES)
