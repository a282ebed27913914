"""The protocols of searches and explorations against scalar references, a formula of chance, and other batches."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import torch

from eval.chance import random_search
from eval.comparison.looking import Candidate
from eval.explore.episodes import run_explorations
from semfov import Detections, FovealObservationModel, Grid, fusion, policies
from semfov.belief.observers.semantic import SemanticEvidence
from semfov.data import Annotation
from semfov.episode import StoredLooks
from semfov.metrics.episodes import answers_of, cumulative_performance
from semfov.runs.config import ProtocolConfig
from semfov.runs.protocols import episodes_of, explorations_of, run_episodes
from semfov.runs.seeds import noise_for
from semfov.strategy import Strategy
from tests.small import FixedLook, kaplan

CLASSES = ("cat", "cup", "person")


@dataclass
class Annotated:
    """Scenes that have annotations but no images."""

    boxes: list[torch.Tensor]
    labels: list[torch.Tensor]
    size: tuple[int, int] = (100, 100)
    classes: tuple[str, ...] = CLASSES

    @property
    def ids(self):
        return list(range(100, 100 + len(self.boxes)))

    def annotation(self, index):
        crowd = torch.zeros(len(self.labels[index]), dtype=torch.bool)
        return Annotation(self.boxes[index], self.labels[index], crowd, self.size)

    def targets(self, index):
        return sorted(set(self.labels[index].tolist()))


@pytest.fixture
def scenes():
    boxes = torch.tensor([[1.0, 1, 9, 9], [42, 42, 58, 58], [71, 1, 79, 9], [0, 80, 100, 100]])
    return Annotated([boxes, boxes], [torch.tensor([1, 2, 1, 3]), torch.tensor([3, 2, 2, 3])])


@pytest.fixture
def look():
    """Likelihoods of four classes for three detections from each of 25 cells."""
    torch.manual_seed(0)
    likelihood = torch.rand(25, 3, 4) ** 3
    return SemanticEvidence(likelihood, torch.rand(25, 3, 25) < 0.15, torch.zeros(25, 25))


GRID = Grid(5, 5, (100, 100))
NOTHING = Detections.empty(25, 3)


def tie_noise(scenes, episode, cells, protocol):
    """Random numbers of an episode."""
    return noise_for(protocol, cells, scenes.ids[episode.scene], episode.target, episode.repetition)


def stored(episodes):
    """Looks that show nothing."""
    return StoredLooks(NOTHING, GRID, torch.tensor([episode.cue for episode in episodes]))


def run(scenes, look, policy, protocol, batch=1024, index=0):
    episodes = episodes_of(scenes, index, 5, 5, protocol)
    noise = torch.stack([tie_noise(scenes, episode, 25, protocol) for episode in episodes])
    candidate = Strategy(FixedLook(look), policy)
    outcomes = run_episodes(episodes, candidate, stored(episodes), noise, shifts=protocol.shifts, batch=batch)
    return episodes, noise, outcomes


def search_by_loop(episode, look, noise, shifts):
    """Non-predictive search of one episode in scalars, from the description in the paper."""
    beta = np.full((25, 4), 0.5)
    cell, cells = episode.start, []
    for shift in range(shifts + 1):
        cells.append(cell)
        if cell in episode.goal:
            return cells, shift
        for likelihood, footprint in zip(look.likelihood[cell], look.footprint[cell], strict=True):
            for covered in footprint.nonzero()[:, 0].tolist():
                row = torch.from_numpy(beta[covered])
                beta[covered] = fusion.kaplan(row, likelihood.double()).numpy()
        posterior = beta[:, episode.target] / beta.sum(1)
        free = [c for c in range(25) if c not in cells]
        if not free:
            break
        best = max(posterior[c] for c in free)
        tied = [c for c in free if posterior[c] > best * (1 - 1e-6)]
        cell = max(tied, key=lambda c: float(noise[shift, c]))
    return cells[: shifts + 1], -1


@pytest.mark.parametrize("ties", ["random", "first"])
def test_search_equals_a_scalar_reference(scenes, look, ties):
    protocol = ProtocolConfig(starts=6, shifts=9, ties=ties)
    episodes, noise, outcomes = run(scenes, look, policies.Policy("non-predictive"), protocol)
    assert len(episodes) == 18
    for episode, random, outcome in zip(episodes, noise, outcomes, strict=True):
        assert outcome == search_by_loop(episode, look, random, 9)


def test_random_search_follows_the_hypergeometric_formula(scenes, look):
    protocol = ProtocolConfig(starts=4000, shifts=24)
    episodes, _, outcomes = run(scenes, look, policies.Policy("random"), protocol)
    for target, goals in ((1, 2), (2, 1), (3, 5)):
        found = [found_at for e, (_, found_at) in zip(episodes, outcomes, strict=True) if e.target == target]
        curve = cumulative_performance(np.array(found), 24)
        expected = random_search(goals, 24, cells=25)
        error = np.sqrt(expected * (1 - expected) / len(found))
        assert (np.abs(curve - expected) <= 4.5 * error + 1e-12).all()


class Unread(FixedLook):
    """An observer that must not be used."""

    def update(self, belief, look):
        raise AssertionError("updated")


def test_a_search_that_does_not_depend_on_the_belief_maintains_none(scenes, look):
    protocol = ProtocolConfig(starts=4, shifts=9)
    episodes, noise, expected = run(scenes, look, policies.Policy("random"), protocol)
    looks, candidate = stored(episodes), Strategy(Unread(look), policies.Policy("random"))
    assert run_episodes(episodes, candidate, looks, noise, shifts=9, batch=8) == expected
    for episode, random, outcome in zip(episodes, noise, expected, strict=True):
        cells = [episode.start]
        while len(cells) <= 9 and cells[-1] not in episode.goal:
            random[len(cells) - 1][cells] = -1
            cells.append(int(random[len(cells) - 1].argmax()))
        assert outcome[0] == cells
    seeing = Strategy(Unread(look), policies.Policy("non-predictive"))
    with pytest.raises(AssertionError, match="updated"):
        run_episodes(episodes, seeing, looks, noise, shifts=9, batch=8)


@pytest.mark.parametrize(
    "policy", [policies.Policy("random"), policies.Policy("non-predictive")], ids=lambda policy: policy.name
)
def test_outcomes_do_not_depend_on_the_batch_size(scenes, look, policy):
    protocol = ProtocolConfig(starts=7, shifts=12)
    _, _, whole = run(scenes, look, policy, protocol)
    for batch in (1, 5):
        assert run(scenes, look, policy, protocol, batch)[2] == whole


def test_episodes_start_at_different_cells_outside_the_target(scenes):
    episodes = episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=10))
    assert {episode.target for episode in episodes} == {1, 2, 3}
    for target in (1, 2, 3):
        mine = [episode for episode in episodes if episode.target == target]
        assert len({episode.start for episode in mine}) == 10
        assert all(episode.start not in episode.goal for episode in mine)
        assert {episode.goal for episode in mine} == {{1: (0, 3), 2: (12,), 3: (20, 21, 22, 23, 24)}[target]}
        assert all(episode.commonest == (target == 1) for episode in mine)


def test_controls_change_only_the_cue_or_the_goal(scenes):
    plain = episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=3))
    wrong = episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=3, control="wrong-class"))
    moved = episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=3, control="permuted"))
    assert all(episode.cue == episode.target for episode in plain + moved)
    assert all(episode.cue != episode.target and 1 <= episode.cue <= 3 for episode in wrong)
    assert [episode._replace(cue=episode.target) for episode in wrong] == plain
    assert [len(episode.goal) for episode in moved] == [len(episode.goal) for episode in plain]
    assert [episode.goal for episode in moved] != [episode.goal for episode in plain]
    assert all(episode.start not in episode.goal for episode in moved)


def test_starts_depend_on_the_seed_not_on_other_scenes_and_repeat_evenly(scenes):
    alone = Annotated(scenes.boxes[1:], scenes.labels[1:])
    alone.__class__ = type("Second", (Annotated,), {"ids": property(lambda self: [101])})
    protocol = ProtocolConfig(starts=5)
    first, second = episodes_of(scenes, 1, 5, 5, protocol), episodes_of(alone, 0, 5, 5, protocol)
    assert [e.start for e in first] == [e.start for e in second]
    assert torch.equal(tie_noise(scenes, first[3], 25, protocol), tie_noise(alone, second[3], 25, protocol))
    starts = [[e.start for e in episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=10, seed=seed))] for seed in (0, 1)]
    assert starts[0] != starts[1]
    episodes = episodes_of(scenes, 0, 5, 5, ProtocolConfig(starts=48))
    starts = [episode.start for episode in episodes if episode.target == 2]
    assert len(starts) == 48
    assert sorted(np.bincount(starts, minlength=25).tolist()) == [0] + [2] * 24


def test_a_search_ends_when_no_cell_is_left(scenes, look):
    protocol = ProtocolConfig(starts=2, shifts=40)
    episodes = episodes_of(scenes, 0, 5, 5, protocol)[:1]
    hidden = [episodes[0]._replace(goal=())]
    noise = tie_noise(scenes, episodes[0], 25, protocol)[None]
    candidate = Strategy(FixedLook(look), policies.Policy("random"))
    cells, found_at = run_episodes(hidden, candidate, stored(hidden), noise, shifts=40, batch=8)[0]
    assert found_at == -1
    assert sorted(cells) == list(range(25))


MAP = Grid(4, 3, (80, 60))
NO_OBJECT = Detections.empty(12, 3)
ANNOTATION = Annotation(
    torch.tensor([[1.0, 1, 19, 19], [15, 5, 45, 15], [62, 42, 78, 58]]),
    torch.tensor([1, 2, 3]),
    torch.zeros(3, dtype=torch.bool),
    (80, 60),
)
ANSWERS = answers_of(ANNOTATION, MAP, 4)


class Scenes:
    """Two scenes; the protocol reads only their ids."""

    ids = (7, 8)


@pytest.fixture
def shown():
    """Likelihoods of four classes for three detections from each of 12 cells."""
    torch.manual_seed(0)
    likelihood = torch.rand(12, 3, 4) ** 3
    return SemanticEvidence(likelihood, torch.rand(12, 3, 12) < 0.25, torch.zeros(12, 12))


@pytest.fixture
def model():
    clarity = torch.tensor([6.0, 1.0])
    alpha = 1 + torch.eye(4)[:, None] * clarity[:, None]
    return FovealObservationModel(alpha, [0.3], ["cat", "cup", "dog"]).requires_grad_(False).eval()


def explored(explorer, *, starts, shifts, batch=100, index=0, looks=None):
    """Explorations of a scene: the episodes, the random numbers and the outcomes."""
    protocol = ProtocolConfig(starts=starts, shifts=shifts)
    episodes = explorations_of(Scenes(), index, 12, protocol)
    noise = torch.stack(
        [noise_for(protocol, 12, Scenes().ids[episode.scene], None, episode.repetition) for episode in episodes]
    )
    looks = StoredLooks(NO_OBJECT, MAP) if looks is None else looks
    options = {"shifts": shifts, "batch": batch}
    return episodes, noise, run_explorations(episodes, explorer, looks, ANSWERS, noise, **options)


def from_prior(beta):
    """Their equation 19."""
    base = torch.distributions.Dirichlet(torch.full((len(beta),), 0.5, dtype=torch.float64))
    return float(torch.distributions.kl_divergence(torch.distributions.Dirichlet(torch.from_numpy(beta)), base))


def explore_by_loop(episode, shown, model, answers, noise, shifts):
    """KL exploration of one episode, cell by cell, from the description in the paper."""
    beta = np.full((12, 4), 0.5)
    cell, cells, right, without_background = episode.start, [], [], []
    for shift in range(shifts + 1):
        cells.append(cell)
        for likelihood, footprint in zip(shown.likelihood[cell], shown.footprint[cell], strict=True):
            for covered in footprint.nonzero()[:, 0].tolist():
                beta[covered] = kaplan(beta[covered], likelihood.double().numpy())
        counts = [0, 0]
        for place in range(12):
            for number, offered in enumerate(([0, 1, 2, 3], [1, 2, 3])):
                best = max(beta[place, k] for k in offered)
                winners = [k for k in offered if beta[place, k] > best * (1 - 1e-6)]
                counts[number] += len(winners) == 1 and winners[0] in answers[place]
        right.append(counts[0])
        without_background.append(counts[1])
        # What a cell adds to the value of a fixation depends only on the level at which it is seen.
        gains = []
        for place in range(12):
            p = beta[place] / beta[place].sum()
            scores = [p @ model.expected_scores()[:, level].double().numpy() for level in range(2)]
            gains.append([from_prior(kaplan(beta[place], seen)) - from_prior(beta[place]) for seen in scores])
        values = []
        for fixation in range(12):
            distance = ((MAP.centres - MAP.centres[fixation]).norm(dim=-1) / 80).tolist()
            values.append(sum(gains[place][int(distance[place] > 0.3)] for place in range(12)))
        free = [c for c in range(12) if c not in cells]
        if not free:
            right += [right[-1]] * (shifts - shift)
            without_background += [without_background[-1]] * (shifts - shift)
            break
        best = max(values[c] for c in free)
        tied = [c for c in free if values[c] > best * (1 - 1e-6)]
        cell = max(tied, key=lambda c: float(noise[shift, c]))
    return cells, right, without_background


@pytest.mark.parametrize("batch", [2, 100])
@pytest.mark.parametrize("shifts", [5, 14])
def test_exploration_equals_a_scalar_reference(shown, model, shifts, batch):
    # In float64, so that the reference finds the same ties.
    double = SemanticEvidence(shown.likelihood.double(), shown.footprint, shown.distance.double())
    explorer = Candidate(Strategy(FixedLook(double), policies.Policy("kl", model.double())))
    looks = StoredLooks(Detections(NO_OBJECT.boxes.double(), NO_OBJECT.scores.double(), NO_OBJECT.mask), MAP)
    episodes, noise, progress = explored(explorer, starts=5, shifts=shifts, batch=batch, looks=looks)
    right_classes = [set(row.nonzero()[:, 0].tolist()) for row in ANSWERS]
    for episode, random, outcome in zip(episodes, noise, progress, strict=True):
        expected = explore_by_loop(episode, shown, model, right_classes, random, shifts)
        cells, counts = outcome
        assert (cells, counts["right"], counts["right_without_background"]) == expected


def test_saliency_prior_is_that_of_the_fixated_cell(shown, model):
    """The next fixation maximises the policy's value times the saliency as seen from the current cell."""
    table = torch.rand(12, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.1
    observer, policy = FixedLook(shown), policies.Policy("surprise", model)
    explorer = Candidate(Strategy(observer, policy), saliency=table, weight=0.5)
    _, _, progress = explored(explorer, starts=4, shifts=6, batch=3)
    for fixated, _ in progress:
        belief, visited = observer.start(1, MAP, shown.likelihood), torch.zeros(1, 12, dtype=torch.bool)
        for here, there in pairwise(fixated):
            belief = observer.update(belief, shown[torch.tensor([here])])
            visited[0, here] = True
            raised = table[here] + 1e-3 * table[here].max()
            values = policy(None, MAP)(belief, visited)[0].double() * (raised / raised.sum()) ** 0.5
            assert values[there] >= values.masked_fill(visited[0], 0).max() * (1 - 1e-5)


def test_saliency_alone_replaces_the_policy(shown):
    """The next fixation is the most salient cell as seen from the current one, whatever the belief."""
    saliency = torch.rand(12, 12, generator=torch.Generator().manual_seed(1))
    for table in (saliency, saliency[:1]):
        explorer = Candidate(Strategy(FixedLook(shown), policies.Policy("saliency")), table)
        episodes, _, progress = explored(explorer, starts=12, shifts=11, index=1)
        assert sorted(episode.start for episode in episodes) == list(range(12))
        for episode, (fixated, _) in zip(episodes, progress, strict=True):
            cells = [episode.start]
            while len(cells) < 12:
                seen = table[cells[-1] if len(table) > 1 else 0].clone()
                seen[cells] = -1
                cells.append(int(seen.argmax()))
            assert fixated == cells


def test_starts_and_tie_breaking_noise_depend_on_the_seed():
    one, other = ProtocolConfig(starts=6), ProtocolConfig(starts=6, seed=1)
    assert explorations_of(Scenes(), 0, 100, one) != explorations_of(Scenes(), 0, 100, other)
    assert explorations_of(Scenes(), 0, 100, one) == explorations_of(Scenes(), 0, 100, one)
    assert torch.equal(noise_for(one, 9, 7, None, 0), noise_for(one, 9, 7, None, 0))
    assert not torch.equal(noise_for(one, 9, 7, None, 0), noise_for(other, 9, 7, None, 0))
