"""Search acquisition functions against a loop over cells that simulates every update."""

import math

import pytest
import torch

from semfov.belief import Grid, fusion
from semfov.errors import InputError
from semfov.gaze.acquisition import NeighbourhoodPosterior, PredictedTargetPosterior, Static, TargetPosterior, Uniform
from tests.small import values_of

GRID = Grid(3, 2, (30, 20))


class Model:
    """Expected scores from a table."""

    def __init__(self, classes: int) -> None:
        generator = torch.Generator().manual_seed(classes)
        self.table = torch.rand(classes, 3, classes, generator=generator).double().softmax(-1)

    def level(self, distance):
        return torch.bucketize(distance, torch.tensor([0.2, 0.5]))

    def expected_scores(self):
        return self.table


@pytest.fixture
def beta():
    torch.manual_seed(0)
    return torch.rand(4, 6, 5, dtype=torch.float64) * 3 + 0.1


def test_target_posterior(beta):
    targets = torch.tensor([1, 4, 2, 3])
    got = values_of(TargetPosterior(targets), beta)
    for episode, target in enumerate(targets.tolist()):
        for cell in range(6):
            expected = beta[episode, cell, target] / beta[episode, cell].sum()
            torch.testing.assert_close(got[episode, cell], expected)
    torch.testing.assert_close(values_of(TargetPosterior(4), beta[1]), got[1])


def test_predicted_posterior_equals_a_simulated_update(beta):
    model, targets = Model(5), torch.tensor([1, 4, 2, 3])
    got = values_of(PredictedTargetPosterior(targets, model), beta)
    for episode, target in enumerate(targets.tolist()):
        for cell in range(6):
            belief = beta[episode, cell]
            scores = sum(p * model.table[k, 0] for k, p in enumerate(belief / belief.sum()))
            after = fusion.kaplan(belief, scores)
            torch.testing.assert_close(got[episode, cell], after[target] / after.sum())


def test_static_and_uniform(beta):
    assert values_of(Uniform(), beta).tolist() == [[0.0] * 6] * 4
    values = torch.arange(6.0)
    assert torch.equal(values_of(Static(values), beta), values.expand(4, 6))
    with pytest.raises(InputError, match="values"):
        values_of(Static(torch.arange(5.0)), beta)


@pytest.mark.parametrize("target", [-1, 5])
def test_unknown_target(beta, target):
    with pytest.raises(InputError, match="target"):
        values_of(TargetPosterior(target), beta)


@pytest.mark.parametrize("sigma", [None, 0.4])
def test_neighbourhood_equals_the_loop(beta, sigma):
    """The default width is 0.7 cells."""
    model, told = Model(5), {} if sigma is None else {"sigma": sigma}
    acquisition = NeighbourhoodPosterior(3, model, GRID, **told)
    got = values_of(acquisition, beta)
    torch.testing.assert_close(values_of(acquisition, beta[1]), got[1])
    for episode in range(4):
        for fixation in range(6):
            total = 0.0
            for cell in range(6):
                down, across = cell // 3 - fixation // 3, cell % 3 - fixation % 3
                level = int(model.level(GRID.cell_distance[fixation, cell]))
                belief = beta[episode, cell]
                scores = sum(p * model.table[k, level] for k, p in enumerate(belief / belief.sum()))
                after = fusion.kaplan(belief, scores)
                weight = math.exp(-(down**2 + across**2) / (2 * (sigma or 0.7) ** 2))
                total += weight * float(after[3] / after.sum())
            assert float(got[episode, fixation]) == pytest.approx(total, rel=1e-6)


def test_a_neighbourhood_of_zero_width_is_refused():
    with pytest.raises(InputError, match=r"^sigma:"):
        NeighbourhoodPosterior(3, Model(5), GRID, sigma=0.0)
