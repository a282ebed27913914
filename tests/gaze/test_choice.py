"""Random choices of the next cell: how often, which cells, and never a visited one."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.errors import InputError
from semfov.gaze.choice import Exploratory, Greedy, Softmax, drawn_from

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
    fixation, cell = Exploratory(noise_from(0), astray)(0, torch.arange(count), values, visited, CENTRES)
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
    _, cell = Exploratory(noise_from(seed), astray)(0, torch.arange(6), values, visited, CENTRES)
    assert not visited[left].gather(1, cell[left, None]).any()
    assert torch.equal(values, before)


def test_a_complete_search_visits_every_cell_once():
    choice, visited = Exploratory(noise_from(1), 0.5), torch.zeros(5, 9, dtype=torch.bool)
    for shift in range(9):
        _, cell = choice(shift, torch.arange(5), torch.rand(5, 9), visited, CENTRES)
        assert not visited.gather(1, cell[:, None]).any()
        visited = visited.scatter(1, cell[:, None], True)
    assert bool(visited.all())


def test_without_random_fixations_the_choice_is_greedy():
    values, noise = torch.rand(50, 9).mul(4).round(), torch.rand(50, 9)
    visited = torch.rand(50, 9) < 0.3
    got, expected = (
        make(0, torch.arange(50), values, visited, CENTRES)[1]
        for make in (Exploratory(lambda *_: noise, 0.0), Greedy(lambda *_: noise))
    )
    assert torch.equal(got, expected)


def test_no_gradient_flows_through_a_choice():
    values = torch.rand(3, 9, requires_grad=True)
    fixation, _ = Exploratory(noise_from(2), 0.5)(
        0, torch.arange(3), values, torch.zeros(3, 9, dtype=torch.bool), CENTRES
    )
    assert not fixation.requires_grad


@pytest.mark.parametrize("inverse_temperature", [0.0, 0.7, 3.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
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


def test_a_softmax_at_low_temperature_is_greedy():
    values, visited = torch.rand(200, 9), torch.rand(200, 9) < 0.5
    visited[:, 0] = False
    noise = drawn_from(torch.rand(200, 1, 9))
    cold, greedy = (
        choice(0, torch.arange(200), values, visited, CENTRES)[1] for choice in (Softmax(noise, 1e7), Greedy(noise))
    )
    assert torch.equal(cold, greedy)


def test_a_negative_inverse_temperature_is_refused():
    with pytest.raises(InputError, match="inverse_temperature"):
        Softmax(lambda *_: torch.zeros(1, 9), -1.0)
