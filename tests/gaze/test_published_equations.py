"""The acquisition functions of Luzio, Bernardino and Moreno (2024), and those made alike, against equations in loops.

Section III-E of the paper; labels of equations are those of its LaTeX source. For every fixation f' and every cell x
the look is simulated: the distance of the cells' centres, the expected scores (eq:expected_operator), Kaplan's rule
(eq:kaplanrule). Entropy and divergence are those of scipy and torch.distributions. Only the functions under test are
called from semfov.
"""

import math
from functools import cached_property

import numpy as np
import pytest
import scipy.stats
import torch

from semfov import DirichletBelief, FovealObservationModel, Grid, acquisition
from semfov.gaze.policies import Policy
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
