"""The closer look against a loop over fixations and cells."""

import math

import pytest
import torch

from semfov import DirichletBelief, Grid, InputError
from semfov.gaze.acquisition import CloserLook

GRID = Grid(4, 3, (80, 60))
FOVEA = 0.2


@pytest.fixture(params=[torch.float32, torch.float64])
def belief(request):
    torch.manual_seed(0)
    beta = torch.rand(2, 12, 5, dtype=request.param) ** 2 + 0.02
    closest = torch.stack([GRID.cell_distance[3], GRID.cell_distance[[0, 10]].amin(0)]).to(beta)
    return DirichletBelief(beta, closest)


def test_value_equals_the_loop(belief):
    got = CloserLook(GRID, FOVEA)(belief, torch.zeros(2, 12, dtype=torch.bool))
    assert got.dtype == belief.beta.dtype

    def acuity(distance):
        return 1.0 if distance <= FOVEA else math.exp(1 - distance / FOVEA)

    for episode in range(2):
        for f in range(12):
            total = 0.0
            for x in range(12):
                classes = belief.beta[episode, x, 1:].tolist()
                unknown = 1 - max(classes) / sum(classes)
                now = acuity(float(belief.closest[episode, x]))
                total += unknown * max(0.0, acuity(float(GRID.cell_distance[f, x])) - now)
            assert float(got[episode, f]) == pytest.approx(total, rel=1e-5, abs=1e-6)


def test_a_fovea_of_zero_width_is_refused():
    with pytest.raises(InputError, match="fovea"):
        CloserLook(GRID, 0.0)
