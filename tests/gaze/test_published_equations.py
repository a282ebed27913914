"""The paper's equations of gaze one by one, and the ideal searcher, against integrals."""

import math
from functools import cached_property
from math import inf, log

import numpy as np
import pytest
import scipy.stats
import torch
from scipy import integrate
from scipy.stats import norm

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, acquisition
from semfov.baselines.ideal import _correct_localisation
from semfov.gaze.acquisition import CorrectLocalisation, EntropyLimit, TargetPosterior
from semfov.gaze.policies import Policy
from semfov.observation import visibility
from tests.small import kaplan

LEVELS = 8
SHAPES = {"wide": (4, 3, (640, 480)), "tall": (2, 5, (300, 500)), "row": (6, 1, (60, 10))}
# All seeds with few components, one with many.
CASES = [(shape, components, seed) for shape in SHAPES for components, seed in ((5, 0), (5, 1), (5, 2), (81, 0))]


def posterior(beta):
    """eq:finalsemanticmap for one observation: β_k / Σ_j β_j."""
    return beta / beta.sum()


def divergence(beta, prior=0.5):
    """eq:kldivergence: from the cell's Dirichlet to that of maximum uncertainty."""
    one, base = (torch.distributions.Dirichlet(torch.as_tensor(b)) for b in (beta, np.full_like(beta, prior)))
    return float(torch.distributions.kl_divergence(one, base))


def negentropy(beta):
    """eq:entropy."""
    return -scipy.stats.entropy(posterior(beta))


def two_peaks(beta):
    """eq:twopeaks."""
    p = posterior(beta)
    most = p.argmax()
    return p[most] - np.delete(p, most).max()


def surprise(before, after):
    """From the class probabilities of a cell before the look to those after it."""
    return scipy.stats.entropy(posterior(after), posterior(before))


def favourite(beta):
    """Mean and standard deviation of the probability of a cell's most probable class."""
    p = posterior(beta).max()
    return p, math.sqrt(p * (1 - p) / (beta.sum() + 1))


def bound(beta, kappa=2.0):
    mean, deviation = favourite(beta)
    return mean + kappa * deviation


def improvement(before, after, margin=0.0):
    mean, deviation = favourite(after)
    return scipy.stats.norm.cdf((mean - favourite(before)[0] - margin) / deviation)


class Paper:
    """A map, an observation model, a grid, and the quantities that the paper computes from them."""

    def __init__(self, shape, components, seed):
        self.columns, self.rows, self.size = shape
        self.cells = self.columns * self.rows
        generator = np.random.default_rng(seed)
        # Borders between the distances of this grid, so that every level counts.
        far = max(self.distance(0, x) for x in range(self.cells))
        self.edges = np.linspace(0, far, LEVELS + 1)[1:-1] * (1 + 0.01 * generator.random())
        clarity = np.linspace(6, 0.5, LEVELS)[None, :, None]
        self.alpha = generator.gamma(0.5, size=(components, LEVELS, components)) + 0.05
        self.alpha += clarity * np.eye(components)[:, None]
        # A map that started at β⁰ = 0.5 and was updated in some cells, not in all.
        self.beta = np.full((self.cells, components), 0.5)
        for cell in range(self.cells):
            for _ in range(generator.integers(0, 4)):
                scores = generator.gamma(0.1, size=components) + 1e-3
                self.beta[cell] = kaplan(self.beta[cell], scores / scores.sum())

    def distance(self, x, f):
        """d' = ‖(u', v')‖ between the central pixels of two cells, in longer sides of the image."""
        width, height = self.size[0] / self.columns, self.size[1] / self.rows
        u, v = x % self.columns - f % self.columns, x // self.columns - f // self.columns
        return math.hypot(u * width, v * height) / max(self.size)

    def expected_scores(self, x, level):
        """eq:expected_operator, for a cell at a level of distance."""
        scores = 0.0
        for k, p in enumerate(posterior(self.beta[x])):
            scores = scores + self.alpha[k, level] / self.alpha[k, level].sum() * p
        return scores

    @cached_property
    def predicted_maps(self):
        """eq:predbeta: the expected parameters of every cell after a look from f, for every f."""
        expected = [[self.expected_scores(x, level) for level in range(LEVELS)] for x in range(self.cells)]
        maps = []
        for f in range(self.cells):
            levels = [sum(self.distance(x, f) > edge for edge in self.edges) for x in range(self.cells)]
            maps.append([kaplan(self.beta[x], expected[x][levels[x]]) for x in range(self.cells)])
        return maps

    def non_predictive(self, target):
        """eq:peaks_nonpred."""
        return [posterior(self.beta[x])[target] for x in range(self.cells)]

    def predictive(self, target):
        """eq:peaks_pred, from the map after a look at the cell itself (eq:local_scores)."""
        return [posterior(after[f])[target] for f, after in enumerate(self.predicted_maps)]

    def neighbourhood(self, target, sigma):
        """From the paper's outlook: the predicted map around f, weighted by distance (our choice of weights)."""
        values = []
        for f, after in enumerate(self.predicted_maps):
            value = 0.0
            for x, beta in enumerate(after):
                steps = (x % self.columns - f % self.columns) ** 2 + (x // self.columns - f // self.columns) ** 2
                value += math.exp(-steps / (2 * sigma**2)) * posterior(beta)[target]
            values.append(value)
        return values

    def total(self, metric):
        """eq:minimize: the metric over the whole predicted map, for every fixation."""
        return [sum(metric(beta) for beta in after) for after in self.predicted_maps]

    def change(self, change, join=sum):
        """The same of the change of each cell; the largest one is eq:maximize."""
        return [join(map(change, self.beta, after)) for after in self.predicted_maps]

    @property
    def grid(self):
        return Grid(self.columns, self.rows, self.size)

    @property
    def model(self):
        names = [f"class {k}" for k in range(1, self.alpha.shape[0])]
        return FovealObservationModel(torch.from_numpy(self.alpha), self.edges.tolist(), names).requires_grad_(False)

    def values(self, function, dtype=torch.float64):
        """Values that the library computes."""
        belief = DirichletBelief(torch.from_numpy(self.beta)[None].to(dtype))
        values = function(belief, torch.zeros(1, self.cells, dtype=torch.bool))[0]
        assert values.dtype == dtype
        return values.double().numpy()


@pytest.fixture(scope="module", params=CASES, ids=lambda case: "{} {} {}".format(*case))
def paper(request):
    shape, components, seed = request.param
    return Paper(SHAPES[shape], components, seed)


EXPLORATION = {
    "kl": lambda paper: paper.total(divergence),
    "negative-entropy": lambda paper: paper.total(negentropy),
    "two-peaks": lambda paper: paper.change(lambda before, after: abs(two_peaks(after) - two_peaks(before)), max),
    "surprise": lambda paper: paper.change(surprise),
    "upper-confidence-bound": lambda paper: paper.change(lambda before, after: bound(after) - bound(before)),
    "probability-of-improvement": lambda paper: paper.change(improvement),
}
# A constant over fixations may differ: the library subtracts the divergence or entropy of the present map.
UP_TO_A_CONSTANT = {"kl", "negative-entropy"}
# Values of one map differ from fixation to fixation by 0.01 (kl) and by 1e-4 (the others), or more.
DOUBLE, SINGLE = 1e-9, {"kl": 5e-5, "negative-entropy": 1e-6, "two-peaks": 5e-7, "probability-of-improvement": 1e-4}


def assert_agree(got, wanted, tolerance, constant=False):
    """Equal values, and the same best fixation (any of them, if several are equally good)."""
    wanted = np.array(wanted)
    if constant:
        got, wanted = got - got.mean(), wanted - wanted.mean()
    np.testing.assert_allclose(got, wanted, rtol=0, atol=tolerance)
    assert wanted[got.argmax()] >= wanted.max() - 2 * tolerance


@pytest.mark.parametrize("name", EXPLORATION)
def test_exploration(name, paper):
    wanted, function = EXPLORATION[name](paper), Policy(name, paper.model)(None, paper.grid)
    assert_agree(paper.values(function), wanted, DOUBLE, constant=name in UP_TO_A_CONSTANT)
    assert_agree(
        paper.values(function, torch.float32), wanted, SINGLE.get(name, 2e-6), constant=name in UP_TO_A_CONSTANT
    )


@pytest.mark.parametrize("target", [1, 4])
def test_search(paper, target):
    searches = {"non-predictive": paper.non_predictive(target), "predictive": paper.predictive(target)}
    for name, wanted in searches.items():
        function = Policy(name, paper.model)(target, paper.grid)
        assert_agree(paper.values(function), wanted, 1e-12)
        assert_agree(paper.values(function, torch.float32), wanted, 1e-6)


@pytest.mark.parametrize("sigma", [0.5, None, 3.0])
def test_neighbourhood(paper, sigma):
    """The default width is 0.7 cells."""
    width = {} if sigma is None else {"sigma": sigma}
    function = acquisition.NeighbourhoodPosterior(2, paper.model, paper.grid, **width)
    wanted = paper.neighbourhood(2, sigma or 0.7)
    # The weights are kept in single precision.
    assert_agree(paper.values(function), wanted, 1e-6)
    assert_agree(paper.values(function, torch.float32), wanted, 1e-5)


@pytest.mark.parametrize("prior", [0.1, 0.5, 2.0])
def test_divergence_from_another_prior(prior):
    paper = Paper(SHAPES["wide"], 5, 3)
    function = Policy("kl", paper.model, prior=prior)(None, paper.grid)
    assert_agree(paper.values(function), paper.total(lambda beta: divergence(beta, prior)), DOUBLE, constant=True)


@pytest.mark.parametrize(("name", "metric"), [("kl", divergence), ("negative-entropy", negentropy)])
def test_the_constant_is_the_value_of_the_present_map(name, metric, paper):
    function = Policy(name, paper.model)(None, paper.grid)
    present = sum(metric(beta) for beta in paper.beta)
    np.testing.assert_allclose(paper.values(function), np.array(paper.total(metric)) - present, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kappa", [0.0, 0.5, 3.0])
def test_the_bound_is_kappa_standard_deviations_above_the_mean(kappa):
    paper = Paper(SHAPES["row"], 5, 3)
    wanted = paper.change(lambda before, after: bound(after, kappa) - bound(before, kappa))
    assert_agree(paper.values(acquisition.UpperConfidenceBound(paper.model, paper.grid, kappa=kappa)), wanted, DOUBLE)


@pytest.mark.parametrize("margin", [0.01, 0.2])
def test_an_improvement_is_one_by_a_margin(margin):
    paper = Paper(SHAPES["row"], 5, 3)
    wanted = paper.change(lambda before, after: improvement(before, after, margin))
    function = acquisition.ProbabilityOfImprovement(paper.model, paper.grid, margin=margin)
    assert_agree(paper.values(function), wanted, DOUBLE)


GRID = Grid(4, 3, (80, 60))


def make_model(dtype=torch.float64):
    """Two classes at three levels; recognition gets worse from level to level."""
    generator = torch.Generator().manual_seed(0)
    alpha = 1 + torch.rand(3, 3, 3, generator=generator, dtype=torch.float64)
    alpha += 5 * torch.eye(3)[:, None] * torch.tensor([1.0, 0.4, 0.1])[:, None]
    missed = torch.tensor([[0.8, 0.8, 0.9], [0.1, 0.5, 0.9], [0.2, 0.4, 0.8]])
    return FovealObservationModel(alpha.to(dtype), [0.3, 0.6], ["cup", "cat"], miss_rate=missed)


def make_belief(dtype=torch.float64, batch=2, seed=0):
    beta = torch.rand(batch, 12, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2 + 0.02
    return DirichletBelief(beta.to(dtype))


def nothing_visited(belief):
    return torch.zeros(belief.beta.shape[:-1], dtype=torch.bool, device=belief.beta.device)


def place_of(belief, target, visited):
    p = belief.probability(target).masked_fill(visited, 0)
    return p / p.sum(-1, keepdim=True)


def test_entropy_limit_equals_the_loop():
    belief, visited = make_belief(), torch.zeros(2, 12, dtype=torch.bool)
    visited[0, [1, 5]] = visited[1, 11] = True
    target = torch.tensor([1, 2])
    got = EntropyLimit(target, make_model(), GRID)(belief, visited)
    seen = visibility(make_model()).detach()
    for episode in range(2):
        p = [0.0 if visited[episode, x] else float(belief.probability(target)[episode, x]) for x in range(12)]
        for f in range(12):
            total = 0.0
            for x in range(12):
                level = int(torch.bucketize(GRID.cell_distance[f, x], torch.tensor([0.3, 0.6])))
                total += 0.5 * p[x] / sum(p) * float(seen[int(target[episode]), level]) ** 2
            assert float(got[episode, f]) == pytest.approx(total, rel=1e-6)


def integral(place, signal):
    """The published formula, by an adaptive integral."""
    total = 0.0
    for i, p in enumerate(place):
        rivals = [j for j in range(len(place)) if j != i and place[j] > 0]

        def right(w, i=i, p=p, rivals=rivals):
            bounds = [
                (-2 * log(place[j] / p) + signal[j] ** 2 + 2 * signal[i] * w + signal[i] ** 2) / (2 * signal[j])
                for j in rivals
            ]
            return norm.pdf(w) * np.prod(norm.cdf(bounds))

        if p > 0:
            total += p * integrate.quad(right, -9, 9, limit=400)[0]
    return total


@pytest.mark.parametrize("seed", range(3))
def test_localisation_equals_the_adaptive_integral(seed):
    rng = np.random.default_rng(seed)
    place, signal = rng.dirichlet(np.ones(9)), rng.uniform(0.3, 3, 9)
    place[3] = 0
    place /= place.sum()
    exact = integral(place, signal)
    for nodes, tolerance in ((64, 2e-4), (256, 1e-5)):
        got = _correct_localisation(torch.tensor(place), torch.tensor(signal), nodes=nodes)
        assert float(got) == pytest.approx(exact, abs=tolerance)


class Sharp:
    """Sees targets perfectly in the fixated cell, and not at all in other cells."""

    miss_rate = torch.tensor([[0.5, 1.0], [1e-4, 1.0]], dtype=torch.float64)
    alpha = torch.tensor([[[60.0, 1.0]] * 2, [[1.0, 60.0]] * 2], dtype=torch.float64)

    def level(self, distance):
        return (distance > 1e-6).long()


@pytest.mark.parametrize("kind", [EntropyLimit, CorrectLocalisation])
def test_with_a_fovea_of_one_cell_they_fixate_the_most_probable_place_and_by_a_uniform_prior_the_centre(kind):
    """Published: for a searcher who sees only the fixated cell, the most probable place is the best fixation."""
    beta = torch.rand(20, 12, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1
    belief = DirichletBelief(beta)
    visited = torch.zeros(20, 12, dtype=torch.bool)
    visited[:, 4] = True
    cells = [
        values(belief, visited).masked_fill(visited, -inf).argmax(-1)
        for values in (kind(1, Sharp(), GRID), TargetPosterior(1))
    ]
    agree = float((cells[0] == cells[1]).double().mean())
    # The ideal searcher need not look at the cell that it would answer anyway, so it may take the second best.
    assert agree == 1 if kind is EntropyLimit else agree < 1
    if kind is CorrectLocalisation:
        ranks = TargetPosterior(1)(belief, visited).masked_fill(visited, -inf).argsort(-1, descending=True)
        assert bool(((cells[0] == ranks[:, 0]) | (cells[0] == ranks[:, 1])).all())
    grid, belief = Grid(5, 5, (100, 100)), DirichletBelief(torch.ones(1, 25, 3, dtype=torch.float64))
    assert int(kind(1, make_model(), grid)(belief, nothing_visited(belief)).argmax()) == 12


def test_entropy_limit_is_nearly_optimal():
    """Published: entropy limit minimisation is nearly optimal. Its choices lose little of the gain."""
    belief = make_belief(batch=40, seed=7)
    visited = nothing_visited(belief)
    told = CorrectLocalisation(1, make_model(), GRID)(belief, visited)
    chosen = EntropyLimit(1, make_model(), GRID)(belief, visited).argmax(-1, keepdim=True)
    gain = told - place_of(belief, 1, visited).amax(-1, keepdim=True)
    assert float((gain.gather(-1, chosen)[:, 0] / gain.amax(-1)).mean()) > 0.9
    assert float((gain.mean(-1) / gain.amax(-1)).mean()) < 0.8


@pytest.mark.parametrize("kind", [EntropyLimit, CorrectLocalisation])
def test_an_episode_does_not_depend_on_the_others(kind):
    belief, target = make_belief(batch=5), torch.tensor([1, 2, 1, 2, 2])
    visited = torch.rand(5, 12, generator=torch.Generator().manual_seed(0)) < 0.3
    together = kind(target, make_model(), GRID)(belief, visited)
    for episode in range(5):
        part = slice(episode, episode + 1)
        alone = kind(target[part], make_model(), GRID)(belief[part], visited[part])
        assert torch.equal(alone, together[part])


def test_values_are_finite_where_the_target_has_probability_zero():
    belief = DirichletBelief(torch.tensor([1.0, 0.0]).repeat(1, 12, 1), torch.zeros(1, 12))
    for kind in (EntropyLimit, CorrectLocalisation):
        assert bool(kind(1, Sharp(), GRID)(belief, nothing_visited(belief)).isfinite().all())


def test_gradients_of_localisation():
    place = make_belief().probability(1).softmax(-1)[:1, :5].requires_grad_()
    signal = torch.linspace(0.3, 2, 5, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, d: _correct_localisation(p, d, nodes=24), (place, signal))


def test_values_use_the_given_number_of_integration_nodes():
    place, signal = make_belief(batch=3).probability(1), torch.rand(3, 12, 12, dtype=torch.float64) + 0.3
    place = place / place.sum(-1, keepdim=True)
    for nodes in (8, 16):
        got = CorrectLocalisation(1, make_model(), GRID, nodes=nodes).values(place, signal)
        expected = [
            [float(_correct_localisation(p, d, nodes=nodes)) for d in s] for p, s in zip(place, signal, strict=True)
        ]
        torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64))
    usual = CorrectLocalisation(1, make_model(), GRID).values(place, signal)
    assert torch.equal(usual, CorrectLocalisation(1, make_model(), GRID, nodes=64).values(place, signal))
    assert not torch.allclose(usual, got, rtol=1e-6)
    with pytest.raises(InputError, match="nodes: expected 8 or more, got 7"):
        CorrectLocalisation(1, make_model(), GRID, nodes=7)


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("amp", [None, torch.bfloat16, torch.float16])
def test_searchers_take_half_precision_with_automatic_mixed_precision_or_without(half, amp):
    belief, model = make_belief(batch=3), make_model()
    beta = belief.beta.to(half)
    visited = torch.zeros(3, 12, dtype=torch.bool)
    visited[:, 5] = True
    for function in (EntropyLimit(1, model, GRID), CorrectLocalisation(1, model, GRID, nodes=16)):
        expected = function(DirichletBelief(beta.double(), belief.closest), visited)
        place = belief.probability(1).to(half)
        values = function.values(place.double(), function.signal[None].expand(3, -1, -1).double())
        with torch.autocast("cpu", amp or half, enabled=amp is not None):
            got = function(DirichletBelief(beta, belief.closest.to(half)), visited)
            got_values = function.values(place, function.signal[None].expand(3, -1, -1).float())
        # Only the place is rounded there, and not the product.
        torch.testing.assert_close(got_values.double(), values, rtol=1e-5, atol=1e-6)
        assert got_values.dtype == torch.float32
        torch.testing.assert_close(got.double(), expected, rtol=0.03, atol=0.03)


@pytest.mark.parametrize("nodes", [8, 64])
def test_localisation_is_a_sum_over_equidistant_noise(nodes):
    """Noise from -5 to 5, each weighted by its normal density; 64 nodes by default."""
    rng = np.random.default_rng(1)
    place, signal = rng.dirichlet(np.ones(5)), rng.uniform(0.3, 3, 5)
    noise = [-5 + 10 * step / (nodes - 1) for step in range(nodes)]
    total = 0.0
    for x in range(5):
        for w in noise:
            right = 1.0
            for y in set(range(5)) - {x}:
                ahead = 2 * log(place[x] / place[y]) + signal[y] ** 2 + signal[x] ** 2 + 2 * signal[x] * w
                right *= norm.cdf(ahead / (2 * signal[y]))
            total += place[x] * right * norm.pdf(w) / sum(norm.pdf(noise))
    told = {} if nodes == 64 else {"nodes": nodes}
    got = _correct_localisation(torch.tensor(place), torch.tensor(signal), **told)
    assert float(got) == pytest.approx(total, rel=1e-12)
