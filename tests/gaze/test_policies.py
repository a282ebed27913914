"""Policies by name: what they refuse, and that they can be copied and sent to another process."""

import copy
import pickle

import pytest
import torch

from semfov import FovealObservationModel
from semfov.belief import DirichletBelief, Grid
from semfov.errors import InputError
from semfov.gaze import EXPLORATION_POLICIES, SEARCH_POLICIES, exploration_policy, search_policy

GRID = Grid(4, 3, (80, 60))


def values_of(acquisition, beta):
    """Values for a Dirichlet belief with these parameters, when nothing was visited."""
    return acquisition(DirichletBelief(beta), torch.zeros(beta.shape[:-1], dtype=torch.bool))


@pytest.fixture
def model():
    model = FovealObservationModel.identity(["cup", "cat"], [0.2, 0.4])
    model.miss_rate = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    return model.requires_grad_(False)


@pytest.mark.parametrize("name", ["non-predictive", "predictive", "neighbourhood", "foveal-hit", "place-information"])
def test_a_copied_or_pickled_search_policy_values_alike(name, model):
    policy = search_policy(name, model)
    beta = torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1)) + 0.1
    expected = values_of(policy(1, GRID), beta)
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert torch.equal(values_of(other(1, GRID), beta), expected)
        assert other.model is not model


@pytest.mark.parametrize("name", ["random", "kl", "surprise", "two-peaks", "expected-accuracy", "closer-look"])
def test_a_copied_or_pickled_exploration_policy_values_alike(name, model):
    policy = exploration_policy(name, model)
    beta = torch.rand(2, 12, 3, generator=torch.Generator().manual_seed(1)) + 0.1
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert torch.equal(values_of(other(None, GRID), beta), values_of(policy(None, GRID), beta))


def test_a_missing_model_is_told_at_once():
    free = {"random", "non-predictive", "closer-look"}
    for names, make in ((SEARCH_POLICIES, search_policy), (EXPLORATION_POLICIES, exploration_policy)):
        for name in names:
            if name in free:
                make(name)(1, GRID)
                continue
            with pytest.raises(InputError, match=f"policy '{name}': expected an observation model"):
                make(name)
