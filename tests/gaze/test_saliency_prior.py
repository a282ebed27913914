"""Saliency as a prior over cells: against a loop, and cases where it should have no effect."""

import math

import pytest
import torch

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError
from semfov.gaze.acquisition import (
    AcquisitionFunction,
    BayesianSurprise,
    SaliencyPrior,
    Static,
    TargetPosterior,
    TwoPeaks,
)
from tests.refusals import refused
from tests.small import draw as rand

GRID = Grid(4, 3, (80, 60))


BELIEF = DirichletBelief(0.3 + 4 * rand(3, 12, 5) ** 2)
NOWHERE = torch.zeros(3, 12, dtype=torch.bool)
SALIENCY = rand(3, 12, seed=1) ** 3


def values(acquisition):
    return acquisition(BELIEF, NOWHERE)


def surprise():
    alpha = 0.5 + 3 * rand(5, 2, 5) + 2 * torch.eye(5, dtype=torch.float64)[:, None]
    model = FovealObservationModel(alpha, [0.3], ("cat", "cup", "dog", "hat")).requires_grad_(False)
    return BayesianSurprise(model, GRID)


def two_peaks():
    return TwoPeaks(surprise().model, GRID)


ACQUISITIONS = {"target": lambda: TargetPosterior(2), "surprise": surprise, "two peaks": two_peaks}


@pytest.mark.parametrize("weight", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("name", ACQUISITIONS)
def test_value_equals_the_loop(name, weight):
    plain, got = values(ACQUISITIONS[name]()), values(SaliencyPrior(ACQUISITIONS[name](), SALIENCY, weight=weight))
    for row in range(3):
        epsilon = 1e-3 * max(SALIENCY[row].tolist())
        total = sum(s + epsilon for s in SALIENCY[row].tolist())
        for cell in range(12):
            prior = math.log((float(SALIENCY[row, cell]) + epsilon) / total)
            expected = math.log(float(plain[row, cell])) + weight * prior
            assert float(got[row, cell]) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("level", [0.0, 1e-12, 0.4, 1e6])
@pytest.mark.parametrize("name", ACQUISITIONS)
def test_uniform_saliency_changes_nothing(name, level):
    """Also if it is zero everywhere, as in an image without contrast."""
    flat = torch.full((12,), level, dtype=torch.float64)
    plain, guided = values(ACQUISITIONS[name]()), values(SaliencyPrior(ACQUISITIONS[name](), flat, weight=0.7))
    torch.testing.assert_close(guided - guided.mean(-1, keepdim=True), plain.log() - plain.log().mean(-1, keepdim=True))


def test_one_saliency_map_applies_to_all_episodes():
    one = values(SaliencyPrior(TargetPosterior(2), SALIENCY[1], weight=0.3))
    each = values(SaliencyPrior(TargetPosterior(2), SALIENCY[1].expand(3, 12), weight=0.3))
    assert torch.equal(one, each)


def test_cells_whose_value_is_not_positive_come_last():
    """Such a value has no logarithm: it counts as a very small positive one, and gives no NaN."""
    worth = torch.tensor([0.5, 0.0, -3.0, 1e-9])
    guided = SaliencyPrior(Static(worth), torch.tensor([0.0, 1.0, 1.0, 1.0]), weight=0.3)
    got = guided(DirichletBelief(torch.ones(1, 4, 2)), torch.zeros(1, 4, dtype=torch.bool))
    assert bool(got.isfinite().all())
    assert got.argsort(-1, descending=True)[0, :2].tolist() == [0, 3]
    assert got[0, 1] == got[0, 2]


def test_bad_arguments():
    refused("weight", SaliencyPrior, TargetPosterior(2), SALIENCY, weight=-0.1)
    refused("saliency: expected numbers of 0 or more", SaliencyPrior, TargetPosterior(2), -SALIENCY, weight=0.3)
    with pytest.raises(InputError, match="saliency: expected numbers of 0 or more"):
        SaliencyPrior(TargetPosterior(2), SALIENCY * math.nan, weight=0.3)
    refused("saliency", values, SaliencyPrior(TargetPosterior(2), SALIENCY[:, :7], weight=0.3))


def test_visited_cells_are_passed_to_the_acquisition():
    class Unvisited(AcquisitionFunction):
        def forward(self, belief, visited):
            return torch.where(visited, 1.0, 2.0).double()

    visited = torch.tensor([[True, False] * 6] * 3)
    got = SaliencyPrior(Unvisited(), SALIENCY, weight=0.0)(BELIEF, visited)
    torch.testing.assert_close(got.exp(), torch.where(visited, 1.0, 2.0).double())
