"""Batches, blocks, precision and errors of exploration; `test_published_equations` has the values."""

import pytest
import torch

from semfov import FovealObservationModel, Grid
from semfov.gaze.acquisition import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.lookahead import sampled_likelihoods
from tests.refusals import refused
from tests.small import rand, values_of

ACQUISITIONS = {
    "kl": KLDivergence,
    "surprise": BayesianSurprise,
    "negative entropy": NegativeEntropy,
    "two peaks": TwoPeaks,
    "upper confidence bound": UpperConfidenceBound,
    "probability of improvement": ProbabilityOfImprovement,
}
WIDE, TALL = Grid(4, 2, (64, 30)), Grid(2, 5, (30, 70))
CLASSES = ("cat", "cup", "dog", "hat")


@pytest.fixture
def model():
    generator = torch.Generator().manual_seed(3)
    alpha = torch.rand(5, 3, 5, generator=generator).double() + 0.2
    alpha += 4 * torch.eye(5).double()[:, None] / torch.arange(1, 4)[None, :, None]
    prior = torch.randn(5, 3, generator=generator).double()
    edges = torch.tensor([0.2, 0.45]).double()
    return FovealObservationModel(alpha, edges, CLASSES, log_prior=prior, tempering=0.7).requires_grad_(False).eval()


def beliefs(grid, batch=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, len(grid), 5, generator=generator).double() ** 3 * 4 + 0.1


@pytest.mark.parametrize("samples", [0, 3])
def test_blocks_of_cells_change_no_bit(model, samples, monkeypatch):
    drawn = sampled_likelihoods(model, samples) if samples else None
    value = KLDivergence(model, Grid(5, 4, (100, 80)), likelihoods=drawn)
    beta = 0.5 + rand(20, len(model.classes) + 1)
    expected = values_of(value, beta)
    monkeypatch.setattr("semfov.gaze.acquisition.lookahead._BLOCK", 100)
    assert torch.equal(values_of(value, beta), expected)


@pytest.mark.parametrize("name", ACQUISITIONS)
def test_a_batch_may_have_any_number_of_dimensions(name, model):
    acquisition, beta = ACQUISITIONS[name](model, TALL), beliefs(TALL, batch=4)
    together = values_of(acquisition, beta.view(2, 2, 10, 5)).flatten(0, 1)
    torch.testing.assert_close(torch.stack([values_of(acquisition, row) for row in beta]), together)


@pytest.mark.parametrize("name", ACQUISITIONS)
def test_every_image_of_a_batch_has_its_own_distances(name, model):
    sizes = torch.tensor([[64.0, 30.0], [30.0, 90.0]])
    beta = beliefs(WIDE, batch=2)
    both = values_of(ACQUISITIONS[name](model, Grid(4, 2, sizes)), beta)
    for row, size in enumerate(sizes.tolist()):
        alone = values_of(ACQUISITIONS[name](model, Grid(4, 2, tuple(size))), beta[row])
        torch.testing.assert_close(both[row], alone)


def test_small_divergences_are_accurate_in_single_precision(model):
    """A nearly certain belief changes very little; the change must stay larger than rounding errors."""
    grid = WIDE
    beta = (beliefs(grid) * 3000).float().double()
    for name in ("surprise", "negative entropy"):
        acquisition = ACQUISITIONS[name](model, grid)
        single, double = (values_of(acquisition, given) for given in (beta.float(), beta))
        torch.testing.assert_close(single.double(), double, rtol=1e-2, atol=0)


def test_bad_arguments(model):
    grid = WIDE
    refused("classes", values_of, KLDivergence(model, grid), torch.ones(1, 8, 4))
    refused("prior", KLDivergence, model, grid, prior=0.0)
    refused("kappa", UpperConfidenceBound, model, grid, kappa=-1.0)
    refused("margin", ProbabilityOfImprovement, model, grid, margin=1.0)
