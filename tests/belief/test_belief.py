"""Beliefs of every kind: the probability of a target, indexing, mapping and fading."""

import pytest
import torch

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
    """All tensors of a belief, those of nested beliefs included."""
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_before_the_first_look_all_distances_are_infinite(dtype):
    belief = DirichletBelief(torch.ones(2, 12, 5, dtype=dtype))
    assert belief.closest.shape == (2, 12)
    assert belief.closest.dtype == dtype
    assert torch.isposinf(belief.closest).all()
    uniform = DirichletBelief.uniform(2, 12, 5, 0.5, torch.empty(0, dtype=dtype))
    assert torch.equal(uniform.beta, torch.full((2, 12, 5), 0.5, dtype=dtype))
    assert torch.equal(uniform.closest, belief.closest)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_every_kind_has_a_probability_of_the_target_and_can_be_indexed(kind):
    belief = seen(OBSERVERS[kind]())
    assert isinstance(belief, Belief)
    present = belief.probability(2)
    assert present.shape == belief.closest.shape == (2, 12)
    assert bool(((present >= 0) & (present <= 1)).all())
    for index in (slice(1, 2), torch.tensor([1])):
        torch.testing.assert_close(belief[index].probability(2), present[1:2])
        torch.testing.assert_close(belief[index].closest, belief.closest[1:2])


@pytest.mark.parametrize("kind", OBSERVERS)
def test_map_is_applied_to_every_tensor_of_every_kind(kind):
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
def test_a_detached_belief_has_the_same_values_and_no_gradients(kind):
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
def test_calling_an_observer_equals_weigh_and_update(kind):
    observer = OBSERVERS[kind]()
    called = observer(observer.start(2, GRID, looks().scores), looks(), FIXATIONS, GRID, 2)
    for one, other in zip(tensors_of(called), tensors_of(seen(observer)), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("kind", OBSERVERS)
def test_an_observer_refuses_beliefs_and_looks_of_another_kind(kind):
    observer = OBSERVERS[kind]()
    own, said = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    for make in (make for name, make in OBSERVERS.items() if name != kind):
        with pytest.raises(InputError, match="belief: expected "):
            observer.update(seen(make()), said)
        with pytest.raises(InputError, match=f"look: expected {type(said).__name__}"):
            observer.update(own, make().weigh(looks(), FIXATIONS, GRID, 2))


@pytest.mark.parametrize("kind", ["target", "context"])
def test_a_belief_about_one_target_gives_its_probability_for_any_class(kind):
    belief = seen(OBSERVERS[kind]())
    assert torch.equal(belief.probability(3), belief.present)
    assert torch.equal(belief.probability(torch.tensor([1, 2])), belief.present)


@pytest.mark.parametrize("kind", ["target", "context"])
def test_a_belief_about_one_target_is_refused_where_all_classes_are_needed(kind):
    belief = seen(OBSERVERS[kind]())
    with pytest.raises(InputError, match=rf"all classes \(DirichletBelief\), got {type(belief).__name__}"):
        dirichlet_belief(belief)
    known = seen(Semantic(4))
    assert dirichlet_belief(known) is known


@pytest.mark.parametrize("target", [-1, 5, [0, 5]])
def test_a_class_index_out_of_range_is_refused(target):
    with pytest.raises(InputError, match="target: expected a class index from 0 to 4"):
        DirichletBelief(rand(2, 12, 5)).probability(torch.tensor(target))


def test_pick_selects_one_component_per_row():
    values, target = rand(2, 3, 4, 5), torch.tensor([4, 0])
    got = pick(values, target)
    for row in range(2):
        assert torch.equal(got[row], values[row, ..., target[row]])
    assert torch.equal(pick(values, torch.tensor(3)), values[..., 3])


def test_beliefs_can_be_created_inside_a_compiled_graph():
    def present(beta):
        return DirichletBelief(beta).probability(2)

    torch.compiler.reset()
    compiled = torch.compile(present, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(rand(2, 3, 4)), present(rand(2, 3, 4)))


def test_put_replaces_the_beliefs_of_the_given_episodes():
    before, other = DirichletBelief(rand(4, 3, 2), rand(4, 3)), DirichletBelief(2 * rand(2, 3, 2), 2 * rand(2, 3))
    after = before.put(torch.tensor([3, 1]), other)
    for row, source in enumerate([before[0:1], other[1:2], before[2:3], other[0:1]]):
        assert torch.equal(after.beta[row], source.beta[0])
        assert torch.equal(after.closest[row], source.closest[0])
    assert torch.equal(before.beta, rand(4, 3, 2))


@pytest.mark.parametrize("kind", OBSERVERS)
def test_fading_by_a_factor_of_one_changes_nothing(kind):
    observer, visited = OBSERVERS[kind](), torch.zeros(2, 12, dtype=torch.bool)
    belief, look = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    same = observer.fade(belief, look, 1, visited)
    for one, other in zip(tensors_of(same), tensors_of(belief), strict=True):
        assert torch.equal(one, other)


def test_parameters_fade_towards_the_prior():
    """A quarter of the evidence is left; the nearness exp(-6 d) of the closest look is a quarter as large."""
    observer = Semantic(4, prior=0.3)
    belief, look = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    faded = observer.fade(belief, look, 0.25, torch.zeros(2, 12, dtype=torch.bool))
    torch.testing.assert_close(faded.beta, 0.75 * torch.full_like(belief.beta, 0.3) + 0.25 * belief.beta)
    assert observer.fade(belief, look, 1, torch.zeros(2, 12, dtype=torch.bool)) is belief
    torch.testing.assert_close((-6 * faded.closest).exp(), (-6 * belief.closest).exp() / 4)


def test_gathered_evidence_fades_towards_that_of_an_empty_look_from_far_away():
    observer, visited = target_observer(), torch.arange(24).reshape(2, 12) % 3 == 0
    belief, look = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    faded = observer.fade(belief, look, 0.25, visited)
    grid = Grid(2, 1, (200, 100))
    # The second cell's centre is as far from the fixation as the image is wide.
    nothing = observer.weigh(Detections.empty(1, 80), torch.tensor([[-50.5, 49.5]]).double(), grid, 2).evidence[0, 1]
    for name in ("nearest", "best"):
        before, after = getattr(belief, name), getattr(faded, name)
        torch.testing.assert_close(after, 0.75 * nothing.expand_as(before) + 0.25 * before)
    for name in ("total", "weight", "score", "looks"):
        torch.testing.assert_close(getattr(faded, name), getattr(belief, name) / 4)
    torch.testing.assert_close((-6 * faded.closest).exp(), (-6 * belief.closest).exp() / 4)
    assert torch.equal(faded.visited, visited)


def test_context_fades_with_the_inner_belief(monkeypatch):
    observer, visited = context_observer(), torch.zeros(2, 12, dtype=torch.bool)
    belief, look = seen(observer), observer.weigh(looks(), FIXATIONS, GRID, 2)
    faded = observer.fade(belief, look, 0.25, visited)
    inner = observer.observer.fade(belief.inner, look.inner, 0.25, visited)
    assert torch.equal(faded.inner.beta, inner.beta)
    assert torch.equal(faded.closest, inner.closest)
    torch.testing.assert_close(faded.scores, belief.scores / 4)
    assert torch.equal(faded.present, belief.present)
    with pytest.raises(InputError, match=r"^belief: expected ContextBelief"):
        observer.fade(belief.inner, look, 0.25, visited)
    with pytest.raises(InputError, match=r"^look: expected ContextLook"):
        observer.fade(belief, look.inner, 0.25, visited)
    calls = []
    monkeypatch.setattr(observer.observer, "fade", lambda *given: calls.append(given) or belief.inner)
    observer.fade(belief, look, 0.25, visited)
    assert [one is other for one, other in zip(calls[0], (belief.inner, look.inner, 0.25, visited), strict=True)] == [
        True
    ] * 4


@pytest.mark.parametrize("kind", OBSERVERS)
def test_joining_a_single_batch_of_looks_changes_nothing(kind):
    observer = OBSERVERS[kind]()
    look = observer.weigh(looks(), FIXATIONS, GRID, 2)
    start = observer.start(2, GRID, looks().scores)
    joined = observer.update(start, type(look).join([look]))
    for one, other in zip(tensors_of(joined), tensors_of(seen(observer)), strict=True):
        assert torch.equal(one, other)
