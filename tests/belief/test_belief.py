"""Beliefs of every kind of observer: batches, indexing, mapping and fading, and looks that are joined."""

import re

import numpy as np
import pytest
import torch

from semfov import Detections, DirichletBelief, FovealObservationModel, Grid, InputError
from semfov.belief.belief import Belief, dirichlet_belief
from semfov.belief.observers import AnyOf, Semantic, SemanticMap, SemanticSearch
from tests import small
from tests.refusals import refused

GRID = Grid(4, 3, (80, 60))


def rand(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)), dtype=torch.float64) + 0.1


FIXATIONS = GRID.centres[[0, 7]].double()


def looks():
    """Two looks with one detection each."""
    boxes = torch.tensor([[[5.0, 5, 30, 30]], [[40, 20, 75, 50]]]).double()
    return Detections(boxes, rand(2, 1, 4).softmax(-1), torch.ones(2, 1, dtype=torch.bool))


def seen(observer):
    """A batch of two beliefs after one look each."""
    said = observer.weigh(looks(), FIXATIONS, GRID, 2)
    return observer.update(observer.start(2, GRID, looks().scores), said)


def tensors_of(belief):
    """All tensors of a belief, those of nested beliefs included."""
    found = []
    for name in belief.__dataclass_fields__:
        part = getattr(belief, name)
        for each in part if isinstance(part, tuple) else (part,):
            if isinstance(each, torch.Tensor):
                found.append(each)
            elif isinstance(each, Belief):
                found += tensors_of(each)
    return found


def equal(one, other):
    return all(torch.equal(mine, theirs) for mine, theirs in zip(tensors_of(one), tensors_of(other), strict=True))


def search_observer():
    return SemanticSearch(small.search_model().double().requires_grad_(False))


class ByTarget(Semantic):
    """An observer that weighs looks for one target."""

    by_target = True


def map_observer():
    return SemanticMap(small.model().double().requires_grad_(False))


OBSERVERS = {
    "all classes": lambda: Semantic(4),
    "soft": lambda: Semantic(4, footprint="soft"),
    "misses": lambda: Semantic(4, misses=small.model().double().requires_grad_(False), memory="closest"),
    "search": search_observer,
    "map": map_observer,
    "any of a search": lambda: AnyOf(search_observer(), {1: 0.3, 2: 1.0}),
    "any of targets": lambda: AnyOf(ByTarget(4), {1: 0.3, 2: 1.0}),
    "any of a map": lambda: AnyOf(map_observer(), {1: 0.3, 2: 1.0}),
}
TARGETS = (1, 2, 3, 1)
CELLS = torch.tensor([0, 9, 5, 7])


@pytest.fixture
def four(random_looks):
    """Four looks with up to five detections and padding, from four cells; the third has no detections."""
    return random_looks(GRID, components=4, dtype=torch.float64), GRID.centres[CELLS].double()


def looked(observer, four, rows, target):
    """Looks of some of the four episodes, weighed for one target."""
    seen, fixations = four
    return observer.weigh(seen[rows], fixations[rows], GRID, target)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("kind", OBSERVERS)
def test_episodes_and_looks_of_a_batch_equal_each_of_them_alone(kind, four):
    """Bit for bit, after two looks of each, for targets of their own."""
    observer = OBSERVERS[kind]()

    def watched(rows):
        belief = observer.start(len(rows), GRID, four[0].scores)
        for turn in (0, 1):
            each = [looked(observer, four, torch.tensor([(row + turn) % 4]), TARGETS[row]) for row in rows]
            belief = observer.update(belief, type(each[0]).join(each))
        return belief

    batch = watched(range(4))
    for row in range(4):
        assert equal(batch[row : row + 1], watched([row]))
    observer = OBSERVERS[kind]()
    together = looked(observer, four, slice(None), 2)
    alone = [looked(observer, four, slice(row, row + 1), 2) for row in range(4)]
    start = observer.start(4, GRID, four[0].scores)
    belief = observer.update(start, together)
    assert equal(observer.update(start, type(together).join(alone)), belief)
    for row in range(4):
        for look in (alone[row], together[row : row + 1], together[torch.tensor([row])]):
            assert equal(observer.update(start[row : row + 1], look), belief[row : row + 1])
    index = torch.tensor([2, 0])
    assert equal(observer.update(belief[index], together[index]), observer.update(belief, together)[index])


@pytest.mark.parametrize("kind", OBSERVERS)
def test_padding_does_not_change_the_belief(kind, four):
    seen, fixations = four
    observer, wider = (
        OBSERVERS[kind](),
        Detections(
            torch.cat([seen.boxes, torch.full((4, 2, 4), 30.0)], 1),
            torch.cat([seen.scores, torch.full((4, 2, 4), 0.9)], 1),
            torch.cat([seen.mask, torch.zeros(4, 2, dtype=torch.bool)], 1),
        ),
    )
    start = observer.start(4, GRID, seen.scores)
    belief = observer(start, seen, fixations, GRID, 2)
    assert equal(observer(start, wider, fixations, GRID, 2), belief)
    nothing = Detections.empty(1, 3, like=seen.boxes)
    assert equal(observer(start[:1], nothing, fixations[2:3], GRID, 2), belief[2:3])


@pytest.mark.parametrize(
    ("grid", "dtype"),
    [
        (Grid(1, 5, (60, 90)), torch.float64),
        (Grid(5, 1, (90, 60)), torch.float64),
        (Grid(1, 1, (10, 10)), torch.float32),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", OBSERVERS)
def test_looks_without_detections_on_grids_of_one_row_or_column(kind, grid, dtype, device):
    observer = OBSERVERS[kind]().to(device, dtype)
    nothing = Detections.empty(2, 3, like=torch.empty(0, dtype=dtype, device=device))
    belief = observer.start(2, grid, nothing.scores)
    for cell in (0, len(grid) - 1):
        belief = observer(belief, nothing, grid.centres[[cell, cell]].to(nothing.boxes), grid, 2)
    present = belief.probability(2)
    assert (present.shape, present.dtype, present.device.type) == ((2, len(grid)), dtype, device.type)
    assert bool(((present >= 0) & (present < 1)).all())


@pytest.mark.parametrize("kind", OBSERVERS)
def test_before_the_first_look_all_cells_are_alike_and_infinitely_far(kind):
    belief = OBSERVERS[kind]().start(2, GRID, torch.empty(0, dtype=torch.float64))
    present = belief.probability(2)
    assert torch.equal(present, present[:1, :1].expand(2, 12))
    assert torch.equal(belief.chance(2), present)
    assert present.dtype == belief.closest.dtype == torch.float64
    assert bool(belief.closest.isposinf().all())


def test_probability_of_a_target_equals_a_loop():
    beta, targets = rand(3, 12, 5), torch.tensor([1, 4, 2])
    belief = DirichletBelief(beta)
    for batch, target in enumerate(targets.tolist()):
        for cell in range(12):
            expected = beta[batch, cell, target] / sum(beta[batch, cell])
            torch.testing.assert_close(belief.probability(targets)[batch, cell], expected)
            torch.testing.assert_close(belief.probability(target)[batch, cell], expected)
    torch.testing.assert_close(belief.probabilities.sum(-1), torch.ones(3, 12, dtype=torch.float64))
    torch.testing.assert_close(belief.probabilities[..., 2], belief.probability(2))


@pytest.mark.parametrize("kind", OBSERVERS)
def test_map_is_applied_to_every_tensor_of_every_kind_and_a_detached_belief_has_no_gradients(kind):
    belief = seen(OBSERVERS[kind]())
    met = []

    def note(tensor):
        met.append(tensor)
        return tensor.clone()

    other = belief.map(note)
    assert type(other) is type(belief)
    assert sorted(map(id, met)) == sorted(map(id, tensors_of(belief)))
    for before, after in zip(tensors_of(belief), tensors_of(other), strict=True):
        assert after is not before
        assert torch.equal(after, before)
    observer = OBSERVERS[kind]()
    boxes, mask = looks().boxes, looks().mask
    scores = looks().scores.requires_grad_()
    said = observer.weigh(Detections(boxes, scores, mask), FIXATIONS, GRID, 2)
    belief = observer.update(observer.start(2, GRID, boxes), said)
    assert belief.probability(2).requires_grad
    apart = belief.detach()
    assert not any(tensor.requires_grad for tensor in tensors_of(apart))
    assert not any(number.requires_grad for number in (apart.probability(2), apart.presence(2), apart.chance(2)))
    assert torch.equal(apart.presence(2), belief.presence(2))
    assert torch.equal(apart.probability(2), belief.probability(2))


def test_a_detached_belief_of_a_model_that_learns_is_constant_until_the_next_look():
    """Also where it says whether the target is there, by numbers of the model; what is seen later teaches these."""
    model = small.search_model().double()
    for observer in (SemanticSearch(model), AnyOf(SemanticSearch(model), {1: 0.3, 2: 1.0})):
        belief = seen(observer)
        assert belief.presence(2).requires_grad
        apart = belief.detach()
        assert torch.equal(apart.presence(2), belief.presence(2))
        for values in (apart.presence(2), apart.probability(2), apart.chance(2)):
            assert not values.requires_grad
        after = observer.update(apart, observer.weigh(looks(), FIXATIONS, GRID, 2))
        (slope,) = torch.autograd.grad(after.presence(2).sum(), model.presence.offset)
        assert float(slope) > 0


@pytest.mark.parametrize("kind", OBSERVERS)
def test_calling_an_observer_equals_weigh_and_update_which_refuses_those_of_another_kind(kind):
    observer = OBSERVERS[kind]()
    called = observer(observer.start(2, GRID, looks().scores), looks(), FIXATIONS, GRID, 2)
    for one, other in zip(tensors_of(called), tensors_of(seen(observer)), strict=True):
        assert torch.equal(one, other)
    observer = OBSERVERS[kind]()
    own, said = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    for other in (make() for make in OBSERVERS.values()):
        if not isinstance(other, type(observer)):
            if not isinstance(seen(other), type(own)):
                refused("belief: expected ", observer.update, seen(other), said)
            with pytest.raises(InputError, match=f"look: expected {type(said).__name__}"):
                observer.update(own, other.weigh(looks(), FIXATIONS, GRID, 2))


@pytest.mark.parametrize("kind", ["any of targets"])
def test_beliefs_and_looks_of_another_observer_do_not_fade(kind):
    observer, visited = OBSERVERS[kind](), torch.zeros(2, 12, dtype=torch.bool)
    own, said = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    refused(rf"^belief: expected {type(own).__name__}", observer.fade, seen(Semantic(4)), said, 0.5, visited)
    with pytest.raises(InputError, match=rf"^look: expected {type(said).__name__}"):
        observer.fade(own, Semantic(4).weigh(looks(), FIXATIONS, GRID), 0.5, visited)


def test_a_belief_about_any_of_classes_has_no_other_classes():
    belief = seen(OBSERVERS["any of targets"]())
    assert torch.equal(belief.probability(3), belief.probability(1))
    assert torch.equal(belief.probability(torch.tensor([1, 2])), belief.probability(1))
    refused(rf"all classes \(DirichletBelief\), got {type(belief).__name__}", dirichlet_belief, belief)
    known = seen(Semantic(4))
    assert dirichlet_belief(known) is known


@pytest.mark.parametrize("target", [-1, 5, [0, 5]])
def test_a_class_index_out_of_range_is_refused(target):
    with pytest.raises(InputError, match="target: expected a class index from 0 to 4"):
        DirichletBelief(rand(2, 12, 5)).probability(torch.tensor(target))


@pytest.mark.parametrize("form", [list, np.array, np.int64])
def test_targets_may_be_lists_and_arrays(form):
    belief = DirichletBelief(rand(2, 3, 4))
    targets = 2 if form is np.int64 else [3, 1]
    expected = belief.probability(targets if form is np.int64 else torch.tensor(targets))
    assert torch.equal(belief.probability(form(targets)), expected)


def test_put_replaces_the_beliefs_of_the_given_episodes():
    before, other = DirichletBelief(rand(4, 3, 2), rand(4, 3)), DirichletBelief(2 * rand(2, 3, 2), 2 * rand(2, 3))
    after = before.put(torch.tensor([3, 1]), other)
    for row, source in enumerate([before[0:1], other[1:2], before[2:3], other[0:1]]):
        assert torch.equal(after.beta[row], source.beta[0])
        assert torch.equal(after.closest[row], source.closest[0])
    assert torch.equal(before.beta, rand(4, 3, 2))


def test_parameters_fade_towards_the_prior():
    """A quarter of the evidence is left; the nearness exp(-6 d) of the closest look is a quarter as large."""
    observer = Semantic(4, prior=0.3)
    belief, look = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    faded = observer.fade(belief, look, 0.25, torch.zeros(2, 12, dtype=torch.bool))
    torch.testing.assert_close(faded.beta, 0.75 * torch.full_like(belief.beta, 0.3) + 0.25 * belief.beta)
    assert observer.fade(belief, look, 1, torch.zeros(2, 12, dtype=torch.bool)) is belief
    torch.testing.assert_close((-6 * faded.closest).exp(), (-6 * belief.closest).exp() / 4)


def test_a_printed_belief_has_shapes_and_no_numbers():
    observer = SemanticSearch(FovealObservationModel.identity(["cup"], [0.2], miss_odds=torch.ones(2, 2)))
    for belief in (DirichletBelief(torch.ones(2, 100, 3)), observer.start(2, Grid(10, 10, (64, 48)), torch.ones(1))):
        assert repr(belief).startswith(f"{type(belief).__name__}(beta: {tuple(belief.beta.shape)}, closest: (2, 100)")
        assert len(repr(belief)) < 200
        assert "tensor" not in repr(belief[:1])


@pytest.mark.parametrize(
    ("word", "remedy"),
    [
        ("probs", "belief.class_probabilities()"),
        ("entropy", "semfov.dirichlet.entropy(belief.beta)"),
        ("update", "observer(belief, detections, fixation, grid)"),
        ("to", "belief.map(lambda tensor: tensor.to(device))"),
    ],
)
def test_words_of_others_for_a_belief_are_answered(word, remedy):
    with pytest.raises(AttributeError, match=re.escape(remedy)):
        getattr(DirichletBelief(torch.ones(1, 4, 3)), word)
