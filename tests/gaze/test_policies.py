"""Policies by name: errors, state as modules, copies and pickling."""

from inspect import Parameter, Signature

import pytest
import torch
from torch import nn

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, MapEvidence, acquisition
from semfov.gaze.acquisition import FUNCTIONS, AcquisitionFunction
from semfov.gaze.policies import Policy, policy_names
from tests.refusals import refused

GRID = Grid(4, 3, (80, 60))


def values_of(acquisition, beta):
    """Values for a Dirichlet belief with these parameters after a look at the first cell; no cell counts as visited."""
    closest = GRID.cell_distance[0].to(beta).expand(beta.shape[:-1])
    return acquisition(DirichletBelief(beta, closest), torch.zeros(beta.shape[:-1], dtype=torch.bool))


@pytest.fixture
def model():
    model = FovealObservationModel.identity(["cup", "cat"], [0.2, 0.4])
    model.miss_rate = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    return model.requires_grad_(False)


@pytest.fixture
def mapping():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return MapEvidence(4, 4, components=3).requires_grad_(False)


OWN = {name for name, kind in FUNCTIONS.items() if kind.__module__.startswith("semfov.")}
"""Functions of the package; others may be registered."""


def model_for(name, model, mapping):
    return mapping if FUNCTIONS[name].needs_map else model


@pytest.mark.parametrize("name", sorted(OWN - {"expected-gain", "saliency"}))
def test_a_policy_makes_its_acquisition_function(name, model):
    beta = 0.5 + torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1))
    given = {"target": 1, "model": model, "grid": GRID}
    expected = FUNCTIONS[name](**{each: given[each] for each in FUNCTIONS[name].takes if each in given})
    assert torch.equal(values_of(Policy(name, model)(1, GRID), beta), values_of(expected, beta))


def test_settings_reach_the_function(model, mapping):
    beta = 0.5 + torch.rand(1, 12, 3, generator=torch.Generator().manual_seed(1))
    for made, expected in [
        (Policy("kl", model, prior=2.0), acquisition.KLDivergence(model, GRID, prior=2.0)),
        (Policy(acquisition.CloserLook, fovea=0.2), acquisition.CloserLook(GRID, 0.2)),
        (Policy("neighbourhood", model, sigma=2.0), acquisition.NeighbourhoodPosterior(1, model, GRID, sigma=2.0)),
    ]:
        assert torch.equal(values_of(made(1, GRID), beta), values_of(expected, beta))
    policy = Policy("expected-gain", mapping)
    assert policy.model is mapping
    assert policy(None, GRID).model is mapping
    refused("unknown setting of policy 'kl' 'prio'; did you mean 'prior'", Policy, "kl", model, prio=1.0)
    for options in ({"prior": None}, {"prior": "high"}):
        with pytest.raises(InputError, match="policy 'kl': expected values that fit model, grid, prior, got others"):
            Policy("kl", model, **options)(None, GRID)
    for values in ({}, {"values": None}):
        refused("policy 'saliency': expected values of a scene, got none", Policy("saliency", **values), None, GRID)


@pytest.mark.parametrize("name", ["foveal-hit", "place-information", "entropy-limit", "expected-accuracy"])
def test_a_model_without_miss_rates_is_refused(name):
    refused("miss rates", Policy(name, FovealObservationModel.identity(["cup", "cat"], [0.2])), 1, GRID)


def test_every_named_function_is_public():
    for name in OWN:
        assert getattr(acquisition, FUNCTIONS[name].__name__) is FUNCTIONS[name]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_models_are_submodules_of_the_policy(name, model, mapping):
    """They are in its state dict, and change dtype with it."""
    policy, part = Policy(name, model_for(name, model, mapping)), model_for(name, model, mapping)
    needed = "model" in FUNCTIONS[name].takes
    assert list(policy.state_dict()) == ([f"model.{name}" for name in part.state_dict()] if needed else [])
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
        made = Policy("last-of-all", values=torch.arange(12.0))(1, GRID)
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
        needed = "a learned map" if kind.needs_map else "an observation model"
        refused(f"policy '{name}': expected {needed}, got none", Policy, name)


@pytest.mark.parametrize("name", sorted(OWN & set(policy_names("search")) - {"random", "saliency"}))
def test_the_error_for_a_missing_target_names_the_policy(name, model):
    refused(f"policy '{name}': expected a target", Policy(name, model), None, GRID)


def test_settings_of_ones_own(model):
    """None is a value, what a subclass passes on is given to its base, and a parameter is trained and saved."""

    class Passing(acquisition.KLDivergence):
        def __init__(self, *args, width: float | None = 0.1, **options):
            super().__init__(*args, **options)
            self.width = width

    class Weighted(acquisition.Static):
        name = ""

    made = Policy(Passing, model, prior=2.0, width=None)(None, GRID)
    assert (made.prior, made.width) == (2.0, None)
    policy = Policy(Weighted, values=nn.Parameter(torch.rand(12)))
    values_of(policy(None, GRID), torch.ones(1, 12, 3)).sum().backward()
    assert torch.equal(policy.values.grad, torch.ones(12))
    assert list(policy.state_dict()) == ["values"]
    assert repr(policy) == "Policy('Weighted')"


@pytest.mark.parametrize("name", ["samples", "function", "forward", "training"])
def test_settings_of_names_that_a_policy_has_are_refused(name):
    takes = Signature([Parameter(name, Parameter.KEYWORD_ONLY, default=1)])
    with pytest.raises(InputError, match=f"^function: expected one whose settings have other names .*, got {name}$"):
        Policy(type("Own", (acquisition.Uniform,), {"__signature__": takes}))


def test_arguments_without_names_are_refused():
    own = {"name": "own", "tasks": ("search",), "__init__": lambda self, *values: None}
    with pytest.raises(InputError, match=r"^__init__: expected arguments that can be given by name, got Own\(\*v"):
        type("Own", (AcquisitionFunction,), own)
    assert "own" not in FUNCTIONS


@pytest.mark.parametrize(("name", "tasks"), [("kl", ("search",)), ("own", "search"), ("own", ("searching",))])
def test_a_name_that_is_taken_and_other_tasks_are_refused(name, tasks):
    with pytest.raises(InputError, match=r"^name: expected one not taken|^tasks: expected a tuple"):
        type("Own", (AcquisitionFunction,), {"name": name, "tasks": tasks})
    assert "own" not in FUNCTIONS
    assert FUNCTIONS["kl"] is acquisition.KLDivergence


def test_what_is_no_function_and_other_numbers_of_samples_are_refused(model):
    refused("^function", Policy, nn.Linear, model)
    refused("^unknown policy", Policy, 3, model)
    refused("^samples", Policy, "kl", model, samples=True)


def test_other_names_are_refused_with_a_suggestion():
    refused("unknown task 'find'; known: search, exploration", policy_names, "find")
    for name, meant in [("two-peak", "two-peaks"), ("predicitve", "predictive")]:
        refused(f"did you mean '{meant}'", Policy, name)
