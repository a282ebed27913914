"""Acquisition functions of the present belief against loops, closed forms and published equations."""

import inspect
import math
from dataclasses import dataclass

import pytest
import torch

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, acquisition
from semfov.belief import Belief
from semfov.gaze.acquisition import (
    AcquisitionFunction,
    BayesianSurprise,
    CloserLook,
    FovealHit,
    PlaceInformation,
    SaliencyPrior,
    Static,
    TargetPosterior,
    TwoPeaks,
)
from tests import small
from tests.gaze.test_modules import functions
from tests.refusals import refused
from tests.small import draw, values_of

TARGETS = torch.tensor([2, 1, 3])


def model():
    return small.model().double().requires_grad_(False)


EVERY = functions(TARGETS, model, draw(3, 12))
# These need only the probabilities of the target, or no belief at all.
OF_ONE_TARGET = {"TargetPosterior", "FovealHit", "PlaceInformation", "SaliencyPrior", "Static", "Uniform"}


def beliefs():
    """Beliefs of three episodes, each after one look at a different cell."""
    return DirichletBelief(0.3 + 4 * draw(3, 12, 4, seed=1) ** 2, small.GRID.cell_distance[[0, 6, 11]].double())


@dataclass(frozen=True)
class TargetBelief(Belief):
    """A belief about one target alone: the probabilities of its cells, and those while the search goes on."""

    closest: torch.Tensor
    present: torch.Tensor
    following: torch.Tensor

    def probability(self, target):
        return self.present

    def chance(self, target):
        return self.following


def target_belief(present, following, closest):
    return TargetBelief(closest, present, following)


def visits():
    visited = torch.zeros(3, 12, dtype=torch.bool)
    visited[0, 0] = visited[1, [3, 6]] = visited[2, 11] = True
    return visited


@pytest.fixture(params=EVERY)
def name(request):
    return request.param


def test_every_function_takes_belief_and_visited(name):
    function = EVERY[name]()
    assert isinstance(function, acquisition.AcquisitionFunction)
    assert list(inspect.signature(function.forward).parameters) == ["belief", "visited"]
    values = function(beliefs(), visits())
    assert values.shape == (3, 12)
    assert bool(values.isfinite().all())


def one_row(tensors, row):
    """Reduce an acquisition function made for a batch to one episode of it."""
    for module in tensors.modules():
        for key, buffer in module.named_buffers(recurse=False):
            if key in ("target", "visibility", "values", "log_prior"):
                setattr(module, key, buffer[row : row + 1])
    return tensors


@pytest.mark.usefixtures("one_thread")
def test_a_batch_gives_the_values_of_each_episode_alone(name, dtype):
    """Bit for bit, so that results do not depend on how many episodes share a tensor."""
    known = beliefs().map(lambda tensor: tensor.to(dtype))
    together = EVERY[name]()(known, visits())
    for row in range(3):
        alone = one_row(EVERY[name](), row)(known[row : row + 1], visits()[row : row + 1])
        assert torch.equal(alone, together[row : row + 1])


def test_values_have_the_dtype_of_the_belief(name):
    """A function and an observation model in double precision work with beliefs in single precision."""
    function, known = EVERY[name]().double(), beliefs()
    single = DirichletBelief(known.beta.float(), known.closest.float())
    if name == "Static":
        function = function.float()
    values = function(single, visits())
    assert values.dtype == torch.float32
    torch.testing.assert_close(values.double(), EVERY[name]()(known, visits()), rtol=1e-4, atol=1e-4)


def test_every_function_takes_beliefs_before_the_first_look_and_of_its_kind_and_needs_no_visits(name):
    """Without `closest`, and with no visited cell."""
    values = EVERY[name]()(DirichletBelief(torch.full((3, 12, 4), 0.5)), torch.zeros(3, 12, dtype=torch.bool))
    assert values.shape == (3, 12)
    assert bool(values.isfinite().all())
    function = EVERY[name]()
    assert torch.equal(function(beliefs(), visits()), function(beliefs(), ~visits()))
    present, closest = draw(3, 12), small.GRID.cell_distance[[0, 6, 11]].double()
    known, function = target_belief(present, present, closest), EVERY[name]()
    if name in OF_ONE_TARGET:
        assert function(known, visits()).shape == (3, 12)
        return
    refused(r"all classes.*got TargetBelief", function, known, visits())


@pytest.mark.parametrize("name", sorted(OF_ONE_TARGET))
def test_values_depend_only_on_the_probability_of_the_target(name):
    """A belief about one target and one about all classes, with equal probabilities of the target."""
    known = beliefs()
    present = known.probability(TARGETS)
    alone = target_belief(present, present, known.closest)
    torch.testing.assert_close(EVERY[name]()(alone, visits()), EVERY[name]()(known, visits()))


def test_target_posterior_uses_the_probabilities_given_absence_from_visited_cells():
    alone = target_belief(draw(3, 12), draw(3, 12, seed=1), small.GRID.cell_distance[[0, 6, 11]].double())
    assert torch.equal(EVERY["TargetPosterior"]()(alone, visits()), alone.following)


LOOKAHEADS = (
    "KLDivergence",
    "BayesianSurprise",
    "NegativeEntropy",
    "TwoPeaks",
    "UpperConfidenceBound",
    "ProbabilityOfImprovement",
    "ExpectedAccuracy",
)
"""Functions that subtract nearly equal values."""


@pytest.mark.parametrize("shape", [(5,), (11, 4), (1, 13, 4)])
@pytest.mark.parametrize("name", ["NeighbourhoodPosterior", *LOOKAHEADS])
def test_a_belief_with_another_number_of_cells_is_refused(name, shape):
    refused(r"^beta: expected a tensor of shape \(\.\.\., 12, any\)", small.values_of, EVERY[name](), torch.ones(shape))


def test_static_values_need_one_for_each_cell_and_uniform_ones_are_zero():
    assert EVERY["Uniform"]()(beliefs(), visits()).tolist() == [[0.0] * 12] * 3
    one = draw(12)
    assert torch.equal(acquisition.Static(one)(beliefs(), visits()), one.expand(3, 12))
    refused("values", acquisition.Static(one[:11]), beliefs(), visits())


@pytest.mark.parametrize("name", ["TargetPosterior", "PredictedTargetPosterior", "NeighbourhoodPosterior"])
def test_a_belief_without_a_batch_gives_the_values_of_its_episode(name):
    made = {"TargetPosterior": (), "PredictedTargetPosterior": (model(),)}.get(name, (model(), small.GRID))
    function = getattr(acquisition, name)(2, *made)
    torch.testing.assert_close(function(beliefs()[1], visits()[1]), function(beliefs(), visits())[1])


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


FOVEA = 0.2


@pytest.fixture(params=[torch.float32, torch.float64])
def belief(request):
    torch.manual_seed(0)
    beta = torch.rand(2, 12, 5, dtype=request.param) ** 2 + 0.02
    closest = torch.stack([GRID.cell_distance[3], GRID.cell_distance[[0, 10]].amin(0)]).to(beta)
    return DirichletBelief(beta, closest)


def test_a_closer_look_equals_the_loop(belief):
    got = CloserLook(GRID, FOVEA)(belief, torch.zeros(2, 12, dtype=torch.bool))
    assert got.dtype == belief.beta.dtype

    def acuity(distance):
        return 1.0 if distance <= FOVEA else math.exp(1 - distance / FOVEA)

    for episode in range(2):
        for f in range(12):
            total = 0.0
            for x in range(12):
                classes = belief.beta[episode, x, 1:].tolist()
                unknown = 1 - max(classes) / sum(classes)
                now = acuity(float(belief.closest[episode, x]))
                total += unknown * max(0.0, acuity(float(GRID.cell_distance[f, x])) - now)
            assert float(got[episode, f]) == pytest.approx(total, rel=1e-5, abs=1e-6)


BELIEF = DirichletBelief(0.3 + 4 * draw(3, 12, 5) ** 2)
NOWHERE = torch.zeros(3, 12, dtype=torch.bool)
SALIENCY = draw(3, 12, seed=1) ** 3


def values(acquisition):
    return acquisition(BELIEF, NOWHERE)


def surprise():
    alpha = 0.5 + 3 * draw(5, 2, 5) + 2 * torch.eye(5, dtype=torch.float64)[:, None]
    model = FovealObservationModel(alpha, [0.3], ("cat", "cup", "dog", "hat")).requires_grad_(False)
    return BayesianSurprise(model, GRID)


def two_peaks():
    return TwoPeaks(surprise().model, GRID)


ACQUISITIONS = {"target": lambda: TargetPosterior(2), "surprise": surprise, "two peaks": two_peaks}


@pytest.mark.parametrize("weight", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("name", ACQUISITIONS)
def test_a_saliency_prior_equals_the_loop(name, weight):
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


def test_one_saliency_map_applies_to_all_episodes_and_cells_without_value_come_last():
    """Such a value has no logarithm: it counts as a very small positive one, and gives no NaN."""
    worth = torch.tensor([0.5, 0.0, -3.0, 1e-9])
    guided = SaliencyPrior(Static(worth), torch.tensor([0.0, 1.0, 1.0, 1.0]), weight=0.3)
    got = guided(DirichletBelief(torch.ones(1, 4, 2)), torch.zeros(1, 4, dtype=torch.bool))
    assert bool(got.isfinite().all())
    assert got.argsort(-1, descending=True)[0, :2].tolist() == [0, 3]
    assert got[0, 1] == got[0, 2]
    one = values(SaliencyPrior(TargetPosterior(2), SALIENCY[1], weight=0.3))
    each = values(SaliencyPrior(TargetPosterior(2), SALIENCY[1].expand(3, 12), weight=0.3))
    assert torch.equal(one, each)


def test_bad_arguments():
    refused("weight", SaliencyPrior, TargetPosterior(2), SALIENCY, weight=-0.1)
    refused("saliency: expected numbers of 0 or more", SaliencyPrior, TargetPosterior(2), -SALIENCY, weight=0.3)
    with pytest.raises(InputError, match="saliency: expected numbers of 0 or more"):
        SaliencyPrior(TargetPosterior(2), SALIENCY * math.nan, weight=0.3)
    refused("saliency", values, SaliencyPrior(TargetPosterior(2), SALIENCY[:, :7], weight=0.3))
    refused("fovea", CloserLook, GRID, 0.0)
    for target in [-1, 4]:
        refused("target", acquisition.TargetPosterior(target), beliefs(), visits())
    refused(r"^sigma:", acquisition.NeighbourhoodPosterior, 3, model(), small.GRID, sigma=0.0)


def test_visited_cells_are_passed_to_the_acquisition():
    class Unvisited(AcquisitionFunction):
        def forward(self, belief, visited):
            return torch.where(visited, 1.0, 2.0).double()

    visited = torch.tensor([[True, False] * 6] * 3)
    got = SaliencyPrior(Unvisited(), SALIENCY, weight=0.0)(BELIEF, visited)
    torch.testing.assert_close(got.exp(), torch.where(visited, 1.0, 2.0).double())
