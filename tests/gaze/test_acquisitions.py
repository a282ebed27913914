"""Properties of every acquisition function: signature, batches, gradients, dtypes, and the beliefs that it accepts."""

import inspect

import pytest
import torch

from semfov import DirichletBelief, acquisition
from semfov.belief.observers.target import TargetBelief
from tests import small
from tests.gaze.test_modules import LOOKAHEADS, functions
from tests.refusals import refused
from tests.small import GRID
from tests.small import draw as rand

TARGETS = torch.tensor([2, 1, 3])


def model():
    return small.model().double().requires_grad_(False)


EVERY = functions(TARGETS, model, rand(3, 12))
# These need only the probabilities of the target, or no belief at all.
OF_ONE_TARGET = {"TargetPosterior", "FovealHit", "PlaceInformation", "SaliencyPrior", "Static", "Uniform"}


def beliefs():
    """Beliefs of three episodes, each after one look at a different cell."""
    return DirichletBelief(0.3 + 4 * rand(3, 12, 4, seed=1) ** 2, GRID.cell_distance[[0, 6, 11]].double())


def target_belief(present, following, closest):
    """A belief about one target with these probabilities; its other fields are random."""
    others, rest = rand(4, 3, 12, seed=7), rand(3, 3, seed=8)
    return TargetBelief(closest, *others, *rest[1:], visits(), present, following, rest[0])


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


def test_a_belief_before_the_first_look(name):
    """Without `closest`, and with no visited cell."""
    values = EVERY[name]()(DirichletBelief(torch.full((3, 12, 4), 0.5)), torch.zeros(3, 12, dtype=torch.bool))
    assert values.shape == (3, 12)
    assert bool(values.isfinite().all())


def test_values_do_not_depend_on_visited_cells(name):
    function = EVERY[name]()
    assert torch.equal(function(beliefs(), visits()), function(beliefs(), ~visits()))


def test_a_belief_about_one_target_is_refused_if_all_classes_are_needed(name):
    present, closest = rand(3, 12), GRID.cell_distance[[0, 6, 11]].double()
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
    alone = target_belief(rand(3, 12), rand(3, 12, seed=1), GRID.cell_distance[[0, 6, 11]].double())
    assert torch.equal(EVERY["TargetPosterior"]()(alone, visits()), alone.following)


@pytest.mark.parametrize("shape", [(5,), (11, 4), (1, 13, 4)])
@pytest.mark.parametrize("name", ["NeighbourhoodPosterior", *LOOKAHEADS])
def test_a_belief_with_another_number_of_cells_is_refused(name, shape):
    refused(r"^beta: expected a tensor of shape \(\.\.\., 12, any\)", small.values_of, EVERY[name](), torch.ones(shape))


def test_static_values_need_one_for_each_cell_and_uniform_ones_are_zero():
    assert EVERY["Uniform"]()(beliefs(), visits()).tolist() == [[0.0] * 12] * 3
    one = rand(12)
    assert torch.equal(acquisition.Static(one)(beliefs(), visits()), one.expand(3, 12))
    refused("values", acquisition.Static(one[:11]), beliefs(), visits())


@pytest.mark.parametrize("name", ["TargetPosterior", "PredictedTargetPosterior", "NeighbourhoodPosterior"])
def test_a_belief_without_a_batch_gives_the_values_of_its_episode(name):
    made = {"TargetPosterior": (), "PredictedTargetPosterior": (model(),)}.get(name, (model(), GRID))
    function = getattr(acquisition, name)(2, *made)
    torch.testing.assert_close(function(beliefs()[1], visits()[1]), function(beliefs(), visits())[1])


def test_targets_and_widths_out_of_range_are_refused():
    for target in [-1, 4]:
        refused("target", acquisition.TargetPosterior(target), beliefs(), visits())
    refused(r"^sigma:", acquisition.NeighbourhoodPosterior, 3, model(), GRID, sigma=0.0)
