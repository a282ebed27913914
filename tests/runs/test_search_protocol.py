"""The search protocol against a scalar reference and the hypergeometric formula, and with other batch sizes."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

from eval.chance import random_search
from semfov import Detections, Grid, fusion, policies
from semfov.belief.observers.semantic import SemanticLook
from semfov.data import Annotation
from semfov.episode import StoredLooks
from semfov.metrics.episodes import cumulative_performance
from semfov.runs.config import ProtocolConfig
from semfov.runs.protocols import episodes_of, run_episodes
from semfov.runs.seeds import noise_for
from semfov.strategy import Strategy
from tests.small import FixedLook

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
    return SemanticLook(likelihood, torch.rand(25, 3, 25) < 0.15, torch.zeros(25, 25))


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


def test_an_episode_does_not_depend_on_other_scenes(scenes):
    alone = Annotated(scenes.boxes[1:], scenes.labels[1:])
    alone.__class__ = type("Second", (Annotated,), {"ids": property(lambda self: [101])})
    protocol = ProtocolConfig(starts=5)
    first, second = episodes_of(scenes, 1, 5, 5, protocol), episodes_of(alone, 0, 5, 5, protocol)
    assert [e.start for e in first] == [e.start for e in second]
    assert torch.equal(tie_noise(scenes, first[3], 25, protocol), tie_noise(alone, second[3], 25, protocol))


def test_starts_depend_on_the_seed_and_repeat_evenly(scenes):
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
