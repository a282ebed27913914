"""Beliefs: what they say of a target, whichever kind they are."""

import pytest
import torch

import semfov
from semfov import Detections, Grid, InputError
from semfov.belief import Belief, ContextPrior, DirichletBelief, TargetEvidence
from semfov.belief.belief import dirichlet_belief, pick
from semfov.belief.observers import Context, Semantic, Target

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
    """All tensors of a belief, whatever it is made of."""
    found = []
    for name in belief.__dataclass_fields__:
        part = getattr(belief, name)
        found += [part] if isinstance(part, torch.Tensor) else tensors_of(part)
    return found


def target_observer():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Target(TargetEvidence(8, 6).double().requires_grad_(False))


def context_observer():
    prior = ContextPrior(["cat", "cup", "dog"], rand(4, 3, 3), rand(4, 4, 2), [0.2], weights={"map": (1.0, 0.5)})
    return Context(Semantic(4), prior)


OBSERVERS = {"all classes": lambda: Semantic(4), "target": target_observer, "context": context_observer}


def test_probability_of_a_target_is_that_of_a_loop():
    beta, targets = rand(3, 12, 5), torch.tensor([1, 4, 2])
    belief = DirichletBelief(beta)
    for batch, target in enumerate(targets.tolist()):
        for cell in range(12):
            expected = beta[batch, cell, target] / sum(beta[batch, cell])
            torch.testing.assert_close(belief.probability(targets)[batch, cell], expected)
            torch.testing.assert_close(belief.probability(target)[batch, cell], expected)
    torch.testing.assert_close(belief.probabilities.sum(-1), torch.ones(3, 12, dtype=torch.float64))
    torch.testing.assert_close(belief.probabilities[..., 2], belief.probability(2))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_before_the_first_look_nothing_is_near(dtype):
    belief = DirichletBelief(torch.ones(2, 12, 5, dtype=dtype))
    assert belief.closest.shape == (2, 12)
    assert belief.closest.dtype == dtype
    assert torch.isposinf(belief.closest).all()
    uniform = DirichletBelief.uniform(2, 12, 5, 0.5, torch.empty(0, dtype=dtype))
    assert torch.equal(uniform.beta, torch.full((2, 12, 5), 0.5, dtype=dtype))
    assert torch.equal(uniform.closest, belief.closest)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_every_kind_answers_for_the_target_and_can_be_indexed(kind):
    belief = seen(OBSERVERS[kind]())
    assert isinstance(belief, Belief)
    present = belief.probability(2)
    assert present.shape == belief.closest.shape == (2, 12)
    assert bool(((present >= 0) & (present <= 1)).all())
    for index in (slice(1, 2), torch.tensor([1])):
        torch.testing.assert_close(belief[index].probability(2), present[1:2])
        torch.testing.assert_close(belief[index].closest, belief.closest[1:2])


@pytest.mark.parametrize("kind", OBSERVERS)
def test_every_kind_is_mapped_tensor_by_tensor(kind):
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


@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_detached_belief_is_the_same_without_its_past(kind):
    observer = OBSERVERS[kind]()
    boxes, mask = looks().boxes, looks().mask
    scores = looks().scores.requires_grad_()
    said = observer.weigh(Detections(boxes, scores, mask), FIXATIONS, GRID, 2)
    belief = observer.update(observer.start(2, GRID, boxes), said)
    assert belief.probability(2).requires_grad
    apart = belief.detach()
    assert not any(tensor.requires_grad for tensor in tensors_of(apart))
    assert torch.equal(apart.probability(2), belief.probability(2))


@pytest.mark.parametrize("kind", OBSERVERS)
def test_a_call_of_an_observer_is_to_weigh_and_to_update(kind):
    observer = OBSERVERS[kind]()
    called = observer(observer.start(2, GRID, looks().scores), looks(), FIXATIONS, GRID, 2)
    for one, other in zip(tensors_of(called), tensors_of(seen(observer)), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_an_observer_refuses_what_another_made(kind):
    observer = OBSERVERS[kind]()
    own, said = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    for make in (make for name, make in OBSERVERS.items() if name != kind):
        with pytest.raises(InputError, match="belief: expected "):
            observer.update(seen(make()), said)
        with pytest.raises(InputError, match=f"look: expected {type(said).__name__}"):
            observer.update(own, make().weigh(looks(), FIXATIONS, GRID, 2))


@pytest.mark.parametrize("kind", ["target", "context"])
def test_a_belief_about_one_target_answers_for_it_whatever_is_asked(kind):
    belief = seen(OBSERVERS[kind]())
    assert torch.equal(belief.probability(3), belief.present)
    assert torch.equal(belief.probability(torch.tensor([1, 2])), belief.present)


@pytest.mark.parametrize("kind", ["target", "context"])
def test_a_belief_about_one_target_is_none_about_all_classes(kind):
    belief = seen(OBSERVERS[kind]())
    with pytest.raises(InputError, match=rf"all classes \(DirichletBelief\), got {type(belief).__name__}"):
        dirichlet_belief(belief)
    known = seen(Semantic(4))
    assert dirichlet_belief(known) is known


@pytest.mark.parametrize("target", [-1, 5, [0, 5]])
def test_there_is_no_such_class(target):
    with pytest.raises(InputError, match="target: expected a class index from 0 to 4"):
        DirichletBelief(rand(2, 12, 5)).probability(torch.tensor(target))


def test_pick_takes_a_component_for_each_row_of_any_shape():
    values, target = rand(2, 3, 4, 5), torch.tensor([4, 0])
    got = pick(values, target)
    for row in range(2):
        assert torch.equal(got[row], values[row, ..., target[row]])
    assert torch.equal(pick(values, torch.tensor(3)), values[..., 3])


def test_gradients_reach_the_parameters():
    beta = rand(2, 3, 4).requires_grad_()
    assert torch.autograd.gradcheck(lambda b: DirichletBelief(b).probability(torch.tensor([1, 3])), beta)


def test_beliefs_are_made_inside_a_graph():
    def present(beta):
        return DirichletBelief(beta).probability(2)

    torch.compiler.reset()
    compiled = torch.compile(present, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(rand(2, 3, 4)), present(rand(2, 3, 4)))


def test_it_is_public():
    assert semfov.DirichletBelief is DirichletBelief
    assert semfov.Belief is Belief
    assert semfov.observers.Semantic is Semantic
