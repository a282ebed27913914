"""Acquisition functions that look ahead, by an observation model, against loops and integrals."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution

from semfov import (
    Detections,
    DirichletBelief,
    FovealObservationModel,
    Grid,
    InputError,
    acquisition,
    dirichlet,
    fusion,
    policies,
)
from semfov.belief.observers import SemanticMap
from semfov.gaze.acquisition import (
    BayesianSurprise,
    ExpectedAccuracy,
    ExpectedGain,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.accuracy import _CORRECTED
from semfov.gaze.acquisition.lookahead import look_ahead_by_samples, sampled_likelihoods
from semfov.gaze.policies import Policy
from semfov.runs.config import BeliefConfig, PolicyConfig
from semfov.runs.policy_looking import _make_strategy
from semfov.runs.presets import label, presets, resolve
from semfov.strategy import Strategy
from tests import small
from tests.refusals import refused
from tests.small import draw, rand, values_of

GRID, CELLS = Grid(5, 4, (50, 40)), Grid(4, 3, (80, 60))


@pytest.fixture
def model():
    return small.model().requires_grad_(False)


def belief_of(model, dtype=torch.float32, device=None):
    """Beliefs of three episodes after two looks."""
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(3, 4, 2, generator=generator) * 30
    boxes = torch.cat([corner, corner + 3 + torch.rand(3, 4, 2, generator=generator) * 15], -1)
    scores = (3 * torch.rand(3, 4, 4, generator=generator)).softmax(-1)
    seen = Detections(boxes.to(device, dtype), scores.to(device, dtype), torch.ones(3, 4, dtype=bool, device=device))
    observer = SemanticMap(model)
    belief, visited = observer.start(3, GRID, seen.scores), torch.zeros(3, 20, dtype=torch.bool, device=device)
    for cells in ([0, 7, 19], [4, 8, 2]):
        belief = observer(belief, seen, GRID.centres[cells].to(seen.boxes), GRID)
        visited[[0, 1, 2], cells] = True
    return belief, visited


def test_gain_is_summed_over_all_cells(model, dtype, device):
    model = model.to(device, dtype)
    belief, visited = belief_of(model, dtype, device)
    got = ExpectedGain(GRID, 0.2).to(device)(belief, visited)
    assert got.shape == (3, 20)
    assert got.dtype == dtype
    assert got.device.type == device.type
    centres, probabilities = GRID.centres.tolist(), belief.class_probabilities().tolist()
    closest, gains = belief.closest.tolist(), got.tolist()
    for episode in range(3):
        for fixation in range(20):
            total = 0.0
            for cell in range(20):
                now = math.dist(centres[cell], centres[fixation]) / 50
                wrong = 1 - max(probabilities[episode][cell])
                sharper = math.exp(-max(now / 0.2 - 1, 0)) - math.exp(-max(closest[episode][cell] / 0.2 - 1, 0))
                total += _CORRECTED * wrong * max(sharper, 0)
            assert gains[episode][fixation] == pytest.approx(total, abs=1e-4)
    # A second look at the same cell gains nothing.
    assert float(got[visited].abs().max()) < 1e-6


def test_before_the_first_look_every_cell_gains():
    belief = DirichletBelief(torch.ones(1, 20, 4))
    got = ExpectedGain(GRID, 10.0)(belief, torch.zeros(1, 20, dtype=torch.bool))
    # A fovea as wide as the image sees all cells.
    torch.testing.assert_close(got, torch.full((1, 20), 20 * 0.75 * _CORRECTED))
    refused("fovea: expected a positive number", ExpectedGain, GRID, 0.0)
    refused("grid: expected a Grid, got Linear", ExpectedGain, torch.nn.Linear(1, 1), GRID)


LEARNED = {
    "random-learned": PolicyConfig("random", "learned"),
    "closer-look-learned": PolicyConfig("closer-look", "learned"),
    "expected-gain-learned": PolicyConfig("expected-gain", "learned"),
    "vocus2-learned": PolicyConfig("saliency", "learned", saliency="vocus2"),
    "itti-koch-learned": PolicyConfig("saliency", "learned", saliency="itti-koch"),
}


DIRICHLET = ("kl", "negative-entropy", "surprise", "two-peaks")


@pytest.mark.parametrize(
    ("task", "policy", "scores", "expected"),
    [
        *(("exploration", policy, "learned", "expected 'raw' or 'calibrated' for policy") for policy in DIRICHLET),
        *(("search", policy, "learned", ".*") for policy in ("random", "predictive", "neighbourhood")),
    ],
)
def test_policies_refuse_scores_of_another_belief(task, policy, scores, expected):
    """Policies that predict looks need the model that the scores of the belief are calibrated by."""
    refused(f"^scores: {expected} ?'{policy}', got '{scores}'", resolve, PolicyConfig(policy, scores), task)
    if task == "exploration":
        assert f"{policy}-{scores}" not in presets(task)
        refused("policy", resolve, f"{policy}-{scores}", task)


@pytest.mark.parametrize(
    "setting", [{"tempering": 0.5}, {"footprint": "soft"}, {"memory": "closest"}, {"misses": True}], ids=str
)
@pytest.mark.parametrize("policy", sorted(LEARNED))
def test_settings_of_another_belief_are_refused(policy, setting):
    own = LEARNED[policy]
    with pytest.raises(InputError, match=f"^{next(iter(setting))}: expected null, .*has its own belief"):
        resolve(PolicyConfig(own.policy, "learned", saliency=own.saliency, **setting), "exploration")


def test_strategies_of_semantic_maps(model):
    def strategy(name, **models):
        return _make_strategy(resolve(name, "exploration"), "exploration", BeliefConfig(), 4, models.__getitem__, 0.15)

    for name, policy in LEARNED.items():
        made = strategy(name, map=model)
        assert isinstance(made, Strategy)
        assert isinstance(made.observer, SemanticMap)
        assert made.observer.model is model
        assert made.policy.name == policy.policy
        with pytest.raises(KeyError, match="map"):
            strategy(name, observation=FovealObservationModel.identity(["a", "b", "c"], [0.2]))
    assert strategy("closer-look-learned", map=model).policy.fovea == 0.15


def test_a_grid_in_double_precision_works_with_a_belief_in_single_precision(model):
    belief, visited = belief_of(model)
    wide = ExpectedGain(Grid(5, 4, torch.tensor([50.0, 40.0], dtype=torch.float64)))
    torch.testing.assert_close(wide(belief, visited), ExpectedGain(GRID)(belief, visited))


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
    acquisition = ExpectedAccuracy(Model(), CELLS)
    got = values_of(acquisition, beta)
    torch.testing.assert_close(values_of(acquisition, beta[0]), got[0])
    right, levels = Model().expected_scores(), Model().level(CELLS.cell_distance)
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


ROW = Grid(3, 1, (90, 30))
BETA = torch.tensor([[1.0, 2.0], [3.0, 0.7], [0.5, 0.5]], dtype=torch.float64)
ALPHA = torch.tensor([[[4.0, 1.5], [2.5, 1.5]], [[1.5, 5.0], [1.2, 1.9]]], dtype=torch.float64)
UNSEEN = torch.zeros(3, dtype=torch.bool)


def two_classes(**settings):
    return FovealObservationModel(ALPHA, [0.4], ["cup"], epsilon=1e-9, **settings).requires_grad_(False).eval()


def four_classes(dtype=torch.float64):
    alpha = 0.5 + 3 * draw(4, 3, 4) + 2 * torch.eye(4, dtype=torch.float64)[:, None]
    model = FovealObservationModel(alpha.to(dtype), [0.2, 0.5], ("cat", "cup", "dog"), miss_rate=draw(4, 3).to(dtype))
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

        return quad(integrand, 0, 1, limit=200, epsabs=1e-3, epsrel=1e-3)[0]

    model = two_classes()
    levels = model.level(ROW.cell_distance)
    exact = [sum(expected(x, int(levels[x, f])) for x in range(3)) for f in range(3)]
    drawn = sampled_likelihoods(model, 40_000, calibrated=calibrated)
    make = getattr(acquisition, name)
    got = make(model, ROW, likelihoods=drawn)(DirichletBelief(BETA), UNSEEN)
    assert got.tolist() == pytest.approx(exact, rel=0.03, abs=2e-3)
    plain = make(model, ROW)(DirichletBelief(BETA), UNSEEN)
    assert (plain - got).abs().max() > 0.02


def test_classes_are_drawn_as_often_as_they_are_probable():
    """Each likelihood names the class that it was drawn for, so that the draws can be counted."""
    samples, beta = 40, draw(5, 6) + 0.05
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
    model, beta = four_classes(), 0.3 + 4 * draw(3, 4, seed=1) ** 2
    single = sampled_likelihoods(model, 1)
    make = getattr(acquisition, name)
    got = make(model, ROW, likelihoods=single.expand(4, 3, 5000, 4))
    values = [make(model, ROW, likelihoods=single[k : k + 1].expand(4, 3, 1, 4)) for k in range(4)]
    mean = beta / beta.sum(-1, keepdim=True)
    after = [each.cell_values(look_ahead_by_samples(beta, each.likelihoods, UNSEEN)) for each in values]
    cells = [looks - each.present(beta)[..., None] for looks, each in zip(after, values, strict=True)]
    exact = sum(mean[:, k, None] * cells[k] for k in range(4))
    levels = model.level(ROW.cell_distance)
    seen = torch.stack([exact[x, levels[x]] for x in range(3)])
    expected = seen.amax(0) if name == "TwoPeaks" else seen.sum(0)
    assert got(DirichletBelief(beta), UNSEEN).tolist() == pytest.approx(expected.tolist(), rel=2e-3)


def test_predictive_search_by_samples_of_true_likelihoods_equals_non_predictive_search():
    model, beta = four_classes(), 0.3 + 4 * draw(2, 3, 4, seed=1) ** 2
    belief, visited = DirichletBelief(beta), torch.zeros(2, 3, dtype=torch.bool)
    targets = torch.tensor([2, 1])
    drawn = sampled_likelihoods(model, 30_000)
    got = acquisition.PredictedTargetPosterior(targets, model, likelihoods=drawn)(belief, visited)
    plain = acquisition.TargetPosterior(targets)(belief, visited)
    assert torch.allclose(got, plain, atol=2e-3)
    assert not torch.allclose(acquisition.PredictedTargetPosterior(targets, model)(belief, visited), plain, atol=5e-3)


@pytest.mark.parametrize("name", ["KLDivergence", "NegativeEntropy", "PredictedTargetPosterior"])
def test_episodes_do_not_depend_on_their_batch(name, dtype):
    model, beta = four_classes(dtype), (0.3 + 4 * draw(5, 3, 4, seed=1) ** 2).to(dtype)
    visited = torch.arange(3).expand(5, 3) < torch.tensor([0, 1, 2, 1, 0])[:, None]
    drawn = sampled_likelihoods(model, 16)
    make = getattr(acquisition, name)
    value = make(2, model, likelihoods=drawn) if name.startswith("P") else make(model, ROW, likelihoods=drawn)
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


def test_policies_take_the_expectation_by_their_settings():
    model = four_classes()
    for name, kind in acquisition.FUNCTIONS.items():
        if "likelihoods" in kind.takes:
            made = Policy(name, model, samples=4, calibrated=False)(1, ROW)
            assert torch.equal(made.likelihoods, sampled_likelihoods(model, 4, calibrated=False))
            assert Policy(name, model)(1, ROW).likelihoods is None
    refused("samples: expected None for policy 'random', which predicts no look, got 4", Policy, "random", samples=4)
    settings = PolicyConfig("kl", "calibrated", samples=8)
    assert label(settings, "exploration") == "kl-calibrated, samples 8"
    for scores in ("raw", "calibrated"):
        chosen = replace(settings, scores=scores)
        strategy = _make_strategy(chosen, "exploration", BeliefConfig(), 4, {"observation": model}.__getitem__, 0.1)
        expected = sampled_likelihoods(model, 8, calibrated=scores == "calibrated")
        assert torch.equal(strategy.policy(None, ROW).likelihoods, expected)
    with pytest.raises(InputError, match="samples: expected null, except for predictive; got 8 for 'neighbourhood'"):
        resolve(PolicyConfig("neighbourhood", samples=8), "search")


def test_a_policy_draws_looks_from_the_model_as_it_is_now():
    """As one that was made of the changed model: after a file was loaded, and after an optimiser's step."""
    model, other = four_classes(), four_classes()
    policy = Policy("kl", model, samples=4)
    first = policy(None, ROW).likelihoods
    assert policy(None, ROW).likelihoods is first
    with torch.no_grad():
        other.log_alpha.mul_(1.5)
    policy.load_state_dict(Policy("kl", other, samples=4).state_dict())
    loaded = policy(None, ROW).likelihoods
    assert torch.equal(loaded, sampled_likelihoods(other, 4))
    assert not torch.equal(loaded, first)
    model.log_prior.data[0] += 1
    assert torch.equal(policy(None, ROW).likelihoods, sampled_likelihoods(model, 4))


def values_by(policy, beta):
    return policy(None, ROW)(DirichletBelief(beta), UNSEEN)


def test_a_policy_with_drawn_looks_is_one_graph_and_a_function_of_torch():
    """There the values of a model cannot be compared, and the looks are those drawn last."""
    policy = Policy("kl", four_classes(), samples=4)
    beta = 0.05 + draw(len(ROW), 4, dtype=torch.float32)
    expected = values_by(policy, beta)
    compiled = torch.compile(values_by, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(policy, beta), expected)
    state = {f"model.{name}": torch.stack([value, value]) for name, value in policy.model.named_parameters()}

    def drawn(state):
        return torch.func.functional_call(policy, state, (None, ROW)).likelihoods

    looks = policy(None, ROW).likelihoods
    together = torch.func.vmap(drawn, out_dims=None)(state)
    assert torch.equal(together, looks)


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
def observation():
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
def test_blocks_of_cells_change_no_bit(observation, samples, monkeypatch):
    drawn = sampled_likelihoods(observation, samples) if samples else None
    value = KLDivergence(observation, Grid(5, 4, (100, 80)), likelihoods=drawn)
    beta = 0.5 + rand(20, len(observation.classes) + 1)
    expected = values_of(value, beta)
    monkeypatch.setattr("semfov.gaze.acquisition.lookahead._BLOCK", 100)
    assert torch.equal(values_of(value, beta), expected)


@pytest.mark.parametrize("name", ACQUISITIONS)
def test_a_batch_may_have_any_number_of_dimensions_and_each_image_its_own_distances(name, observation):
    acquisition, beta = ACQUISITIONS[name](observation, TALL), beliefs(TALL, batch=4)
    together = values_of(acquisition, beta.view(2, 2, 10, 5)).flatten(0, 1)
    torch.testing.assert_close(torch.stack([values_of(acquisition, row) for row in beta]), together)
    sizes = torch.tensor([[64.0, 30.0], [30.0, 90.0]])
    beta = beliefs(WIDE, batch=2)
    both = values_of(ACQUISITIONS[name](observation, Grid(4, 2, sizes)), beta)
    for row, size in enumerate(sizes.tolist()):
        alone = values_of(ACQUISITIONS[name](observation, Grid(4, 2, tuple(size))), beta[row])
        torch.testing.assert_close(both[row], alone)


def test_small_divergences_are_accurate_in_single_precision(observation):
    """A nearly certain belief changes very little; the change must stay larger than rounding errors."""
    grid = WIDE
    beta = (beliefs(grid) * 3000).float().double()
    for name in ("surprise", "negative entropy"):
        acquisition = ACQUISITIONS[name](observation, grid)
        single, double = (values_of(acquisition, given) for given in (beta.float(), beta))
        torch.testing.assert_close(single.double(), double, rtol=1e-2, atol=0)


def test_bad_arguments(observation):
    grid = WIDE
    refused("classes", values_of, KLDivergence(observation, grid), torch.ones(1, 8, 4))
    refused("prior", KLDivergence, observation, grid, prior=0.0)
    refused("kappa", UpperConfidenceBound, observation, grid, kappa=-1.0)
    refused("margin", ProbabilityOfImprovement, observation, grid, margin=1.0)
    with pytest.raises(InputError, match="model: expected an observation model whose Dirichlets are densities"):
        sampled_likelihoods(two_classes(expected=torch.full((2, 2, 2), 0.5, dtype=torch.float64)), 4)
    refused("samples: expected a whole number from 1 to 65,536, got 0", policies.Policy, "kl", two_classes(), samples=0)
    refused("likelihoods", look_ahead_by_samples, torch.ones(3, 5), sampled_likelihoods(two_classes(), 4), UNSEEN)
