import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.detection import Candidates, score_vectors
from tests.refusals import refused

EXACT = {"atol": 1e-12, "rtol": 0}


def candidates(classes, objectness=None, background=None) -> Candidates:
    as_tensor = [None if x is None else torch.tensor([x], dtype=torch.float64) for x in (objectness, background)]
    return Candidates(torch.zeros(1, 1, 4), torch.tensor([[classes]], dtype=torch.float64), *as_tensor)


@pytest.mark.parametrize(
    ("policy", "classes", "objectness", "background", "expected"),
    [
        ("residual", [0.6, 0.2], [0.5], None, [0.5, 0.375, 0.125]),
        ("residual", [0.6, 0.2], None, None, [0.4, 0.45, 0.15]),
        ("residual", [0.0, 0.0], [0.5], None, [0.5, 0.25, 0.25]),
        ("normalised", [0.6, 0.2], [0.5], None, [5 / 9, 3 / 9, 1 / 9]),
        ("normalised", [0.6, 0.2], None, None, [2 / 6, 3 / 6, 1 / 6]),
        ("uniform", [0.6, 0.2], [0.5], None, [1 / 3, 1 / 2, 1 / 6]),
        ("none", [0.6, 0.2], [0.5], None, [0.0, 0.75, 0.25]),
        ("own", [0.6, 0.2], None, [0.1], [0.1, 0.675, 0.225]),
    ],
)
def test_background_policies_on_computed_examples(policy, classes, objectness, background, expected):
    scores = score_vectors(candidates(classes, objectness, background), policy)
    torch.testing.assert_close(scores, torch.tensor([[expected]], dtype=torch.float64), **EXACT)


@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=6),
    st.floats(0, 1),
    st.sampled_from(["residual", "normalised", "uniform", "none"]),
)
def test_score_vectors_are_points_of_the_simplex(dtype, classes, objectness, policy):
    c = Candidates(
        torch.zeros(1, 4, dtype=dtype), torch.tensor([classes], dtype=dtype), torch.tensor([objectness]).to(dtype)
    )
    scores = score_vectors(c, policy)
    assert scores.dtype == dtype
    assert bool((scores >= 0).all())
    torch.testing.assert_close(scores.sum(-1), torch.ones(1, dtype=dtype), atol=1e-6, rtol=0)
    if max(classes) > 1e-3 and (objectness > 1e-3 or policy in ("uniform", "none")):
        assert scores[0, 1:].argmax() == torch.tensor(classes, dtype=dtype).argmax()


@pytest.mark.parametrize("policy", ["residual", "normalised", "uniform", "none"])
def test_score_vectors_are_differentiable(policy):
    classes = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    objectness = torch.rand(2, dtype=torch.float64, requires_grad=True)
    boxes = torch.zeros(2, 4, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c, o: score_vectors(Candidates(boxes, c, o), policy), (classes, objectness))


def test_compiles_to_a_single_graph():
    c = Candidates(torch.rand(5, 4), torch.rand(5, 3), torch.rand(5))
    compiled = torch.compile(score_vectors, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(c), score_vectors(c))


def test_refuses_unsuitable_policies():
    refused("'residual'", score_vectors, candidates([0.5]), "residul")
    refused("expects a head with a background score", score_vectors, candidates([0.5]), "own")
