"""The exploration protocol against a scalar reference implementation."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from eval.comparison.looking import Candidate
from semfov import Detections, FovealObservationModel, Grid, policies
from semfov.belief.observers.semantic import SemanticLook
from semfov.data import Annotation
from semfov.episode import StoredLooks
from semfov.metrics.episodes import answers_of
from semfov.runs.config import ProtocolConfig
from semfov.runs.protocols import explorations_of, run_explorations
from semfov.runs.seeds import noise_for
from semfov.strategy import Strategy
from tests.small import FixedLook, kaplan

GRID = Grid(4, 3, (80, 60))
NOTHING = Detections.empty(12, 3)
ANNOTATION = Annotation(
    torch.tensor([[1.0, 1, 19, 19], [15, 5, 45, 15], [62, 42, 78, 58]]),
    torch.tensor([1, 2, 3]),
    torch.zeros(3, dtype=torch.bool),
    (80, 60),
)
ANSWERS = answers_of(ANNOTATION, GRID, 4)


class Scenes:
    """Two scenes; the protocol reads only their ids."""

    ids = (7, 8)


@pytest.fixture
def look():
    """Likelihoods of four classes for three detections from each of 12 cells."""
    torch.manual_seed(0)
    likelihood = torch.rand(12, 3, 4) ** 3
    return SemanticLook(likelihood, torch.rand(12, 3, 12) < 0.25, torch.zeros(12, 12))


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
    looks = StoredLooks(NOTHING, GRID) if looks is None else looks
    options = {"shifts": shifts, "batch": batch}
    return episodes, noise, run_explorations(episodes, explorer, looks, ANSWERS, noise, **options)


def from_prior(beta):
    """Their equation 19."""
    base = torch.distributions.Dirichlet(torch.full((len(beta),), 0.5, dtype=torch.float64))
    return float(torch.distributions.kl_divergence(torch.distributions.Dirichlet(torch.from_numpy(beta)), base))


def explore_by_loop(episode, look, model, answers, noise, shifts):
    """KL exploration of one episode, cell by cell, from the description in the paper."""
    beta = np.full((12, 4), 0.5)
    cell, cells, right, without_background = episode.start, [], [], []
    for shift in range(shifts + 1):
        cells.append(cell)
        for likelihood, footprint in zip(look.likelihood[cell], look.footprint[cell], strict=True):
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
            distance = ((GRID.centres - GRID.centres[fixation]).norm(dim=-1) / 80).tolist()
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
def test_exploration_equals_a_scalar_reference(look, model, shifts, batch):
    # In float64, so that the reference finds the same ties.
    double = SemanticLook(look.likelihood.double(), look.footprint, look.distance.double())
    explorer = Candidate(Strategy(FixedLook(double), policies.Policy("kl", model.double())))
    looks = StoredLooks(Detections(NOTHING.boxes.double(), NOTHING.scores.double(), NOTHING.mask), GRID)
    episodes, noise, progress = explored(explorer, starts=5, shifts=shifts, batch=batch, looks=looks)
    right_classes = [set(row.nonzero()[:, 0].tolist()) for row in ANSWERS]
    for episode, random, outcome in zip(episodes, noise, progress, strict=True):
        expected = explore_by_loop(episode, look, model, right_classes, random, shifts)
        cells, counts = outcome
        assert (cells, counts["right"], counts["right_without_background"]) == expected


def test_saliency_prior_is_that_of_the_fixated_cell(look, model):
    """The next fixation maximises the policy's value times the saliency as seen from the current cell."""
    table = torch.rand(12, 12, generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.1
    observer, policy = FixedLook(look), policies.Policy("surprise", model)
    explorer = Candidate(Strategy(observer, policy), saliency=table, weight=0.5)
    _, _, progress = explored(explorer, starts=4, shifts=6, batch=3)
    for fixated, _ in progress:
        belief, visited = observer.start(1, GRID, look.likelihood), torch.zeros(1, 12, dtype=torch.bool)
        for here, there in pairwise(fixated):
            belief = observer.update(belief, look[torch.tensor([here])])
            visited[0, here] = True
            raised = table[here] + 1e-3 * table[here].max()
            values = policy(None, GRID)(belief, visited)[0].double() * (raised / raised.sum()) ** 0.5
            assert values[there] >= values.masked_fill(visited[0], 0).max() * (1 - 1e-5)


def test_saliency_alone_replaces_the_policy(look):
    """The next fixation is the most salient cell as seen from the current one, whatever the belief."""
    saliency = torch.rand(12, 12, generator=torch.Generator().manual_seed(1))
    for table in (saliency, saliency[:1]):
        explorer = Candidate(Strategy(FixedLook(look), policies.Policy("saliency")), table)
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
