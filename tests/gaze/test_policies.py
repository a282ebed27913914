"""Policies by name: errors, state as modules, copies and pickling."""

import pytest
import torch

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError, MapEvidence, acquisition, policies
from semfov.gaze.policies import POLICIES, Means, Policy, named_policy, policy_names

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
def means(model):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        everything = MapEvidence(4, 4, components=3).requires_grad_(False)
    return Means(model, everything)


OWN = {name for name, kind in POLICIES.items() if kind.__module__.startswith("semfov.")}
"""Policies of the package; others may be registered."""

# Policies of each acquisition function, for a search for class 1 and for exploration.
MADE = {
    "random": lambda means: acquisition.Uniform(),
    "non-predictive": lambda means: acquisition.TargetPosterior(1),
    "predictive": lambda means: acquisition.PredictedTargetPosterior(1, means.model),
    "neighbourhood": lambda means: acquisition.NeighbourhoodPosterior(1, means.model, GRID),
    "foveal-hit": lambda means: acquisition.FovealHit(1, means.model, GRID),
    "place-information": lambda means: acquisition.PlaceInformation(1, means.model, GRID),
    "kl": lambda means: acquisition.KLDivergence(means.model, GRID, prior=means.prior),
    "surprise": lambda means: acquisition.BayesianSurprise(means.model, GRID),
    "negative-entropy": lambda means: acquisition.NegativeEntropy(means.model, GRID),
    "two-peaks": lambda means: acquisition.TwoPeaks(means.model, GRID),
    "upper-confidence-bound": lambda means: acquisition.UpperConfidenceBound(means.model, GRID),
    "probability-of-improvement": lambda means: acquisition.ProbabilityOfImprovement(means.model, GRID),
    "expected-accuracy": lambda means: acquisition.ExpectedAccuracy(means.model, GRID),
    "closer-look": lambda means: acquisition.CloserLook(GRID, means.fovea),
}


@pytest.mark.parametrize("name", MADE)
def test_a_policy_makes_its_acquisition_function(name, model):
    beta = 0.5 + torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1))
    for means in (Means(model, fovea=0.2), Means(model, fovea=0.2, prior=2.0)):
        for task in POLICIES[name].tasks:
            made = named_policy(name, task, means)(1 if task == "search" else None, GRID)
            assert torch.equal(values_of(made, beta), values_of(MADE[name](means), beta))


def test_the_policy_of_expected_gain_keeps_its_map(means):
    policy = named_policy("expected-gain", "exploration", means)
    assert policy.model is means.map
    assert isinstance(policy(None, GRID), acquisition.ExpectedGain)


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("foveal-hit", "search"),
        ("place-information", "search"),
        ("entropy-limit", "search"),
        ("expected-accuracy", "exploration"),
    ],
)
def test_a_model_without_miss_rates_is_refused(name, task):
    means = Means(FovealObservationModel.identity(["cup", "cat"], [0.2]))
    with pytest.raises(InputError, match="miss rates"):
        named_policy(name, task, means)(1 if task == "search" else None, GRID)


def test_every_policy_class_is_public():
    for name in OWN:
        kind = POLICIES[name]
        assert kind.name == name
        assert getattr(policies, kind.__name__) is kind
        assert kind.__name__ in policies.__all__


@pytest.mark.parametrize("name", POLICIES)
def test_models_are_submodules_of_the_policy(name, means):
    """They are in its state dict, and change dtype with it."""
    policy = POLICIES[name].make(means)
    assert isinstance(policy, Policy)
    part = means.model if policy.needs_model else means.map if policy.needs_map else None
    assert list(policy.state_dict()) == ([] if part is None else [f"model.{name}" for name in part.state_dict()])
    policy.double()
    moved = [tensor.dtype for tensor in policy.state_dict().values() if tensor.is_floating_point()]
    assert set(moved) <= {torch.float64}
    assert bool(moved) == (part is not None)


def test_a_user_defined_policy_is_registered_under_its_name():
    class Last(Policy):
        name = "last-of-all"
        tasks = ("search",)

        def forward(self, target, grid):
            return acquisition.Static(torch.arange(float(len(grid))))

    class Nameless(Policy):
        def forward(self, target, grid):
            return acquisition.Uniform()

    try:
        assert policy_names("search")[-1] == "last-of-all"
        assert "last-of-all" not in policy_names("exploration")
        made = named_policy("last-of-all", "search")
        assert isinstance(made, Last)
        assert values_of(made(1, GRID), torch.ones(1, 12, 3)).argmax() == 11
        assert Nameless not in POLICIES.values()
    finally:
        del POLICIES["last-of-all"]


def test_a_missing_model_is_an_error_when_the_policy_is_made():
    for task in ("search", "exploration"):
        for name in policy_names(task):
            kind = POLICIES[name]
            if not (kind.needs_model or kind.needs_map):
                named_policy(name, task)
                continue
            needed = "a learned map" if kind.needs_map else "an observation model"
            with pytest.raises(InputError, match=f"policy '{name}': expected {needed}"):
                named_policy(name, task)


@pytest.mark.parametrize("name", sorted(OWN & set(policy_names("search")) - {"random", "saliency"}))
def test_the_error_for_a_missing_target_names_the_policy(name, means):
    with pytest.raises(InputError, match=f"policy '{name}': expected a target"):
        named_policy(name, "search", means)(None, GRID)


def test_other_names_and_tasks_are_refused_with_a_suggestion(means):
    for name, task, meant in [("two-peak", "exploration", "two-peaks"), ("predicitve", "search", "predictive")]:
        with pytest.raises(InputError, match=f"did you mean '{meant}'"):
            named_policy(name, task)
    with pytest.raises(InputError, match="search policy 'kl'"):
        named_policy("kl", "search", means)
    with pytest.raises(InputError, match="exploration policy 'predictive'"):
        named_policy("predictive", "exploration", means)
