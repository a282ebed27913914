"""Fusion rules against the exact posterior, the paper's formula and the properties that define them.

Equations are those of Luzio, Bernardino and Moreno (2024), with the labels of the paper's source.
"""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.belief import fusion
from semfov.errors import InputError

positive = st.floats(0.05, 20.0)
likelihoods = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=6).filter(lambda values: max(values) > 1e-3)


def exact_posterior_mean(beta: list[float], likelihood: list[float]) -> list[float]:
    """Mean of the exact posterior, which section III-B says the rule matches.

    By Bayes it is Dir(p | β) Σ_k p_k λ_k, a mixture of the Dirichlets Dir(β + e_k) with weights β_k λ_k.
    """
    total, weights = sum(beta), [b * l for b, l in zip(beta, likelihood, strict=True)]
    return [(b + w / sum(weights)) / (total + 1) for b, w in zip(beta, weights, strict=True)]


def scalar_kaplan(beta: list[float], likelihood: list[float]) -> list[float]:
    """Equation 7 (eq:kaplanrule), in scalars."""
    expected = sum(b * l for b, l in zip(beta, likelihood, strict=True))
    return [b * (1 + l / expected) / (1 + min(likelihood) / expected) for b, l in zip(beta, likelihood, strict=True)]


@given(likelihoods, st.data())
def test_kaplan_matches_the_formula_and_the_exact_mean(likelihood, data):
    beta = data.draw(st.lists(positive, min_size=len(likelihood), max_size=len(likelihood)))
    b, l = torch.tensor(beta, dtype=torch.float64), torch.tensor(likelihood, dtype=torch.float64)
    after = fusion.kaplan(b, l)
    torch.testing.assert_close(after, torch.tensor(scalar_kaplan(beta, likelihood), dtype=torch.float64))
    mean = torch.tensor(exact_posterior_mean(beta, likelihood), dtype=torch.float64)
    torch.testing.assert_close(after / after.sum(), mean)
    assert (after >= b).all()
    assert after[l.argmin()] == b[l.argmin()]


@given(likelihoods, st.data())
def test_the_rule_of_semba_divides_only_the_second_term(likelihood, data):
    beta = np.array(data.draw(st.lists(positive, min_size=len(likelihood), max_size=len(likelihood))))
    scores = np.array(likelihood)
    expected = beta * (1 + scores / sum(scores * beta) / (1 + min(scores) / sum(scores * beta)))
    scaled = fusion.scale_likelihood(torch.from_numpy(scores))
    after = fusion.RULES["semba"](torch.from_numpy(beta), scaled)
    torch.testing.assert_close(after, torch.from_numpy(expected))
    if min(likelihood) == 0:  # then the two forms are equal
        torch.testing.assert_close(after, fusion.kaplan(torch.from_numpy(beta), torch.from_numpy(scores)))


def test_kaplan_mean_equals_that_of_the_integrated_posterior():
    """Monte Carlo over the prior: the posterior mean of p is E[p (p·λ)] / E[p·λ]."""
    beta, likelihood = torch.tensor([0.7, 2.0, 1.3]).double(), torch.tensor([0.9, 0.2, 0.05]).double()
    torch.manual_seed(0)
    draws = torch.distributions.Dirichlet(beta).sample((200_000,))
    weights = draws @ likelihood
    posterior = (weights[:, None] * draws).mean(0) / weights.mean()
    after = fusion.kaplan(beta, likelihood)
    torch.testing.assert_close(after / after.sum(), posterior, atol=2e-3, rtol=0)


def test_kaplan_depends_on_the_order_of_detections():
    """Section IV-A applies it "in no particular order": the caller has to choose one."""
    beta = torch.full((3,), 0.5, dtype=torch.float64)
    first, second = torch.tensor([[0.7, 0.2, 0.1], [0.1, 0.1, 0.8]], dtype=torch.float64)
    one, other = fusion.kaplan(fusion.kaplan(beta, first), second), fusion.kaplan(fusion.kaplan(beta, second), first)
    assert (one - other).abs().max() > 0.01


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_kaplan_with_uniform_and_one_hot_likelihoods(dtype):
    beta = torch.tensor([0.5, 1.5, 3.0], dtype=dtype)
    torch.testing.assert_close(fusion.kaplan(beta, torch.full((3,), 0.37, dtype=dtype)), beta)
    one_hot = torch.tensor([0.0, 1.0, 0.0], dtype=dtype)
    torch.testing.assert_close(fusion.kaplan(beta, one_hot), beta + one_hot)
    assert fusion.kaplan(beta, one_hot).dtype == dtype


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_rules_ignore_scale_and_order_of_classes(rule):
    torch.manual_seed(1)
    beta, likelihood = torch.rand(7, 4).double() + 0.1, torch.rand(7, 4).double()
    after = rule(beta, likelihood)
    torch.testing.assert_close(rule(beta, likelihood * 1e-30), after)
    for order in itertools.permutations(range(4)):
        torch.testing.assert_close(rule(beta[:, order], likelihood[:, order]), after[:, order])


@given(st.lists(likelihoods.filter(lambda values: min(values) > 1e-3), min_size=1, max_size=5), st.data())
def test_product_is_bayes_and_sum_is_an_average(looks, data):
    """Over several looks: p_k Π λ, normalised, and the mean of the normalised λ with the prior counting Σβ times."""
    classes = min(len(look) for look in looks)
    looks = [look[:classes] for look in looks]
    beta = data.draw(st.lists(positive, min_size=classes, max_size=classes))
    multiplied = added = start = torch.tensor(beta, dtype=torch.float64)
    joint, shares = list(beta), list(beta)
    for look in looks:
        likelihood = torch.tensor(look, dtype=torch.float64)
        multiplied, added = fusion.product(multiplied, likelihood), fusion.sum(added, likelihood)
        joint = [j * l for j, l in zip(joint, look, strict=True)]
        shares = [s + l / sum(look) for s, l in zip(shares, look, strict=True)]
    torch.testing.assert_close(multiplied / multiplied.sum(), start.new_tensor(joint) / sum(joint))
    torch.testing.assert_close(added / added.sum(), start.new_tensor(shares) / (sum(beta) + len(looks)))


def test_product_and_sum_by_hand():
    beta, likelihood = torch.tensor([1.0, 3.0]), torch.tensor([0.5, 0.25])
    torch.testing.assert_close(fusion.product(beta, likelihood), 5 * torch.tensor([0.5, 0.75]) / 1.25)
    torch.testing.assert_close(fusion.sum(beta, likelihood), beta + torch.tensor([2 / 3, 1 / 3]))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_likelihoods_of_another_number_of_classes_are_refused(rule):
    with pytest.raises(InputError, match=r"^likelihood: expected a tensor of shape \(..., 3\), got \(4, 2\)$"):
        rule(torch.ones(4, 3), torch.ones(4, 2))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
@pytest.mark.parametrize(
    ("bad", "word"),
    [([0.0, 0.0], "zeros"), ([float("nan"), 1.0], "NaN"), ([-0.1, 1.0], "negative"), ([1.0, float("inf")], "inf")],
)
def test_unusable_likelihoods_are_refused(rule, bad, word):
    with pytest.raises(InputError, match=word):
        rule(torch.ones(2), torch.tensor(bad))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_gradients(rule):
    torch.manual_seed(2)
    beta = (torch.rand(3, 4, dtype=torch.float64) + 0.2).requires_grad_()
    likelihood = (torch.rand(3, 4, dtype=torch.float64) + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(rule, (beta, likelihood))


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_rules_compile_to_one_graph(rule):
    beta, likelihood = torch.rand(5, 4) + 0.1, torch.rand(5, 4)
    compiled = torch.compile(rule, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(beta, likelihood), rule(beta, likelihood))


def test_extreme_likelihoods_stay_finite():
    likelihood = torch.tensor([1e-38, 1.0, 3e38])
    for rule in fusion.RULES.values():
        beta = torch.full((3,), 0.5)
        for _ in range(300):
            beta = rule(beta, fusion.scale_likelihood(likelihood))
        assert torch.isfinite(beta).all()
        assert (beta > 0).all()


@pytest.mark.parametrize("rule", [fusion.kaplan, fusion.product, fusion.sum])
def test_numpy_arrays_are_refused_with_the_conversion(rule):
    beta, likelihood = np.ones(3), np.array([0.5, 0.2, 0.3])
    with pytest.raises(InputError, match=r"^beta: expected a tensor, got a NumPy array; give torch\.as_tensor\(beta\)"):
        rule(beta, torch.from_numpy(likelihood))
    with pytest.raises(InputError, match=r"^likelihood: expected a tensor, got a NumPy array"):
        rule(torch.from_numpy(beta), likelihood)
