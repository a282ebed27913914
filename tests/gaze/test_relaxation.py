"""The soft choice of a fixation: against frequencies, and gradients against finite differences."""

import pytest
import torch

from semfov import Grid, InputError
from semfov.gaze.relaxation import soft_fixation

CELLS, COLUMNS = 12, 4


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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_hard_fixation_has_the_gradient_of_the_soft_one(visited, dtype):
    torch.manual_seed(0)
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres.to(dtype), torch.rand(3, CELLS, dtype=dtype)
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
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres.double(), torch.rand(3, CELLS).double()
    logits = torch.randn(3, CELLS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: soft_fixation(x, visited, centres, noise, hard=False)[0], logits)


def test_soft_fixations_at_low_temperature_are_cell_centres(visited):
    torch.manual_seed(0)
    centres, noise = Grid(COLUMNS, 3, (64, 48)).centres, torch.rand(3, CELLS)
    noise[0, 0], noise[1, 1] = 0.0, 1.0  # ends of the range
    soft, cell = soft_fixation(torch.randn(3, CELLS), visited, centres, noise, temperature=1e-4, hard=False)
    torch.testing.assert_close(soft, centres[cell])


def test_wrong_arguments():
    zeros = torch.zeros(1, 3)
    with pytest.raises(InputError, match="temperature"):
        soft_fixation(zeros, zeros > 0, torch.zeros(3, 2), zeros, temperature=0.0)
    with pytest.raises(InputError, match="centres"):
        soft_fixation(zeros, zeros > 0, torch.zeros(4, 2), zeros)
