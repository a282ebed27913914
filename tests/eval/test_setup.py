"""From names of policies to how they search."""

import pytest
import torch

from eval.config import BeliefConfig
from eval.setup import belief_of, in_context, make_searcher, needs_context, needs_model, needs_target, split_policy
from semfov import FovealObservationModel, Grid
from semfov.belief import ContextObserver, ContextPrior, SemanticObserver
from semfov.errors import InputError
from semfov.gaze.acquisition import ExpectedAccuracy, PredictedTargetPosterior


@pytest.fixture
def model():
    return FovealObservationModel.identity(["cup", "cat"], [0.2], miss_rate=torch.full((3, 2), 0.5))


def test_names_tell_policy_mode_and_variants():
    assert split_policy("predictive-calibrated+soft+tempered", "search") == ("predictive", True)
    assert split_policy("target-evidence", "search") == ("target-evidence", False)
    assert split_policy("learned-raw", "search") == ("learned-raw", False)
    assert not needs_model(("learned-raw",), "search")
    assert split_policy("expected-accuracy-raw", "exploration") == ("expected-accuracy", False)
    changed = belief_of("non-predictive-raw+central+closest", BeliefConfig(prior=0.3))
    assert (changed.footprint, changed.memory, changed.prior) == ("box_centre", "closest", 0.3)
    assert belief_of("non-predictive-raw", BeliefConfig()) == BeliefConfig()
    with pytest.raises(InputError, match="did you mean 'tempered'"):
        belief_of("non-predictive-raw+temperd", BeliefConfig())
    with pytest.raises(InputError, match="did you mean"):
        split_policy("predictiv-raw", "search")


def test_a_model_is_needed_to_predict_to_calibrate_and_for_misses():
    assert not needs_model(("random", "target-evidence", "non-predictive-raw+soft"), "search")
    assert needs_model(("non-predictive-raw+misses",), "search")
    assert needs_model(("non-predictive-calibrated",), "search")
    assert needs_model(("predictive-raw",), "search")
    with pytest.raises(InputError, match="policies"):
        needs_model((), "search")


def test_searchers_are_made_as_named(model):
    searcher = make_searcher("predictive-raw+misses+tempered", "search", BeliefConfig(), 3, model)
    assert searcher.observer.misses is not None
    assert searcher.observer.observation is None
    assert searcher.observer.tempering == 0.25
    grid = Grid(4, 3, (40, 30))
    assert isinstance(searcher.policy(1, grid), PredictedTargetPosterior)
    explorer = make_searcher("expected-accuracy-calibrated+misses", "exploration", BeliefConfig(), 3, model)
    assert explorer.observer.observation is model
    assert isinstance(explorer.policy(None, grid), ExpectedAccuracy)
    with pytest.raises(InputError, match="misses"):
        make_searcher("random", "search", BeliefConfig(misses=True), 3, None)


def test_context_is_added_where_a_policy_asks_for_it():
    weights = {"evidence": (0.5, 0.25), "map": (1.0, 2.0)}
    prior = ContextPrior(["cup", "cat"], torch.zeros(3, 2, 2), torch.zeros(3, 3, 1), [], weights=weights)
    plain = SemanticObserver(3)
    assert needs_context(("random", "target-evidence+context"), BeliefConfig())
    assert needs_context(("target-evidence",), BeliefConfig(context="place"))
    assert not needs_context(("target-evidence", "non-predictive-raw+soft"), BeliefConfig())
    assert needs_target(("target-evidence+context",), "search")
    assert in_context("non-predictive-raw", "search", plain, BeliefConfig(), prior) is plain
    for ending, expected in {"context": (1.0, 2.0), "place": (1.0, 0.0), "cooccurrence": (0.0, 2.0)}.items():
        observer = in_context(f"non-predictive-raw+{ending}", "search", plain, BeliefConfig(), prior)
        assert isinstance(observer, ContextObserver)
        assert observer.weights == expected
    with pytest.raises(InputError, match="probability of the target"):
        in_context("predictive-raw+context", "search", plain, BeliefConfig(), prior)
    with pytest.raises(InputError, match="probability of the target"):
        in_context("random-raw+context", "exploration", plain, BeliefConfig(), prior)
