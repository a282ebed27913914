"""The choice of a fixation against a loop, and uniform random choice among ties."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.errors import InputError
from semfov.gaze import select_fixation


@given(st.integers(1, 9), st.integers(0, 10_000))
def test_equals_a_loop(cells, seed):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randint(0, 4, (3, cells), generator=generator).double()
    visited = torch.rand(3, cells, generator=generator) < 0.4
    noise = torch.rand(3, cells, generator=generator)
    for row, got in enumerate(select_fixation(values, visited, noise).tolist()):
        free = [c for c in range(cells) if not visited[row, c]]
        best = max((float(values[row, c]) for c in free), default=None)
        tied = [c for c in free if float(values[row, c]) == best]
        assert got == (max(tied, key=lambda c: float(noise[row, c])) if free else -1)


def test_ties_are_broken_at_random_with_equal_probability():
    torch.manual_seed(0)
    values = torch.tensor([0.2, 0.9, 0.9, 0.1, 0.9]).expand(9000, 5)
    choices = select_fixation(values, torch.zeros(9000, 5, dtype=torch.bool), torch.rand(9000, 5))
    counts = torch.bincount(choices, minlength=5)
    assert counts[[0, 3]].tolist() == [0, 0]
    # Five standard deviations of a binomial with p = 1/3.
    assert (counts[[1, 2, 4]] - 3000).abs().max() < 5 * (9000 * 2 / 9) ** 0.5


def test_rounding_does_not_break_ties():
    values = torch.tensor([[0.3, 0.1 + 0.2, 0.30000003]])
    noise = torch.tensor([[0.9, 0.2, 0.5]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [0]


def test_negative_values_and_infinities():
    values = torch.tensor([[-3.0, -2.0, -float("inf")]])
    noise = torch.tensor([[0.9, 0.2, 0.95]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [1]


def test_compiles_to_one_graph():
    values, noise = torch.rand(4, 9), torch.rand(4, 9)
    visited = torch.rand(4, 9) < 0.5
    compiled = torch.compile(select_fixation, fullgraph=True, backend="eager")
    assert torch.equal(compiled(values, visited, noise), select_fixation(values, visited, noise))


def test_bad_input():
    with pytest.raises(InputError, match="NaN"):
        select_fixation(torch.tensor([[float("nan")]]), torch.tensor([[False]]), torch.rand(1, 1))
    with pytest.raises(InputError, match="visited"):
        select_fixation(torch.zeros(1, 3), torch.zeros(1, 2, dtype=torch.bool), torch.rand(1, 3))
