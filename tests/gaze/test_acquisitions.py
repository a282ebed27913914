"""What holds for every acquisition function: one signature, rows of a batch, gradients, one graph, which beliefs."""

import inspect

import pytest
import torch

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, acquisition
from semfov.belief.observers.context import ContextBelief
from semfov.belief.observers.target import TargetBelief
from semfov.gaze import LearnedGaze
from semfov.gaze.policies import Learned

GRID = Grid(4, 3, (80, 60))
TARGETS = torch.tensor([2, 1, 3])


def rand(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def model():
    alpha = 0.5 + 3 * rand(4, 3, 4) + 2 * torch.eye(4, dtype=torch.float64)[:, None]
    names, misses = ("cat", "cup", "dog"), 0.1 + 0.8 * rand(4, 3)
    return FovealObservationModel(alpha, [0.2, 0.5], names, miss_rate=misses).requires_grad_(False)


def learned():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        gaze = LearnedGaze(4).double().requires_grad_(False)
        torch.nn.init.normal_(gaze.network[-1].weight)
    return Learned(gaze)(TARGETS, GRID)


SEARCH = {
    "TargetPosterior": lambda: acquisition.TargetPosterior(TARGETS),
    "PredictedTargetPosterior": lambda: acquisition.PredictedTargetPosterior(TARGETS, model()),
    "NeighbourhoodPosterior": lambda: acquisition.NeighbourhoodPosterior(TARGETS, model(), GRID),
    "FovealHit": lambda: acquisition.FovealHit(TARGETS, model(), GRID),
    "PlaceInformation": lambda: acquisition.PlaceInformation(TARGETS, model(), GRID),
    "LearnedAcquisition": learned,
}
EXPLORATION = {
    "KLDivergence": lambda: acquisition.KLDivergence(model(), GRID),
    "BayesianSurprise": lambda: acquisition.BayesianSurprise(model(), GRID),
    "NegativeEntropy": lambda: acquisition.NegativeEntropy(model(), GRID),
    "TwoPeaks": lambda: acquisition.TwoPeaks(model(), GRID),
    "UpperConfidenceBound": lambda: acquisition.UpperConfidenceBound(model(), GRID),
    "ProbabilityOfImprovement": lambda: acquisition.ProbabilityOfImprovement(model(), GRID),
    "ExpectedAccuracy": lambda: acquisition.ExpectedAccuracy(model(), GRID),
    "CloserLook": lambda: acquisition.CloserLook(GRID, 0.2),
}
BLIND = {"Static": lambda: acquisition.Static(rand(3, 12)), "Uniform": acquisition.Uniform}
PRIOR = {
    "SaliencyPrior": lambda: acquisition.SaliencyPrior(acquisition.TargetPosterior(TARGETS), rand(3, 12), weight=0.3)
}
EVERY = SEARCH | EXPLORATION | BLIND | PRIOR
# These need to know no more than where the target may be, or nothing at all.
OF_ONE_TARGET = {"TargetPosterior", "FovealHit", "PlaceInformation", "SaliencyPrior", *BLIND}


def beliefs():
    """Three episodes that have looked, each somewhere else."""
    return DirichletBelief(0.3 + 4 * rand(3, 12, 4, seed=1) ** 2, GRID.cell_distance[[0, 6, 11]].double())


def told_of(present, following, closest):
    """A belief about one target that says this of it, and anything of the rest."""
    others, rest = rand(4, 3, 12, seed=7), rand(3, 3, seed=8)
    return TargetBelief(closest, *others, *rest[1:], visits(), present, following, rest[0])


def about_one_target():
    present, closest = rand(3, 12), GRID.cell_distance[[0, 6, 11]].double()
    return [
        told_of(present, present, closest),
        ContextBelief(present, present, closest, beliefs(), rand(3, 12, 4)),
    ]


def visits():
    visited = torch.zeros(3, 12, dtype=torch.bool)
    visited[0, 0] = visited[1, [3, 6]] = visited[2, 11] = True
    return visited


@pytest.fixture(params=EVERY)
def name(request):
    return request.param


def test_none_is_forgotten():
    # These have tests of their own: they go by a learned map, by d', by templates, or by all classes but background.
    own = {"ExpectedGain", "EntropyLimit", "CorrectLocalisation", "TemplateAttention", "ObjectEvidence"}
    assert set(acquisition.__all__) - {"AcquisitionFunction"} == (set(EVERY) - {"LearnedAcquisition"}) | own


def test_one_signature(name):
    function = EVERY[name]()
    assert isinstance(function, acquisition.AcquisitionFunction)
    assert list(inspect.signature(function.forward).parameters) == ["belief", "visited"]
    values = function(beliefs(), visits())
    assert values.shape == (3, 12)
    assert bool(values.isfinite().all())


def one_row(tensors, row):
    """An acquisition function that was made for a batch, for one of its episodes."""
    for module in tensors.modules():
        for key, buffer in module.named_buffers(recurse=False):
            if key in ("target", "visibility", "values", "log_prior"):
                setattr(module, key, buffer[row : row + 1])
    return tensors


def test_batches_are_rows(name):
    together = EVERY[name]()(beliefs(), visits())
    for row in range(3):
        alone = one_row(EVERY[name](), row)(beliefs()[row : row + 1], visits()[row : row + 1])
        torch.testing.assert_close(alone, together[row : row + 1], rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("name", [name for name in EVERY if name not in BLIND])
def test_gradients(name):
    function, known = EVERY[name](), beliefs()
    beta = known.beta.requires_grad_()
    assert torch.autograd.gradcheck(lambda b: function(DirichletBelief(b, known.closest), visits()), beta)


@pytest.mark.parametrize("name", BLIND)
def test_what_does_not_look_at_the_belief_has_no_gradient(name):
    known = beliefs()
    known.beta.requires_grad_()
    assert not EVERY[name]()(known, visits()).requires_grad


def test_dtype_is_that_of_the_belief(name):
    """An observation model in double serves beliefs in single precision."""
    function, known = EVERY[name](), beliefs()
    single = DirichletBelief(known.beta.float(), known.closest.float())
    if name in ("LearnedAcquisition", "Static"):
        function = function.float()
    values = function(single, visits())
    assert values.dtype == torch.float32
    torch.testing.assert_close(values.double(), EVERY[name]()(known, visits()), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", [name for name in EVERY if name != "LearnedAcquisition"])
def test_a_belief_before_the_first_look(name):
    """Without `closest`, and where nothing was visited; a learned gaze asks for at least one look."""
    values = EVERY[name]()(DirichletBelief(torch.full((3, 12, 4), 0.5)), torch.zeros(3, 12, dtype=torch.bool))
    assert values.shape == (3, 12)
    assert bool(values.isfinite().all())


@pytest.mark.parametrize("name", [name for name in EVERY if name != "LearnedAcquisition"])
def test_inhibition_of_return_is_not_theirs(name):
    function = EVERY[name]()
    assert torch.equal(function(beliefs(), visits()), function(beliefs(), ~visits()))


def test_a_belief_about_one_target_is_enough_or_is_refused(name):
    for known in about_one_target():
        function = EVERY[name]()
        if name in OF_ONE_TARGET:
            assert function(known, visits()).shape == (3, 12)
            continue
        with pytest.raises(InputError, match=f"all classes.*got {type(known).__name__}"):
            function(known, visits())


@pytest.mark.parametrize("name", sorted(OF_ONE_TARGET))
def test_only_the_probability_of_the_target_counts(name):
    """A belief about one target and one about all classes that say the same of it."""
    known = beliefs()
    present = known.probability(TARGETS)
    alone = told_of(present, present, known.closest)
    torch.testing.assert_close(EVERY[name]()(alone, visits()), EVERY[name]()(known, visits()))


def test_searches_look_where_the_target_would_be_if_no_fixated_cell_held_it():
    alone = told_of(rand(3, 12), rand(3, 12, seed=1), GRID.cell_distance[[0, 6, 11]].double())
    assert torch.equal(EVERY["TargetPosterior"]()(alone, visits()), alone.following)


def test_nothing_of_the_callers_is_changed(name):
    known, visited = beliefs(), visits()
    EVERY[name]()(known, visited)
    assert torch.equal(known.beta, beliefs().beta)
    assert torch.equal(known.closest, beliefs().closest)
    assert torch.equal(visited, visits())


@pytest.mark.parametrize("name", [name for name in EVERY if name not in ("LearnedAcquisition", "Static")])
def test_a_function_in_double_precision_serves_beliefs_in_single_precision(name):
    """Without changing their precision: what comes out is compared with other values of that belief."""
    known = beliefs()
    values = EVERY[name]().double()(DirichletBelief(known.beta.float(), known.closest.float()), visits())
    assert values.dtype == torch.float32
