"""The best cell against a loop, random choices against frequencies, and gradients of the soft choice."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Grid
from semfov.fit.examples import _Exploratory
from semfov.gaze.choice import Greedy, Softmax, drawn_from, select_fixation, soft_fixation
from tests.refusals import refused

CENTRES = torch.stack([torch.arange(9.0), torch.zeros(9)], -1)


def noise_from(seed):
    """A source that returns new random numbers at every call."""
    generator = torch.Generator().manual_seed(seed)
    return lambda shift, episodes: torch.rand(len(episodes), 9, generator=generator)


@pytest.mark.parametrize("astray", [0.0, 0.3, 1.0])
def test_the_given_share_of_fixations_is_random(astray):
    count = 20_000
    values, visited = torch.zeros(count, 9), torch.zeros(count, 9, dtype=torch.bool)
    values[:, 4] = 1
    visited[:, 7] = True
    fixation, cell = _Exploratory(noise_from(0), astray)(0, torch.arange(count), values, visited, CENTRES)
    assert torch.equal(fixation, CENTRES[cell])
    counts = torch.bincount(cell, minlength=9)
    # Random fixations are uniform over unvisited cells, the best one included; within five standard deviations.
    share = torch.full((9,), astray / 8)
    share[4] += 1 - astray
    share[7] = 0
    deviation = (count * share * (1 - share)).clamp(min=0).sqrt()
    assert bool(((counts - count * share).abs() <= 5 * deviation).all())


@given(st.integers(0, 10_000), st.floats(0, 1))
def test_a_visited_cell_is_never_chosen(seed, astray):
    generator = torch.Generator().manual_seed(seed)
    values, visited = torch.rand(6, 9, generator=generator), torch.rand(6, 9, generator=generator) < 0.7
    left = ~visited.all(-1)
    before = values.clone()
    _, cell = _Exploratory(noise_from(seed), astray)(0, torch.arange(6), values, visited, CENTRES)
    assert not visited[left].gather(1, cell[left, None]).any()
    assert torch.equal(values, before)


def test_without_random_fixations_the_choice_is_greedy():
    values, noise = torch.rand(50, 9).mul(4).round(), torch.rand(50, 9)
    visited = torch.rand(50, 9) < 0.3
    got, expected = (
        make(0, torch.arange(50), values, visited, CENTRES)[1]
        for make in (_Exploratory(lambda *_: noise, 0.0), Greedy(lambda *_: noise))
    )
    assert torch.equal(got, expected)


def test_no_gradient_flows_through_a_choice():
    values = torch.rand(3, 9, requires_grad=True)
    fixation, _ = _Exploratory(noise_from(2), 0.5)(
        0, torch.arange(3), values, torch.zeros(3, 9, dtype=torch.bool), CENTRES
    )
    assert not fixation.requires_grad


@pytest.mark.parametrize("inverse_temperature", [0.0, 0.7, 3.0])
def test_softmax_draws_in_proportion_to_exponentials(inverse_temperature, dtype, device):
    count = 40_000
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(9, generator=generator).to(device, dtype)
    visited = torch.zeros(count, 9, dtype=torch.bool, device=device)
    visited[:, 2] = True
    noise = drawn_from(torch.rand(count, 1, 9, generator=generator).to(device))
    choice, centres = Softmax(noise, inverse_temperature), CENTRES.to(device)
    fixation, cell = choice(0, torch.arange(count, device=device), values.expand(count, 9), visited, centres)
    assert torch.equal(fixation.to(centres), centres[cell])
    weight = (inverse_temperature * values.double()).exp()
    weight[2] = 0
    share = weight / weight.sum()
    counts = torch.bincount(cell, minlength=9)
    assert bool(((counts - count * share).abs() <= 5 * (count * share * (1 - share)).sqrt()).all())


@given(st.integers(1, 9), st.integers(0, 10_000))
def test_selection_equals_a_loop(cells, seed):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randint(0, 4, (3, cells), generator=generator).double()
    visited = torch.rand(3, cells, generator=generator) < 0.4
    noise = torch.rand(3, cells, generator=generator)
    for row, got in enumerate(select_fixation(values, visited, noise).tolist()):
        free = [c for c in range(cells) if not visited[row, c]]
        best = max((float(values[row, c]) for c in free), default=None)
        tied = [c for c in free if float(values[row, c]) == best]
        assert got == (max(tied, key=lambda c: float(noise[row, c])) if free else -1)


def test_ties_are_not_broken_by_rounding_negative_values_or_infinities():
    values = torch.tensor([[0.3, 0.1 + 0.2, 0.30000003]])
    noise = torch.tensor([[0.9, 0.2, 0.5]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [0]
    values = torch.tensor([[-3.0, -2.0, -float("inf")]])
    noise = torch.tensor([[0.9, 0.2, 0.95]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [1]


def test_selection_compiles_to_one_graph():
    values, noise = torch.rand(4, 9), torch.rand(4, 9)
    visited = torch.rand(4, 9) < 0.5
    compiled = torch.compile(select_fixation, fullgraph=True, backend="eager")
    assert torch.equal(compiled(values, visited, noise), select_fixation(values, visited, noise))


CELLS, GRID = 12, Grid(4, 3, (64, 48))


@pytest.fixture
def visited():
    visited = torch.zeros(3, CELLS, dtype=torch.bool)
    visited[0, 5] = visited[1, [0, 7]] = True
    return visited


def test_hard_fixations_are_draws_from_the_softmax():
    torch.manual_seed(0)
    logits = torch.tensor([0.0, 1.0, 5.0, -1.0]).expand(20000, 4)
    visited = torch.tensor([False, False, True, False]).expand_as(logits)
    _, cell = soft_fixation(logits, visited, torch.zeros(4, 2), torch.rand(20000, 4))
    share = torch.bincount(cell, minlength=4) / len(cell)
    torch.testing.assert_close(share, torch.tensor([0.0, 1.0, -torch.inf, -1.0]).softmax(0), atol=0.015, rtol=0)
    assert share[2] == 0


def test_a_hard_fixation_has_the_gradient_of_the_soft_one(visited, dtype):
    torch.manual_seed(0)
    centres, noise = GRID.centres.to(dtype), torch.rand(3, CELLS, dtype=dtype)
    logits = torch.randn(3, CELLS, dtype=dtype, requires_grad=True)
    hard, cell = soft_fixation(logits, visited, centres, noise, temperature=0.7)
    soft, same = soft_fixation(logits, visited, centres, noise, temperature=0.7, hard=False)
    assert torch.equal(hard, centres[cell])
    assert torch.equal(cell, same)
    assert not visited.gather(1, cell[:, None]).any()
    weight = torch.randn(3, 2, dtype=dtype)
    gradients = [torch.autograd.grad((point * weight).sum(), logits)[0] for point in (hard, soft)]
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0.1


def test_soft_fixation_gradcheck(visited):
    torch.manual_seed(0)
    centres, noise = GRID.centres.double(), torch.rand(3, CELLS).double()
    logits = torch.randn(3, CELLS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: soft_fixation(x, visited, centres, noise, hard=False)[0], logits)


def test_soft_fixations_at_low_temperature_are_cell_centres(visited):
    torch.manual_seed(0)
    centres, noise = GRID.centres, torch.rand(3, CELLS)
    noise[0, 0], noise[1, 1] = 0.0, 1.0  # ends of the range
    soft, cell = soft_fixation(torch.randn(3, CELLS), visited, centres, noise, temperature=1e-4, hard=False)
    torch.testing.assert_close(soft, centres[cell])


def test_wrong_arguments_of_choices_are_refused():
    refused("inverse_temperature", Softmax, lambda *_: torch.zeros(1, 9), -1.0)
    refused("NaN", select_fixation, torch.tensor([[float("nan")]]), torch.tensor([[False]]), torch.rand(1, 1))
    refused("visited", select_fixation, torch.zeros(1, 3), torch.zeros(1, 2, dtype=torch.bool), torch.rand(1, 3))
    zeros = torch.zeros(1, 3)
    refused("temperature", soft_fixation, zeros, zeros > 0, torch.zeros(3, 2), zeros, temperature=0.0)
    refused("centres", soft_fixation, zeros, zeros > 0, torch.zeros(4, 2), zeros)
