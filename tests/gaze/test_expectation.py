"""The expectation over drawn looks: against integrals, enumeration, and the proof that it predicts nothing new."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, acquisition, dirichlet, fusion, policies
from semfov.gaze.acquisition.lookahead import look_ahead_by_samples, sampled_likelihoods
from semfov.gaze.policies import Policy
from semfov.runs.config import BeliefConfig, PolicyConfig
from semfov.runs.policy_looking import _make_strategy, _Models
from semfov.runs.presets import label, resolve
from tests.refusals import refused
from tests.small import draw as rand

GRID = Grid(3, 1, (90, 30))
BETA = torch.tensor([[1.0, 2.0], [3.0, 0.7], [0.5, 0.5]], dtype=torch.float64)
ALPHA = torch.tensor([[[4.0, 1.5], [2.5, 1.5]], [[1.5, 5.0], [1.2, 1.9]]], dtype=torch.float64)
UNSEEN = torch.zeros(3, dtype=torch.bool)


def two_classes(**settings):
    return FovealObservationModel(ALPHA, [0.4], ["cup"], epsilon=1e-9, **settings).requires_grad_(False).eval()


def four_classes(dtype=torch.float64):
    alpha = 0.5 + 3 * rand(4, 3, 4) + 2 * torch.eye(4, dtype=torch.float64)[:, None]
    model = FovealObservationModel(alpha.to(dtype), [0.2, 0.5], ("cat", "cup", "dog"), miss_rate=rand(4, 3).to(dtype))
    return model.requires_grad_(False).eval()


MEASURES = {
    "KLDivergence": lambda beta: dirichlet.kl_divergence(beta, torch.full((2,), 0.5, dtype=torch.float64)),
    "NegativeEntropy": lambda beta: torch.xlogy(beta / beta.sum(), beta / beta.sum()).sum(),
}


@pytest.mark.parametrize("calibrated", [True, False])
@pytest.mark.parametrize("name", MEASURES)
def test_values_are_integrals_over_the_scores(name, calibrated):
    """With two classes the scores have Beta densities, and the expectation is an integral."""
    measure = MEASURES[name]

    @cache
    def expected(cell, level):
        beta = BETA[cell]
        mean = beta / beta.sum()
        densities = [beta_distribution(*ALPHA[k, level].tolist()) for k in range(2)]

        def integrand(s):
            density = [float(each.pdf(s)) for each in densities]
            likelihood = torch.tensor(density if calibrated else [s, 1 - s], dtype=torch.float64)
            gain = measure(fusion.kaplan(beta, likelihood)) - measure(beta)
            return float(gain) * sum(float(p) * d for p, d in zip(mean, density, strict=True))

        return quad(integrand, 0, 1, limit=200, epsabs=1e-4, epsrel=1e-4)[0]

    model = two_classes()
    levels = model.level(GRID.cell_distance)
    exact = [sum(expected(x, int(levels[x, f])) for x in range(3)) for f in range(3)]
    drawn = sampled_likelihoods(model, 40_000, calibrated=calibrated)
    make = getattr(acquisition, name)
    got = make(model, GRID, likelihoods=drawn)(DirichletBelief(BETA), UNSEEN)
    assert got.tolist() == pytest.approx(exact, rel=0.03, abs=2e-3)
    plain = make(model, GRID)(DirichletBelief(BETA), UNSEEN)
    assert (plain - got).abs().max() > 0.02


def test_classes_are_drawn_as_often_as_they_are_probable():
    """Each likelihood names the class that it was drawn for, so that the draws can be counted."""
    samples, beta = 40, rand(5, 6) + 0.05
    marked = torch.eye(6, dtype=torch.float64)[:, None, None].expand(6, 2, samples, 6)
    for turn in range(7):
        visited = torch.arange(5) < min(turn, 5)
        outlook = look_ahead_by_samples(beta, marked, visited)
        drawn = (outlook.likelihood > 0).double().unflatten(-2, (2, samples)).sum(-2)
        assert torch.equal(drawn[:, 0], drawn[:, 1])
        assert ((drawn[:, 0] / samples - outlook.mean).abs() <= 1 / samples).all()
    # Over many turns a class that is rarer than one draw is drawn as often as it is probable, too.
    rare = torch.tensor([[0.004, 0.006, 0.99]], dtype=torch.float64)
    marked = torch.eye(3, dtype=torch.float64)[:, None, None].expand(3, 1, 8, 3)
    turns = [look_ahead_by_samples(rare, marked, torch.arange(600) < turn) for turn in range(600)]
    share = torch.stack([(each.likelihood[0] > 0).double().mean(0) for each in turns]).mean(0)
    assert share.tolist() == pytest.approx(rare[0].tolist(), abs=5e-4)


@pytest.mark.parametrize("name", ["KLDivergence", "BayesianSurprise", "NegativeEntropy", "TwoPeaks"])
def test_values_approach_the_sum_over_all_classes_and_looks(name):
    """With M equal looks of each class, the mean over classes can be enumerated: one lookahead for each class."""
    model, beta = four_classes(), 0.3 + 4 * rand(3, 4, seed=1) ** 2
    single = sampled_likelihoods(model, 1)
    make = getattr(acquisition, name)
    got = make(model, GRID, likelihoods=single.expand(4, 3, 5000, 4))
    values = [make(model, GRID, likelihoods=single[k : k + 1].expand(4, 3, 1, 4)) for k in range(4)]
    mean = beta / beta.sum(-1, keepdim=True)
    after = [each.cell_values(look_ahead_by_samples(beta, each.likelihoods, UNSEEN)) for each in values]
    cells = [looks - each.present(beta)[..., None] for looks, each in zip(after, values, strict=True)]
    exact = sum(mean[:, k, None] * cells[k] for k in range(4))
    levels = model.level(GRID.cell_distance)
    seen = torch.stack([exact[x, levels[x]] for x in range(3)])
    expected = seen.amax(0) if name == "TwoPeaks" else seen.sum(0)
    assert got(DirichletBelief(beta), UNSEEN).tolist() == pytest.approx(expected.tolist(), rel=2e-3)


def test_predictive_search_by_samples_of_true_likelihoods_equals_non_predictive_search():
    model, beta = four_classes(), 0.3 + 4 * rand(2, 3, 4, seed=1) ** 2
    belief, visited = DirichletBelief(beta), torch.zeros(2, 3, dtype=torch.bool)
    targets = torch.tensor([2, 1])
    drawn = sampled_likelihoods(model, 30_000)
    got = acquisition.PredictedTargetPosterior(targets, model, likelihoods=drawn)(belief, visited)
    plain = acquisition.TargetPosterior(targets)(belief, visited)
    assert torch.allclose(got, plain, atol=2e-3)
    assert not torch.allclose(acquisition.PredictedTargetPosterior(targets, model)(belief, visited), plain, atol=5e-3)


@pytest.mark.parametrize("name", ["KLDivergence", "NegativeEntropy", "PredictedTargetPosterior"])
def test_episodes_do_not_depend_on_their_batch(name, dtype):
    model, beta = four_classes(dtype), (0.3 + 4 * rand(5, 3, 4, seed=1) ** 2).to(dtype)
    visited = torch.arange(3).expand(5, 3) < torch.tensor([0, 1, 2, 1, 0])[:, None]
    drawn = sampled_likelihoods(model, 16)
    make = getattr(acquisition, name)
    value = make(2, model, likelihoods=drawn) if name.startswith("P") else make(model, GRID, likelihoods=drawn)
    together = value(DirichletBelief(beta), visited)
    assert together.dtype == dtype
    assert together.isfinite().all()
    for row in range(5):
        alone = value(DirichletBelief(beta[row : row + 1]), visited[row : row + 1])
        assert torch.equal(alone[0], together[row])
    # The points at which classes are drawn move with the number of visited cells.
    assert not torch.equal(value(DirichletBelief(beta[:1]), visited[1:2]), together[:1])


def test_looks_are_drawn_from_the_dirichlets_by_a_seed():
    model = four_classes()
    scores = sampled_likelihoods(model, 20_000, calibrated=False)
    mean = model.alpha / model.alpha.sum(-1, keepdim=True)
    assert torch.allclose(scores.mean(2), mean, atol=0.01)
    spread = dirichlet.covariance(model.alpha).diagonal(dim1=-2, dim2=-1).sqrt()
    assert torch.allclose(scores.std(2), spread, atol=0.01)
    calibrated = sampled_likelihoods(model, 9)
    for level, distance in enumerate((0.1, 0.3, 0.9)):
        plain = sampled_likelihoods(model, 9, calibrated=False)[:, level]
        expected = model.calibrate(plain, plain.new_full(plain.shape[:-1], distance))
        assert torch.allclose(calibrated[:, level], expected)
    assert torch.equal(calibrated, sampled_likelihoods(model, 9))
    assert not torch.equal(calibrated, sampled_likelihoods(model, 9, seed=1))


def test_models_of_the_posterior_and_no_samples_are_refused():
    with pytest.raises(InputError, match="model: expected an observation model whose Dirichlets are densities"):
        sampled_likelihoods(two_classes(expected=torch.full((2, 2, 2), 0.5, dtype=torch.float64)), 4)
    refused("samples: expected a whole number from 1 to 65,536, got 0", policies.Policy, "kl", two_classes(), samples=0)
    refused("likelihoods", look_ahead_by_samples, torch.ones(3, 5), sampled_likelihoods(two_classes(), 4), UNSEEN)


def test_policies_take_the_expectation_by_their_settings():
    model = four_classes()
    for name, kind in acquisition.FUNCTIONS.items():
        if "likelihoods" in kind.takes:
            made = Policy(name, model, samples=4, calibrated=False)(1, GRID)
            assert torch.equal(made.likelihoods, sampled_likelihoods(model, 4, calibrated=False))
            assert Policy(name, model)(1, GRID).likelihoods is None
    refused("samples: expected None for policy 'random', which predicts no look, got 4", Policy, "random", samples=4)
    settings = PolicyConfig("kl", "calibrated", samples=8)
    assert label(settings, "exploration") == "kl-calibrated, samples 8"
    for scores in ("raw", "calibrated"):
        chosen = replace(settings, scores=scores)
        strategy = _make_strategy(chosen, "exploration", BeliefConfig(), 4, _Models(model), 0.1)
        expected = sampled_likelihoods(model, 8, calibrated=scores == "calibrated")
        assert torch.equal(strategy.policy.likelihoods, expected)
    with pytest.raises(InputError, match="samples: expected null, except for predictive; got 8 for 'neighbourhood'"):
        resolve(PolicyConfig("neighbourhood", samples=8), "search")
