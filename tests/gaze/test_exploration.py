"""Exploration against a brute force that updates every cell for every fixation, one by one."""

from functools import partial

import pytest
import torch
from scipy import stats

from semfov import FovealObservationModel, Grid, InputError, fusion
from semfov.gaze.acquisition import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.lookahead import sampled_likelihoods
from tests.small import rand, values_of

ACQUISITIONS = {
    "kl": KLDivergence,
    "surprise": BayesianSurprise,
    "negative entropy": NegativeEntropy,
    "two peaks": TwoPeaks,
    "upper confidence bound": UpperConfidenceBound,
    "probability of improvement": ProbabilityOfImprovement,
}
GRIDS = {"wide": Grid(4, 2, (64, 30)), "tall": Grid(2, 5, (30, 70)), "row": Grid(3, 1, (9, 9))}
CLASSES = ("cat", "cup", "dog", "hat")


# Divergences from the prior sum to some tens over the map; one look changes the sum by about a thousandth.
ROUNDING = {torch.float64: 1e-11, torch.float32: 1e-4}


def entropy(p):
    return -float((p * p.log()).sum())


def lead(p):
    first, second = p.sort(descending=True).values[:2]
    return float(first - second)


def bound(beta, kappa=2.0):
    p, total = float(beta.max() / beta.sum()), float(beta.sum())
    return p + kappa * (p * (1 - p) / (total + 1)) ** 0.5


def improvement(before, after, margin=0.0):
    p, total = float(after.max() / after.sum()), float(after.sum())
    deviation = (p * (1 - p) / (total + 1)) ** 0.5
    return float(stats.norm.cdf((p - float(before.max() / before.sum()) - margin) / deviation))


def from_prior(beta):
    one, other = torch.distributions.Dirichlet(beta), torch.distributions.Dirichlet(torch.full_like(beta, 0.5))
    return float(torch.distributions.kl_divergence(one, other))


def mean_kl(before, after):
    return float(stats.entropy(after / after.sum(), before / before.sum()))


def normal(beta):
    return beta / beta.sum()


CHANGES = {
    "kl": lambda before, after: from_prior(after) - from_prior(before),
    "surprise": mean_kl,
    "negative entropy": lambda before, after: entropy(normal(before)) - entropy(normal(after)),
    "two peaks": lambda before, after: abs(lead(normal(after)) - lead(normal(before))),
    "upper confidence bound": lambda before, after: bound(after) - bound(before),
    "probability of improvement": improvement,
}


def brute_force(name, beta, model, grid):
    """Values of all fixations for one belief, by the formulas and (X·Y)² simulated updates."""
    values = []
    for fixation in range(len(grid)):
        changes = []
        for cell in range(len(grid)):
            offset = grid.centres[cell].double() - grid.centres[fixation].double()
            distance = offset.norm() / float(grid.extent.max())
            level = int((model.edges < distance).sum())
            scores = normal(beta[cell]) @ model.expected_scores()[:, level]
            changes.append(CHANGES[name](beta[cell], fusion.kaplan(beta[cell], scores)))
        values.append(max(changes) if name == "two peaks" else sum(changes))
    return torch.tensor(values, dtype=torch.float64)


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


@pytest.mark.parametrize("shape", GRIDS)
@pytest.mark.parametrize("name", ACQUISITIONS)
def test_equals_brute_force(name, shape, model):
    grid = GRIDS[shape]
    acquisition = ACQUISITIONS[name](model, grid)
    beta = beliefs(grid, batch=2).float()
    expected = torch.stack([brute_force(name, row.double(), model, grid) for row in beta])
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        values = values_of(acquisition, beta.to(dtype))
        assert values.dtype == dtype
        torch.testing.assert_close(values.double(), expected, rtol=tolerance, atol=ROUNDING[dtype])


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
    acquisition, beta = ACQUISITIONS[name](model, GRIDS["tall"]), beliefs(GRIDS["tall"], batch=4)
    together = values_of(acquisition, beta.view(2, 2, 10, 5)).flatten(0, 1)
    torch.testing.assert_close(torch.stack([values_of(acquisition, row) for row in beta]), together)


@pytest.mark.parametrize("name", ACQUISITIONS)
def test_every_image_of_a_batch_has_its_own_distances(name, model):
    sizes = torch.tensor([[64.0, 30.0], [30.0, 90.0]])
    beta = beliefs(Grid(4, 2, (64, 30)), batch=2)
    both = values_of(ACQUISITIONS[name](model, Grid(4, 2, sizes)), beta)
    for row, size in enumerate(sizes.tolist()):
        alone = values_of(ACQUISITIONS[name](model, Grid(4, 2, tuple(size))), beta[row])
        torch.testing.assert_close(both[row], alone)


def test_small_divergences_are_accurate_in_single_precision(model):
    """A nearly certain belief changes very little; the change must stay larger than rounding errors."""
    grid = GRIDS["wide"]
    beta = (beliefs(grid) * 3000).float().double()
    for name in ("surprise", "negative entropy"):
        acquisition = ACQUISITIONS[name](model, grid)
        single, double = (values_of(acquisition, given) for given in (beta.float(), beta))
        torch.testing.assert_close(single.double(), double, rtol=1e-2, atol=0)


def test_bad_arguments(model):
    grid = GRIDS["wide"]
    with pytest.raises(InputError, match="classes"):
        values_of(KLDivergence(model, grid), torch.ones(1, 8, 4))
    with pytest.raises(InputError, match="prior"):
        KLDivergence(model, grid, prior=0.0)
    with pytest.raises(InputError, match="kappa"):
        UpperConfidenceBound(model, grid, kappa=-1.0)
    with pytest.raises(InputError, match="margin"):
        ProbabilityOfImprovement(model, grid, margin=1.0)


@pytest.mark.parametrize("kappa", [0.0, 0.5, 3.0])
def test_the_bound_is_kappa_standard_deviations_above_the_mean(kappa, model, monkeypatch):
    name = "upper confidence bound"
    monkeypatch.setitem(CHANGES, name, lambda before, after: bound(after, kappa) - bound(before, kappa))
    grid, beta = GRIDS["row"], beliefs(GRIDS["row"], batch=1)
    got = values_of(UpperConfidenceBound(model, grid, kappa=kappa), beta)
    torch.testing.assert_close(got[0], brute_force(name, beta[0], model, grid))


@pytest.mark.parametrize("margin", [0.01, 0.2])
def test_an_improvement_by_a_margin_is_less_likely(margin, model, monkeypatch):
    monkeypatch.setitem(CHANGES, "probability of improvement", partial(improvement, margin=margin))
    grid, beta = GRIDS["row"], beliefs(GRIDS["row"], batch=1)
    got = values_of(ProbabilityOfImprovement(model, grid, margin=margin), beta)
    torch.testing.assert_close(got[0], brute_force("probability of improvement", beta[0], model, grid))
    assert bool((got < values_of(ProbabilityOfImprovement(model, grid), beta)).all())
