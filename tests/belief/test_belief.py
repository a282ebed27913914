"""Beliefs: what they say of a target, whichever kind they are."""

import pytest
import torch

import semfov
from semfov import Detections, Grid, InputError
from semfov.belief import (
    Belief,
    ContextObserver,
    ContextPrior,
    DirichletBelief,
    SemanticObserver,
    TargetEvidence,
    TargetObserver,
)
from semfov.belief.belief import dirichlet_belief, pick

GRID = Grid(4, 3, (80, 60))


def rand(*shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)), dtype=torch.float64) + 0.1


def seen(observer):
    """A batch of two beliefs after one look each."""
    boxes = torch.tensor([[[5.0, 5, 30, 30]], [[40, 20, 75, 50]]]).double()
    looks = Detections(boxes, rand(2, 1, 4).softmax(-1), torch.ones(2, 1, dtype=torch.bool))
    evidence = observer.weigh(looks, GRID.centres[[0, 7]].double(), GRID, 2)
    return observer.update(observer.start(2, GRID, looks.scores), evidence)


def target_observer():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return TargetObserver(TargetEvidence(8, 6).double().requires_grad_(False))


def context_observer():
    prior = ContextPrior(["cat", "cup", "dog"], rand(4, 3, 3), rand(4, 4, 2), [0.2], weights={"map": (1.0, 0.5)})
    return ContextObserver(SemanticObserver(4), prior)


OBSERVERS = {"all classes": lambda: SemanticObserver(4), "target": target_observer, "context": context_observer}


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
    known = seen(SemanticObserver(4))
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
