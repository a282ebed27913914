"""Probability of any object in a cell, against a loop over cells and classes."""

import pytest
import torch

from semfov.belief import DirichletBelief
from semfov.belief.observers.target import TargetBelief
from semfov.errors import InputError
from semfov.gaze.acquisition import ObjectEvidence


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_equals_the_loop(dtype, device):
    beta = torch.rand(2, 6, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(device, dtype)
    got = ObjectEvidence()(DirichletBelief(beta), torch.zeros(2, 6, dtype=torch.bool, device=device))
    assert got.dtype == dtype
    for episode in range(2):
        for x in range(6):
            first, *others = beta[episode, x].tolist()
            assert float(got[episode, x]) == pytest.approx(sum(others) / (first + sum(others)), rel=1e-6)


def test_a_belief_about_one_target_is_refused():
    cells, one = torch.zeros(1, 3), torch.zeros(1)
    about_one = TargetBelief(cells, cells, cells, cells, cells, one, one, cells.bool(), cells, cells, one)
    with pytest.raises(InputError, match="all classes"):
        ObjectEvidence()(about_one, torch.zeros(1, 3, dtype=torch.bool))
