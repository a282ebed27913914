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


def parts(beta, episode, target):
    p = (beta[episode, :, target] / beta[episode].sum(-1)).tolist()
    rates = Misses.miss_rate[target, Misses().level(GRID.cell_distance)].tolist()
    return p, rates


@pytest.mark.parametrize("target", [1, torch.tensor([2, 1])])
def test_foveal_hit_equals_the_loop(beta, target):
    got = values_of(FovealHit(target, Misses(), GRID), beta)
    for episode in range(2):
        p, rates = parts(beta, episode, int(torch.as_tensor(target).expand(2)[episode]))
        for f in range(12):
            missed = math.prod(1 - p[x] * (1 - rates[f][x]) for x in range(12))
            assert float(got[episode, f]) == pytest.approx(1 - missed)


@pytest.mark.parametrize("target", [1, torch.tensor([2, 1])])
def test_information_is_the_expected_reduction_of_entropy(beta, target):
    got = values_of(PlaceInformation(target, Misses(), GRID), beta)
    for episode in range(2):
        p, rates = parts(beta, episode, int(torch.as_tensor(target).expand(2)[episode]))
        q = [value / sum(p) for value in p]
        for f in range(12):
            missed = [q[x] * rates[f][x] for x in range(12)]
            after = [value / sum(missed) for value in missed]
            expected = entropy(q) - sum(missed) * entropy(after)
            assert float(got[episode, f]) == pytest.approx(expected, abs=1e-9)
    assert (got > -1e-12).all()


def entropy(q):
    return -sum(value * math.log(value) for value in q if value > 0)


@pytest.mark.parametrize("kind", [FovealHit, PlaceInformation])
def test_values_of_a_batch_equal_a_loop_over_maps(kind):
    """Probabilities of the maps have different sums, and visibility is not symmetric."""
    generator = torch.Generator().manual_seed(1)
    present = torch.rand(3, 12, generator=generator, dtype=torch.float64) * torch.tensor([0.1, 0.5, 1.0])[:, None]
    visibility = torch.rand(3, 12, 12, generator=generator, dtype=torch.float64)
    got = kind(1, Misses(), GRID).values(present, visibility)
    for row in range(3):
        p, v = present[row].tolist(), visibility[row].tolist()
        for f in range(12):
            if kind is FovealHit:
                expected = 1 - math.prod(1 - p[x] * v[f][x] for x in range(12))
            else:
                q = [value / sum(p) for value in p]
                missed = [q[x] * (1 - v[f][x]) for x in range(12)]
                expected = entropy(q) - sum(missed) * entropy([value / sum(missed) for value in missed])
            assert float(got[row, f]) == pytest.approx(expected)
