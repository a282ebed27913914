"""Ideal searchers against loops, an adaptive integral, simulation, and results of Najemnik and Geisler."""

from math import inf, log

import numpy as np
import pytest
import torch
from scipy import integrate
from scipy.stats import norm

from semfov import DirichletBelief, FovealObservationModel, Grid, InputError
from semfov.gaze.acquisition import CorrectLocalisation, EntropyLimit, TargetPosterior
from semfov.gaze.acquisition.ideal import _correct_localisation
from semfov.observation import visibility

GRID = Grid(4, 3, (80, 60))


def make_model(dtype=torch.float64):
    """Two classes at three levels; recognition gets worse from level to level."""
    generator = torch.Generator().manual_seed(0)
    alpha = 1 + torch.rand(3, 3, 3, generator=generator, dtype=torch.float64)
    alpha += 5 * torch.eye(3)[:, None] * torch.tensor([1.0, 0.4, 0.1])[:, None]
    missed = torch.tensor([[0.8, 0.8, 0.9], [0.1, 0.5, 0.9], [0.2, 0.4, 0.8]])
    return FovealObservationModel(alpha.to(dtype), [0.3, 0.6], ["cup", "cat"], miss_rate=missed)


def make_belief(dtype=torch.float64, batch=2, seed=0):
    beta = torch.rand(batch, 12, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2 + 0.02
    return DirichletBelief(beta.to(dtype))


def nothing_visited(belief):
    return torch.zeros(belief.beta.shape[:-1], dtype=torch.bool, device=belief.beta.device)


def place_of(belief, target, visited):
    p = belief.probability(target).masked_fill(visited, 0)
    return p / p.sum(-1, keepdim=True)


def test_entropy_limit_equals_the_loop():
    belief, visited = make_belief(), torch.zeros(2, 12, dtype=torch.bool)
    visited[0, [1, 5]] = visited[1, 11] = True
    target = torch.tensor([1, 2])
    got = EntropyLimit(target, make_model(), GRID)(belief, visited)
    seen = visibility(make_model()).detach()
    for episode in range(2):
        p = [0.0 if visited[episode, x] else float(belief.probability(target)[episode, x]) for x in range(12)]
        for f in range(12):
            total = 0.0
            for x in range(12):
                level = int(torch.bucketize(GRID.cell_distance[f, x], torch.tensor([0.3, 0.6])))
                total += 0.5 * p[x] / sum(p) * float(seen[int(target[episode]), level]) ** 2
            assert float(got[episode, f]) == pytest.approx(total, rel=1e-6)


def integral(place, signal):
    """The published formula, by an adaptive integral."""
    total = 0.0
    for i, p in enumerate(place):
        rivals = [j for j in range(len(place)) if j != i and place[j] > 0]

        def right(w, i=i, p=p, rivals=rivals):
            bounds = [
                (-2 * log(place[j] / p) + signal[j] ** 2 + 2 * signal[i] * w + signal[i] ** 2) / (2 * signal[j])
                for j in rivals
            ]
            return norm.pdf(w) * np.prod(norm.cdf(bounds))

        if p > 0:
            total += p * integrate.quad(right, -9, 9, limit=400)[0]
    return total


@pytest.mark.parametrize("seed", range(3))
def test_localisation_equals_the_adaptive_integral(seed):
    rng = np.random.default_rng(seed)
    place, signal = rng.dirichlet(np.ones(9)), rng.uniform(0.3, 3, 9)
    place[3] = 0
    place /= place.sum()
    exact = integral(place, signal)
    for nodes, tolerance in ((64, 2e-4), (256, 1e-5)):
        got = _correct_localisation(torch.tensor(place), torch.tensor(signal), nodes=nodes)
        assert float(got) == pytest.approx(exact, abs=tolerance)


def test_localisation_equals_a_simulation_of_responses():
    """Every cell gives a noisy response; the search answers with the cell of the largest posterior."""
    rng = np.random.default_rng(0)
    place, signal, count = rng.dirichlet(np.full(8, 0.7)), rng.uniform(0.2, 2.5, 8), 400_000
    target = rng.choice(8, count, p=place)
    answer = rng.normal(-0.5, 1 / signal, (count, 8))
    answer[np.arange(count), target] += 1
    posterior = np.log(place) + signal**2 * answer
    share = (posterior.argmax(1) == target).mean()
    got = float(_correct_localisation(torch.tensor(place), torch.tensor(signal)))
    assert got == pytest.approx(share, abs=5 * (0.25 / count) ** 0.5)


class Sharp:
    """Sees targets perfectly in the fixated cell, and not at all in other cells."""

    miss_rate = torch.tensor([[0.5, 1.0], [1e-4, 1.0]], dtype=torch.float64)
    alpha = torch.tensor([[[60.0, 1.0]] * 2, [[1.0, 60.0]] * 2], dtype=torch.float64)

    def level(self, distance):
        return (distance > 1e-6).long()


@pytest.mark.parametrize("kind", [EntropyLimit, CorrectLocalisation])
def test_with_a_fovea_of_one_cell_they_fixate_the_most_probable_place(kind):
    """Published: for a searcher who sees only the fixated cell, the most probable place is the best fixation."""
    beta = torch.rand(20, 12, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.1
    belief = DirichletBelief(beta)
    visited = torch.zeros(20, 12, dtype=torch.bool)
    visited[:, 4] = True
    cells = [
        values(belief, visited).masked_fill(visited, -inf).argmax(-1)
        for values in (kind(1, Sharp(), GRID), TargetPosterior(1))
    ]
    agree = float((cells[0] == cells[1]).double().mean())
    # The ideal searcher need not look at the cell that it would answer anyway, so it may take the second best.
    assert agree == 1 if kind is EntropyLimit else agree < 1
    if kind is CorrectLocalisation:
        ranks = TargetPosterior(1)(belief, visited).masked_fill(visited, -inf).argsort(-1, descending=True)
        assert bool(((cells[0] == ranks[:, 0]) | (cells[0] == ranks[:, 1])).all())


@pytest.mark.parametrize("kind", [EntropyLimit, CorrectLocalisation])
def test_with_a_uniform_prior_the_first_fixation_is_at_the_centre(kind):
    """Published: first fixations of the ideal searcher are central, where most of the display is seen best."""
    grid, belief = Grid(5, 5, (100, 100)), DirichletBelief(torch.ones(1, 25, 3, dtype=torch.float64))
    assert int(kind(1, make_model(), grid)(belief, nothing_visited(belief)).argmax()) == 12


def test_entropy_limit_is_nearly_optimal():
    """Published: entropy limit minimisation is nearly optimal. Its choices lose little of the gain."""
    belief = make_belief(batch=40, seed=7)
    visited = nothing_visited(belief)
    told = CorrectLocalisation(1, make_model(), GRID)(belief, visited)
    chosen = EntropyLimit(1, make_model(), GRID)(belief, visited).argmax(-1, keepdim=True)
    gain = told - place_of(belief, 1, visited).amax(-1, keepdim=True)
    assert float((gain.gather(-1, chosen)[:, 0] / gain.amax(-1)).mean()) > 0.9
    assert float((gain.mean(-1) / gain.amax(-1)).mean()) < 0.8


@pytest.mark.parametrize("kind", [EntropyLimit, CorrectLocalisation])
def test_an_episode_does_not_depend_on_the_others(kind):
    belief, target = make_belief(batch=5), torch.tensor([1, 2, 1, 2, 2])
    visited = torch.rand(5, 12, generator=torch.Generator().manual_seed(0)) < 0.3
    together = kind(target, make_model(), GRID)(belief, visited)
    for episode in range(5):
        part = slice(episode, episode + 1)
        alone = kind(target[part], make_model(), GRID)(belief[part], visited[part])
        assert torch.equal(alone, together[part])


def test_values_are_finite_where_the_target_has_probability_zero():
    belief = DirichletBelief(torch.tensor([1.0, 0.0]).repeat(1, 12, 1), torch.zeros(1, 12))
    for kind in (EntropyLimit, CorrectLocalisation):
        assert bool(kind(1, Sharp(), GRID)(belief, nothing_visited(belief)).isfinite().all())


def test_gradients_of_localisation():
    place = make_belief().probability(1).softmax(-1)[:1, :5].requires_grad_()
    signal = torch.linspace(0.3, 2, 5, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda p, d: _correct_localisation(p, d, nodes=24), (place, signal))


def test_values_use_the_given_number_of_integration_nodes():
    place, signal = make_belief(batch=3).probability(1), torch.rand(3, 12, 12, dtype=torch.float64) + 0.3
    place = place / place.sum(-1, keepdim=True)
    for nodes in (8, 16):
        got = CorrectLocalisation(1, make_model(), GRID, nodes=nodes).values(place, signal)
        expected = [
            [float(_correct_localisation(p, d, nodes=nodes)) for d in s] for p, s in zip(place, signal, strict=True)
        ]
        torch.testing.assert_close(got, torch.tensor(expected, dtype=torch.float64))
    usual = CorrectLocalisation(1, make_model(), GRID).values(place, signal)
    assert torch.equal(usual, CorrectLocalisation(1, make_model(), GRID, nodes=64).values(place, signal))
    assert not torch.allclose(usual, got, rtol=1e-6)
    with pytest.raises(InputError, match="nodes: expected 8 or more, got 7"):
        CorrectLocalisation(1, make_model(), GRID, nodes=7)


@pytest.mark.parametrize("nodes", [8, 64])
def test_localisation_is_a_sum_over_equidistant_noise(nodes):
    """Noise from -5 to 5, each weighted by its normal density; 64 nodes by default."""
    rng = np.random.default_rng(1)
    place, signal = rng.dirichlet(np.ones(5)), rng.uniform(0.3, 3, 5)
    noise = [-5 + 10 * step / (nodes - 1) for step in range(nodes)]
    total = 0.0
    for x in range(5):
        for w in noise:
            right = 1.0
            for y in set(range(5)) - {x}:
                ahead = 2 * log(place[x] / place[y]) + signal[y] ** 2 + signal[x] ** 2 + 2 * signal[x] * w
                right *= norm.cdf(ahead / (2 * signal[y]))
            total += place[x] * right * norm.pdf(w) / sum(norm.pdf(noise))
    told = {} if nodes == 64 else {"nodes": nodes}
    got = _correct_localisation(torch.tensor(place), torch.tensor(signal), **told)
    assert float(got) == pytest.approx(total, rel=1e-12)
