"""Additional correct cells, by an observation model and by a learned map, against loops; policies for learned maps."""

import pytest
import torch

from semfov import Detections, DirichletBelief, FovealObservationModel, Grid, InputError, MapEvidence, TargetEvidence
from semfov.belief.observers import LearnedMap, Semantic, Target
from semfov.gaze.acquisition import CloserLook, ExpectedAccuracy, ExpectedGain
from semfov.runs.config import BeliefConfig, PolicyConfig
from semfov.runs.policy_looking import _make_strategy, _Models
from semfov.runs.presets import presets, resolve
from semfov.strategy import Strategy
from tests.refusals import refused
from tests.small import values_of

GRID, CELLS = Grid(5, 4, (50, 40)), Grid(4, 3, (80, 60))


@pytest.fixture
def model():
    generator = torch.Generator().manual_seed(1)
    model = MapEvidence(5, 4, components=4)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(0.6 * torch.randn(parameter.shape, generator=generator))
    return model.requires_grad_(False).eval()


def belief_of(model, dtype=torch.float32, device=None):
    """Beliefs of three episodes after two looks."""
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(3, 4, 2, generator=generator) * 30
    boxes = torch.cat([corner, corner + 3 + torch.rand(3, 4, 2, generator=generator) * 15], -1)
    scores = (3 * torch.rand(3, 4, 4, generator=generator)).softmax(-1)
    seen = Detections(boxes.to(device, dtype), scores.to(device, dtype), torch.ones(3, 4, dtype=bool, device=device))
    observer = LearnedMap(model)
    belief, visited = observer.start(3, GRID, seen.scores), torch.zeros(3, 20, dtype=torch.bool, device=device)
    for cells in ([0, 7, 19], [4, 8, 2]):
        belief = observer(belief, seen, GRID.centres[cells].to(seen.boxes), GRID)
        visited[[0, 1, 2], cells] = True
    return belief, visited


def test_gain_is_summed_over_all_cells(model, dtype, device):
    model = model.to(device, dtype)
    belief, visited = belief_of(model, dtype, device)
    acquisition = ExpectedGain(model, GRID).to(device)
    got = acquisition(belief, visited)
    assert got.shape == (3, 20)
    assert got.dtype == dtype
    assert got.device.type == device.type
    for episode in range(3):
        one = belief[episode : episode + 1]
        for fixation in range(20):
            distance = GRID.distance(GRID.centres[fixation])[None].to(one.closest)
            gains = model.gain(one.probabilities, one.closest, one.looks, distance)[0, 0]
            total = 0.0
            for cell, told in enumerate(gains):
                nearer = float(distance[0, cell]) < float(one.closest[0, cell]) - 1e-6
                assert nearer == (float(told) != 0)
                total += float(told)
            assert float(got[episode, fixation]) == pytest.approx(total, abs=1e-4)
    # A second look at the same cell gains nothing.
    assert not got[visited].any()
    assert bool((got[~visited] != 0).all())


def test_other_beliefs_are_refused(model):
    acquisition, visited = ExpectedGain(model, GRID), torch.zeros(1, 20, dtype=torch.bool)
    like = torch.empty(0)
    for observer in (Semantic(4), Target(TargetEvidence(4, 4, components=4))):
        belief = observer.start(1, GRID, like)
        refused(f"belief: expected MapBelief, got {type(belief).__name__}", acquisition, belief, visited)


def test_closer_look_accepts_a_learned_map(model):
    """Only the shares of the objects count, so a Dirichlet belief with these shares has the same values."""
    belief, visited = belief_of(model)
    shares = DirichletBelief(belief.probabilities, belief.closest)
    torch.testing.assert_close(CloserLook(GRID, 0.2)(belief, visited), CloserLook(GRID, 0.2)(shares, visited))


LEARNED = {
    "random-learned": PolicyConfig("random", "learned"),
    "closer-look-learned": PolicyConfig("closer-look", "learned"),
    "expected-gain-learned": PolicyConfig("expected-gain", "learned"),
    "vocus2-learned": PolicyConfig("saliency", "learned", saliency="vocus2"),
    "itti-koch-learned": PolicyConfig("saliency", "learned", saliency="itti-koch"),
}


DIRICHLET = ("kl", "negative-entropy", "surprise", "two-peaks")


@pytest.mark.parametrize(
    ("task", "policy", "scores", "expected"),
    [
        *(("exploration", policy, "learned", "expected 'raw' or 'calibrated' for policy") for policy in DIRICHLET),
        *(
            ("exploration", "expected-gain", scores, "expected 'learned' for policy")
            for scores in ("raw", "calibrated")
        ),
        *(("search", policy, "learned", ".*") for policy in ("random", "non-predictive", "target-evidence")),
    ],
)
def test_policies_refuse_scores_of_another_belief(task, policy, scores, expected):
    """Policies for Dirichlet beliefs need an observation model or a Dirichlet belief; a learned map has neither."""
    refused(f"^scores: {expected} ?'{policy}', got '{scores}'", resolve, PolicyConfig(policy, scores), task)
    if task == "exploration":
        assert f"{policy}-{scores}" not in presets(task)
        refused("policy", resolve, f"{policy}-{scores}", task)


@pytest.mark.parametrize(
    "setting", [{"tempering": 0.5}, {"footprint": "soft"}, {"memory": "closest"}, {"misses": True}], ids=str
)
@pytest.mark.parametrize("policy", sorted(LEARNED))
def test_settings_of_another_belief_are_refused(policy, setting):
    own = LEARNED[policy]
    with pytest.raises(InputError, match=f"^{next(iter(setting))}: expected null, .*has its own belief"):
        resolve(PolicyConfig(own.policy, "learned", saliency=own.saliency, **setting), "exploration")


def test_strategies_of_learned_maps(model):
    def strategy(name, **models):
        return _make_strategy(resolve(name, "exploration"), "exploration", BeliefConfig(), 4, _Models(**models), 0.15)

    for name, policy in LEARNED.items():
        made = strategy(name, map=model)
        assert isinstance(made, Strategy)
        assert isinstance(made.observer, LearnedMap)
        assert made.observer.model is model
        assert not made.observer.together
        assert made.policy.name == policy.policy
        with pytest.raises(InputError, match=r"expected a learned map.*, got none"):
            strategy(name, observation=FovealObservationModel.identity(["a", "b", "c"], [0.2]))
    assert strategy("closer-look-learned", map=model).policy.fovea == 0.15


def test_a_grid_in_double_precision_works_with_a_belief_in_single_precision(model):
    belief, visited = belief_of(model)
    wide = ExpectedGain(model, Grid(5, 4, torch.tensor([50.0, 40.0], dtype=torch.float64)))
    torch.testing.assert_close(wide(belief, visited), ExpectedGain(model, GRID)(belief, visited))


class Model:
    """Two classes at three levels."""

    miss_rate = torch.tensor([[0.9, 0.9, 0.9], [0.1, 0.5, 0.9], [0.3, 0.6, 0.8]], dtype=torch.float64)

    def level(self, distance):
        return torch.bucketize(distance, torch.tensor([0.2, 0.5]))

    def expected_scores(self):
        torch.manual_seed(3)
        return (4 * torch.eye(3)[:, None] + torch.rand(3, 3, 3)).double().softmax(-1)


@pytest.fixture
def beta():
    torch.manual_seed(0)
    return torch.rand(2, 12, 3, dtype=torch.float64) ** 2 + 0.02


def test_value_equals_the_loop(beta):
    acquisition = ExpectedAccuracy(Model(), CELLS)
    got = values_of(acquisition, beta)
    torch.testing.assert_close(values_of(acquisition, beta[0]), got[0])
    right, levels = Model().expected_scores(), Model().level(CELLS.cell_distance)
    for episode in range(2):
        p = beta[episode] / beta[episode].sum(-1, keepdim=True)
        for f in range(12):
            total = 0.0
            for x in range(12):
                n = int(levels[f, x])
                seen = sum(float(p[x, k] * (1 - Model.miss_rate[k, n]) * right[k, n, k]) for k in (1, 2))
                missed = max(float(p[x, k] * Model.miss_rate[k, n]) for k in (1, 2))
                total += max(0.0, seen + missed - float(p[x, 1:].max()))
            assert float(got[episode, f]) == pytest.approx(total)
