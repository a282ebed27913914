"""Search acquisition functions that also count cells around the fixation, against loops and closed forms."""

import math

import pytest
import torch

from semfov.belief import Grid
from semfov.gaze.acquisition import FovealHit, PlaceInformation
from tests.small import values_of

GRID = Grid(4, 3, (80, 60))


class Misses:
    """Miss rates of two classes at three levels."""

    miss_rate = torch.tensor([[0.9, 0.9, 0.9], [0.1, 0.5, 1.0], [0.3, 0.6, 0.8]], dtype=torch.float64)

    def level(self, distance):
        return torch.bucketize(distance, torch.tensor([0.2, 0.5]))


@pytest.fixture
def beta():
    torch.manual_seed(0)
    return torch.rand(2, 12, 3, dtype=torch.float64) + 0.1


def entropy(q):
    return -sum(value * math.log(value) for value in q if value > 0)


def value_by_loop(kind, p, visible):
    """The value of a fixation, from the probability of the target in each cell and its visibility there."""
    if kind is FovealHit:
        return 1 - math.prod(1 - chance * seen for chance, seen in zip(p, visible, strict=True))
    q = [chance / sum(p) for chance in p]
    missed = [chance * (1 - seen) for chance, seen in zip(q, visible, strict=True)]
    return entropy(q) - sum(missed) * entropy([value / sum(missed) for value in missed])


@pytest.mark.parametrize("kind", [FovealHit, PlaceInformation])
@pytest.mark.parametrize("target", [1, torch.tensor([2, 1])])
def test_values_equal_a_loop(beta, target, kind):
    got = values_of(kind(target, Misses(), GRID), beta)
    for episode in range(2):
        k = int(torch.as_tensor(target).expand(2)[episode])
        p = (beta[episode, :, k] / beta[episode].sum(-1)).tolist()
        visible = (1 - Misses.miss_rate[k, Misses().level(GRID.cell_distance)]).tolist()
        for f in range(12):
            assert float(got[episode, f]) == pytest.approx(value_by_loop(kind, p, visible[f]), abs=1e-9)
    assert (got > -1e-12).all()


@pytest.mark.parametrize("kind", [FovealHit, PlaceInformation])
def test_values_of_a_batch_equal_a_loop_over_maps(kind):
    """Probabilities of the maps have different sums, and visibility is not symmetric."""
    generator = torch.Generator().manual_seed(1)
    present = torch.rand(3, 12, generator=generator, dtype=torch.float64) * torch.tensor([0.1, 0.5, 1.0])[:, None]
    visibility = torch.rand(3, 12, 12, generator=generator, dtype=torch.float64)
    got = kind(1, Misses(), GRID).values(present, visibility)
    for row in range(3):
        for f in range(12):
            expected = value_by_loop(kind, present[row].tolist(), visibility[row, f].tolist())
            assert float(got[row, f]) == pytest.approx(expected)
