"""Policies by their names, the choice of a fixation, and a gaze that follows a density."""

from inspect import Parameter, Signature

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, acquisition
from semfov.gaze import Viewer
from semfov.gaze.acquisition import FUNCTIONS, AcquisitionFunction
from semfov.gaze.choice import Greedy, Softmax, drawn_from, select_fixation, soft_fixation
from semfov.gaze.policies import Policy, policy_names
from semfov.gaze.saliency import FixationDensity
from tests.refusals import refused

CENTRES = torch.stack([torch.arange(9.0), torch.zeros(9)], -1)


def noise_from(seed):
    """A source that returns new random numbers at every call."""
    generator = torch.Generator().manual_seed(seed)
    return lambda shift, episodes: torch.rand(len(episodes), 9, generator=generator)


@given(st.integers(0, 10_000))
def test_a_visited_cell_is_never_chosen(seed):
    generator = torch.Generator().manual_seed(seed)
    values, visited = torch.rand(6, 9, generator=generator), torch.rand(6, 9, generator=generator) < 0.7
    left = ~visited.all(-1)
    before = values.clone()
    _, cell = Greedy(noise_from(seed))(0, torch.arange(6), values, visited, CENTRES)
    assert not visited[left].gather(1, cell[left, None]).any()
    assert torch.equal(values, before)


def test_no_gradient_flows_through_a_choice():
    values = torch.rand(3, 9, requires_grad=True)
    fixation, _ = Greedy(noise_from(2))(0, torch.arange(3), values, torch.zeros(3, 9, dtype=torch.bool), CENTRES)
    assert not fixation.requires_grad


@pytest.mark.parametrize("inverse_temperature", [0.0, 0.7, 3.0])
def test_softmax_draws_in_proportion_to_exponentials(inverse_temperature, dtype, device):
    count = 40_000
    generator = torch.Generator().manual_seed(4)
    values = torch.randn(9, generator=generator).to(device, dtype)
    visited = torch.zeros(count, 9, dtype=torch.bool, device=device)
    visited[:, 2] = True
    noise = drawn_from(torch.rand(count, 1, 9, generator=generator).to(device))
    choice, centres = Softmax(noise, inverse_temperature), CENTRES.to(device)
    fixation, cell = choice(0, torch.arange(count, device=device), values.expand(count, 9), visited, centres)
    assert torch.equal(fixation.to(centres), centres[cell])
    weight = (inverse_temperature * values.double()).exp()
    weight[2] = 0
    share = weight / weight.sum()
    counts = torch.bincount(cell, minlength=9)
    assert bool(((counts - count * share).abs() <= 5 * (count * share * (1 - share)).sqrt()).all())


@given(st.integers(1, 9), st.integers(0, 10_000))
def test_selection_equals_a_loop(cells, seed):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randint(0, 4, (3, cells), generator=generator).double()
    visited = torch.rand(3, cells, generator=generator) < 0.4
    noise = torch.rand(3, cells, generator=generator)
    for row, got in enumerate(select_fixation(values, visited, noise).tolist()):
        free = [c for c in range(cells) if not visited[row, c]]
        best = max((float(values[row, c]) for c in free), default=None)
        tied = [c for c in free if float(values[row, c]) == best]
        assert got == (max(tied, key=lambda c: float(noise[row, c])) if free else -1)


def test_ties_are_not_broken_by_rounding_negative_values_or_infinities():
    values = torch.tensor([[0.3, 0.1 + 0.2, 0.30000003]])
    noise = torch.tensor([[0.9, 0.2, 0.5]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [0]
    values = torch.tensor([[-3.0, -2.0, -float("inf")]])
    noise = torch.tensor([[0.9, 0.2, 0.95]])
    assert select_fixation(values, torch.zeros(1, 3, dtype=torch.bool), noise).tolist() == [1]
    values, noise = torch.rand(4, 9), torch.rand(4, 9)
    visited = torch.rand(4, 9) < 0.5
    compiled = torch.compile(select_fixation, fullgraph=True, backend="eager")
    assert torch.equal(compiled(values, visited, noise), select_fixation(values, visited, noise))


CELLS, GRID = 12, Grid(4, 3, (64, 48))


@pytest.fixture
def visited():
    visited = torch.zeros(3, CELLS, dtype=torch.bool)
    visited[0, 5] = visited[1, [0, 7]] = True
    return visited


def test_hard_fixations_are_draws_from_the_softmax():
    torch.manual_seed(0)
    logits = torch.tensor([0.0, 1.0, 5.0, -1.0]).expand(20000, 4)
    visited = torch.tensor([False, False, True, False]).expand_as(logits)
    _, cell = soft_fixation(logits, visited, torch.zeros(4, 2), torch.rand(20000, 4))
    share = torch.bincount(cell, minlength=4) / len(cell)
    torch.testing.assert_close(share, torch.tensor([0.0, 1.0, -torch.inf, -1.0]).softmax(0), atol=0.015, rtol=0)
    assert share[2] == 0


def test_a_hard_fixation_has_the_gradient_of_the_soft_one(visited, dtype):
    torch.manual_seed(0)
    centres, noise = GRID.centres.to(dtype), torch.rand(3, CELLS, dtype=dtype)
    logits = torch.randn(3, CELLS, dtype=dtype, requires_grad=True)
    hard, cell = soft_fixation(logits, visited, centres, noise, temperature=0.7)
    soft, same = soft_fixation(logits, visited, centres, noise, temperature=0.7, hard=False)
    assert torch.equal(hard, centres[cell])
    assert torch.equal(cell, same)
    assert not visited.gather(1, cell[:, None]).any()
    weight = torch.randn(3, 2, dtype=dtype)
    gradients = [torch.autograd.grad((point * weight).sum(), logits)[0] for point in (hard, soft)]
    assert torch.equal(*gradients)
    assert gradients[0].abs().max() > 0.1


@pytest.mark.parametrize("hard", [True, False])
def test_mixed_precision_does_not_round_soft_fixations_to_eight_bits(visited, hard):
    """Which would be a pixel or two in a picture of 640."""
    logits = torch.randn(3, CELLS, generator=torch.Generator().manual_seed(0))
    centres, noise = GRID.centres, torch.full((3, CELLS), 0.5)
    exact = soft_fixation(logits, visited, centres, noise, hard=hard)
    with torch.autocast("cpu", torch.bfloat16):
        point, cell = soft_fixation(logits, visited, centres, noise, hard=hard)
    assert torch.equal(point, exact[0])
    assert torch.equal(cell, exact[1])


def test_soft_fixations_have_gradients_and_at_low_temperature_are_cell_centres(visited):
    torch.manual_seed(0)
    centres, noise = GRID.centres.double(), torch.rand(3, CELLS).double()
    logits = torch.randn(3, CELLS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: soft_fixation(x, visited, centres, noise, hard=False)[0], logits)
    torch.manual_seed(0)
    centres, noise = GRID.centres, torch.rand(3, CELLS)
    noise[0, 0], noise[1, 1] = 0.0, 1.0  # ends of the range
    soft, cell = soft_fixation(torch.randn(3, CELLS), visited, centres, noise, temperature=1e-4, hard=False)
    torch.testing.assert_close(soft, centres[cell])


def test_wrong_arguments_of_choices_and_policies_are_refused(model):
    refused("inverse_temperature", Softmax, lambda *_: torch.zeros(1, 9), -1.0)
    refused("NaN", select_fixation, torch.tensor([[float("nan")]]), torch.tensor([[False]]), torch.rand(1, 1))
    refused("visited", select_fixation, torch.zeros(1, 3), torch.zeros(1, 2, dtype=torch.bool), torch.rand(1, 3))
    zeros = torch.zeros(1, 3)
    refused("temperature", soft_fixation, zeros, zeros > 0, torch.zeros(3, 2), zeros, temperature=0.0)
    refused("centres", soft_fixation, zeros, zeros > 0, torch.zeros(4, 2), zeros)
    own = {"name": "own", "tasks": ("search",), "__init__": lambda self, *values: None}
    with pytest.raises(InputError, match=r"^__init__: expected arguments that can be given by name, got Own\(\*v"):
        type("Own", (AcquisitionFunction,), own)
    assert "own" not in FUNCTIONS
    refused("^function", Policy, nn.Linear, model)
    refused("^function: expected the name of an acquisition function, or its class", Policy, 3, model)
    refused("^function.*got a TargetPosterior", Policy, acquisition.TargetPosterior(1))
    visited = torch.zeros(1, CELLS, dtype=torch.bool)
    refused(r"^grid: .*policy\(target, grid\)\(belief, visited\)", Policy("kl", model), torch.ones(1, 2), visited)
    refused("^samples", Policy, "kl", model, samples=True)
    refused("unknown task 'find'; known: search, exploration", policy_names, "find")
    for name, meant in [("two-peak", "two-peaks"), ("predicitve", "predictive")]:
        refused(f"did you mean '{meant}'", Policy, name)


SCENE = Grid(4, 3, (80, 60))


def values_of(acquisition, beta):
    """Values for a Dirichlet belief with these parameters after a look at the first cell; no cell counts as visited."""
    closest = SCENE.cell_distance[0].to(beta).expand(beta.shape[:-1])
    return acquisition(DirichletBelief(beta, closest), torch.zeros(beta.shape[:-1], dtype=torch.bool))


@pytest.fixture
def model():
    model = FovealObservationModel.identity(["cup", "cat"], [0.2, 0.4])
    model.miss_rate = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    return model.requires_grad_(False)


OWN = {name for name, kind in FUNCTIONS.items() if kind.__module__.startswith("semfov.")}
"""Functions of the package; others may be registered."""


@pytest.mark.parametrize("name", sorted(OWN - {"saliency"}))
def test_a_policy_makes_its_acquisition_function(name, model):
    beta = 0.5 + torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1))
    given = {"target": 1, "model": model, "grid": SCENE}
    expected = FUNCTIONS[name](**{each: given[each] for each in FUNCTIONS[name].takes if each in given})
    assert torch.equal(values_of(Policy(name, model)(1, SCENE), beta), values_of(expected, beta))


def test_settings_reach_the_function(model):
    beta = 0.5 + torch.rand(1, 12, 3, generator=torch.Generator().manual_seed(1))
    for made, expected in [
        (Policy("kl", model, prior=2.0), acquisition.KLDivergence(model, SCENE, prior=2.0)),
        (Policy(acquisition.CloserLook, fovea=0.2), acquisition.CloserLook(SCENE, 0.2)),
        (Policy("neighbourhood", model, sigma=2.0), acquisition.NeighbourhoodPosterior(1, model, SCENE, sigma=2.0)),
    ]:
        assert torch.equal(values_of(made(1, SCENE), beta), values_of(expected, beta))
    refused("unknown setting of policy 'kl' 'prio'; did you mean 'prior'", Policy, "kl", model, prio=1.0)
    for options in ({"prior": None}, {"prior": "high"}):
        with pytest.raises(InputError, match="policy 'kl': expected values that fit model, grid, prior, got others"):
            Policy("kl", model, **options)(None, SCENE)
    for values in ({}, {"values": None}):
        refused("policy 'saliency': expected values of a scene, got none", Policy("saliency", **values), None, SCENE)


@pytest.mark.parametrize("name", ["foveal-hit", "place-information", "entropy-limit", "expected-accuracy"])
def test_a_model_without_miss_rates_is_refused(name):
    refused("miss rates", Policy(name, FovealObservationModel.identity(["cup", "cat"], [0.2])), 1, SCENE)


def test_every_named_function_is_public():
    for name in OWN:
        assert getattr(acquisition, FUNCTIONS[name].__name__) is FUNCTIONS[name]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_models_are_submodules_of_the_policy(name, model):
    """They are in its state dict, and change dtype with it."""
    policy = Policy(name, model)
    needed = "model" in FUNCTIONS[name].takes
    assert list(policy.state_dict()) == ([f"model.{name}" for name in model.state_dict()] if needed else [])
    policy.double()
    moved = [tensor.dtype for tensor in policy.state_dict().values() if tensor.is_floating_point()]
    assert set(moved) <= {torch.float64}
    assert bool(moved) == needed


def test_a_user_defined_function_is_registered_under_its_name():
    class Last(acquisition.Static):
        name = "last-of-all"
        tasks = ("search",)

    class Nameless(acquisition.Uniform):
        pass

    try:
        assert policy_names("search")[-1] == "last-of-all"
        assert "last-of-all" not in policy_names("exploration")
        made = Policy("last-of-all", values=torch.arange(12.0))(1, SCENE)
        assert isinstance(made, Last)
        assert values_of(made, torch.ones(1, 12, 3)).argmax() == 11
        assert Nameless not in FUNCTIONS.values()
    finally:
        del FUNCTIONS["last-of-all"]


def test_a_missing_model_is_an_error_when_the_policy_is_made():
    for name, kind in FUNCTIONS.items():
        if "model" not in kind.takes:
            Policy(name)
            continue
        refused(f"policy '{name}': expected an observation model, got none", Policy, name)


@pytest.mark.parametrize("name", sorted(OWN & set(policy_names("search")) - {"random", "saliency"}))
def test_the_error_for_a_missing_target_names_the_policy(name, model):
    refused(f"policy '{name}': expected a target", Policy(name, model), None, SCENE)


def test_settings_of_ones_own(model):
    """None is a value, what a subclass passes on is given to its base, and a parameter is trained and saved."""

    class Passing(acquisition.KLDivergence):
        def __init__(self, *args, width: float | None = 0.1, **options):
            super().__init__(*args, **options)
            self.width = width

    class Weighted(acquisition.Static):
        name = ""

    made = Policy(Passing, model, prior=2.0, width=None)(None, SCENE)
    assert (made.prior, made.width) == (2.0, None)
    policy = Policy(Weighted, values=nn.Parameter(torch.rand(12)))
    values_of(policy(None, SCENE), torch.ones(1, 12, 3)).sum().backward()
    assert torch.equal(policy.values.grad, torch.ones(12))
    assert list(policy.state_dict()) == ["values"]
    assert repr(policy) == "Policy('Weighted')"


@pytest.mark.parametrize("name", ["samples", "function", "forward", "training"])
def test_settings_of_names_that_a_policy_has_are_refused(name):
    takes = Signature([Parameter(name, Parameter.KEYWORD_ONLY, default=1)])
    with pytest.raises(InputError, match=f"^function: expected one whose settings have other names .*, got {name}$"):
        Policy(type("Own", (acquisition.Uniform,), {"__signature__": takes}))


@pytest.mark.parametrize(("name", "tasks"), [("kl", ("search",)), ("own", "search"), ("own", ("searching",))])
def test_a_name_that_is_taken_and_other_tasks_are_refused(name, tasks):
    with pytest.raises(InputError, match=r"^name: expected one not taken|^tasks: expected a tuple"):
        type("Own", (AcquisitionFunction,), {"name": name, "tasks": tasks})
    assert "own" not in FUNCTIONS
    assert FUNCTIONS["kl"] is acquisition.KLDivergence


SIZE = (60, 80)


def model_of(log):
    torch.manual_seed(0)
    model = FixationDensity({"none": 1}).requires_grad_(False)
    model.oculomotor.saccade.normal_(0, 0.3)
    return model, {"map": log[None], "centre bias": torch.zeros(1, *log.shape)}


def test_cells_are_drawn_as_often_as_the_density_says():
    """Twin: the sum of the density over the fine cells in each cell of the grid, among those not visited."""
    model, terms = model_of(torch.randn(39, 52))
    grid, draws = Grid(4, 3, (80, 60)), 2000
    start = torch.full((draws,), 5)
    choice = Viewer(model, terms, grid, start, torch.Generator().manual_seed(1))
    visited = torch.zeros(draws, 12, dtype=torch.bool)
    visited[:, [5, 0]] = True
    points, cells = choice(0, torch.arange(draws), torch.zeros(draws, 12), visited, grid.centres)
    path = grid.centres[5].view(1, 1, 2)
    density = torch.stack([*model.given(terms, SIZE, path).values()]).sum(0)[0].flatten().softmax(0).view(39, 52)
    expected = density.view(3, 13, 4, 13).sum((1, 3)).flatten()
    expected[[5, 0]] = 0
    share = torch.bincount(cells, minlength=12) / draws
    torch.testing.assert_close(share, expected / expected.sum(), atol=0.04, rtol=0)
    torch.testing.assert_close(points, grid.centres[cells])


def test_the_path_grows_and_ended_episodes_stay_where_they_are():
    model, terms = model_of(torch.zeros(39, 52))
    grid = Grid(4, 3, (80, 60))
    choice = Viewer(model, terms, grid, torch.tensor([0, 3]), torch.Generator().manual_seed(1))
    only = torch.arange(12).expand(2, -1) != 7
    choice(0, torch.tensor([0, 1]), torch.zeros(2, 12), only, grid.centres)
    choice(1, torch.tensor([1]), torch.zeros(1, 12), torch.ones(1, 12, dtype=torch.bool), grid.centres)
    assert choice.path.shape == (2, 3, 2)
    torch.testing.assert_close(choice.path[:, 1], grid.centres[[7, 7]].float())
    torch.testing.assert_close(choice.path[0, 2], grid.centres[7].float())
