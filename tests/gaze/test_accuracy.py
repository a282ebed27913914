"""Expected accuracy against a loop over fixations, cells and classes."""

import pytest
import torch

from semfov.belief import Grid
from semfov.gaze.acquisition import ExpectedAccuracy
from tests.small import values_of

GRID = Grid(4, 3, (80, 60))


class Model:
    """Two classes at three levels."""

    miss_rate = torch.tensor([[0.9, 0.9, 0.9], [0.1, 0.5, 0.9], [0.3, 0.6, 0.8]], dtype=torch.float64)

    def level(self, distance):
        return torch.bucketize(distance, torch.tensor([0.2, 0.5]))

    def expected_scores(self):
        torch.manual_seed(3)
        return (4 * torch.eye(3)[:, None] + torch.rand(3, 3, 3)).double().softmax(-1)


@pytest.fixture
def beta():
    torch.manual_seed(0)
    return torch.rand(2, 12, 3, dtype=torch.float64) ** 2 + 0.02


def test_value_equals_the_loop(beta):
    acquisition = ExpectedAccuracy(Model(), GRID)
    got = values_of(acquisition, beta)
    torch.testing.assert_close(values_of(acquisition, beta[0]), got[0])
    right, levels = Model().expected_scores(), Model().level(GRID.cell_distance)
    for episode in range(2):
        p = beta[episode] / beta[episode].sum(-1, keepdim=True)
        for f in range(12):
            total = 0.0
            for x in range(12):
                n = int(levels[f, x])
                seen = sum(float(p[x, k] * (1 - Model.miss_rate[k, n]) * right[k, n, k]) for k in (1, 2))
                missed = max(float(p[x, k] * Model.miss_rate[k, n]) for k in (1, 2))
                total += max(0.0, seen + missed - float(p[x, 1:].max()))
            assert float(got[episode, f]) == pytest.approx(total)
