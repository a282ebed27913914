"""The fit of target evidence: examples, objectives and thresholds against loops, training, reports."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from semfov import EmbeddedScenes, Grid, TargetEvidence, rollout
from semfov.belief.look_features import look_features
from semfov.belief.observers import Target
from semfov.belief.target_evidence import Thresholds
from semfov.episode import StoredLooks
from semfov.fit.evidence import (
    _JUDGED,
    FitSearchConfig,
    _evidence_report,
    _train_evidence,
    evidence_objective,
    judge_evidence,
    make_examples,
)
from semfov.fit.examples import _ExampleLooks, example_episodes
from semfov.fit.protocols import choose_classes, numbers_drawn
from semfov.fit.thresholds import choose_thresholds
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Given
from tests.small import cells_of, looking

GRID = Grid(4, 4, (640, 480))
CELLS = 16
CLASSES = ("person", "dog", "boat", "truck", "zebra", "banana", "kite", "toaster")


@pytest.fixture(scope="module")
def run():
    """A stand-in for a run with stored looks at five embedded scenes."""
    return looking(CLASSES, GRID, 5)


@pytest.fixture(scope="module")
def examples(run):
    return make_examples(run, FitSearchConfig(classes=2, max_target_area=0.5))


def classes_in(annotation, cell):
    left, top = cell % 4 * 160, cell // 4 * 120
    return {
        label
        for (x, y, z, w), label in zip(annotation.boxes.tolist(), annotation.labels.tolist(), strict=True)
        if x < left + 160 and z > left and y < top + 120 and w > top
    }


def test_examples_match_looks_from_every_cell(run, examples):
    assert len(examples) == len(examples.goal) > 10
    kinds = set()
    for row in range(len(examples)):
        index, target = int(examples.scene[row]), int(examples.target[row])
        annotation, seen = run.scenes.annotation(index), run.detections(index)
        features = look_features(seen, GRID.centres, GRID, target)
        assert examples.features.dtype == torch.float16
        assert torch.equal(examples.features[row], features.half())
        for cell in range(CELLS):
            shown = [float(seen.scores[cell, d, target]) for d in range(5) if seen.mask[cell, d]]
            assert float(examples.score[row, cell]) == pytest.approx(max(shown, default=0.0))
            there = target in classes_in(annotation, cell)
            assert bool(examples.goal[row, cell]) == there
            for other in range(CELLS):
                offset = math.dist(GRID.centres[cell].tolist(), GRID.centres[other].tolist())
                assert float(examples.distance[row, cell, other]) == pytest.approx(offset / 640, abs=1e-5)
        held = target in annotation.labels.tolist()
        assert bool(examples.goal[row].any()) == held
        kinds.add(held)
    assert kinds == {True, False}


def test_as_many_absent_as_present_classes_are_chosen(run, examples):
    for index in range(len(run.scenes)):
        labels = set(run.scenes.annotation(index).labels.tolist())
        chosen = examples.target[examples.scene == index].tolist()
        there = [target for target in chosen if target in labels]
        assert len(chosen) == len(set(chosen)) == 2 * len(there)
        assert 1 <= len(there) <= 2
        annotation = run.scenes.annotation(index)
        assert chosen == choose_classes(run.scenes, index, annotation, 2, 0.5, 0)
        # The choice depends on the scene and the seed, not on the number of scenes.
        assert chosen == choose_classes(EmbeddedScenes(CLASSES, count=9), index, annotation, 2, 0.5, 0)
    draws = {seed: choose_classes(run.scenes, 0, run.scenes.annotation(0), 1, 1.0, seed) for seed in range(20)}
    assert len({tuple(draw) for draw in draws.values()}) > 5
    assert choose_classes(run.scenes, 0, run.scenes.annotation(0), 2, 0.0, 0) == []


@pytest.mark.parametrize("absent", [None, 3])
def test_the_numbers_of_drawn_searches_are_means_over_draws(absent):
    scenes = EmbeddedScenes(CLASSES, count=4)
    there, missing = numbers_drawn(scenes, 2, 0.5, absent)
    counts, draws = torch.zeros(2, len(CLASSES)), 400
    for index in range(len(scenes)):
        annotation = scenes.annotation(index)
        held = set(annotation.labels.tolist())
        for seed in range(draws):
            for target in choose_classes(scenes, index, annotation, 2, 0.5, seed, absent):
                counts[int(target not in held), target - 1] += 1 / draws
    # The standard error of a mean of 4 x 400 draws is 0.05 at most.
    assert torch.allclose(counts[0].double(), there, atol=0.2)
    assert torch.allclose(counts[1].double(), missing, atol=0.2)


def test_looks_of_examples_match_stored_looks(run, examples):
    """The beliefs are equal except for the rounding of features to half precision."""
    torch.manual_seed(1)
    model = TargetEvidence(6, 5, components=len(CLASSES) + 1).eval().requires_grad_(False)
    cells = torch.tensor([[3, 7, 1, 12], [0, 15, 14, 2]])
    chosen = torch.tensor([0, len(examples) - 1])
    steps = rollout(
        _ExampleLooks(examples[chosen], GRID), Target(model), TargetPosterior(1), cells[:, 0], Given(cells), most=4
    )
    beliefs = [step.belief for step in steps]
    for row, example in enumerate(chosen.tolist()):
        target = examples.target[example : example + 1]
        stored = StoredLooks(run.detections(int(examples.scene[example])), GRID, target)
        path = cells[row : row + 1]
        alone = rollout(stored, Target(model), TargetPosterior(target), path[:, 0], Given(path), most=4)
        for number, step in enumerate(alone):
            both = beliefs[number]
            assert torch.equal(both.visited[row], step.belief.visited[0])
            for name in ("present", "following", "anywhere", "nearest", "best", "closest", "score"):
                torch.testing.assert_close(
                    getattr(both, name)[row], getattr(step.belief, name)[0], atol=5e-3, rtol=5e-3, msg=name
                )


def test_training_searches_visit_every_cell_once(examples):
    torch.manual_seed(1)
    model = TargetEvidence(4, 4, components=len(CLASSES) + 1).requires_grad_(False)
    for astray in (0.0, 0.5, 1.0):
        generator = torch.Generator().manual_seed(0)
        observer, policy = Target(model, together=True), TargetPosterior(1)
        steps = [*example_episodes(examples, observer, policy, GRID, 30, astray, generator)]
        assert len(steps) == CELLS
        cells = torch.stack([step.cell for step in steps])
        assert torch.equal(cells.sort(0).values, torch.arange(CELLS)[:, None].expand_as(cells))
        if astray == 0:
            for before, after in pairwise(steps):
                best = before.belief.following.masked_fill(before.visited, -1).amax(-1)
                chosen = before.belief.following.gather(1, after.cell[:, None])[:, 0]
                torch.testing.assert_close(chosen, best)


@pytest.mark.parametrize("held", [[[2, 7], [], [4]], [[], [], []], [[4], [4], [4]]], ids=str)
def test_objective_equals_its_formula(held):
    """Computed in scalars; one case has no target, and in the last one every search has visited its target."""
    generator = torch.Generator().manual_seed(0)
    cells, following = torch.rand(2, 3, CELLS, generator=generator, dtype=torch.float64)
    anywhere = torch.rand(3, generator=generator, dtype=torch.float64)
    goal, visited = torch.zeros(2, 3, CELLS, dtype=torch.bool)
    for row, places in enumerate(held):
        goal[row, places] = True
    visited[:, [4, 9]] = True
    following_cell = torch.tensor([2, 0, 7])
    config = FitSearchConfig(landing=0.7, presence=0.4, selected=0.3)
    entropy, telling, landing, gazing = [], [], [], []
    for row in range(3):
        for cell in (int(following_cell[row]), max((4, 9), key=lambda c: float(cells[row, c]))):
            p = float(cells[row, cell])
            gazing.append(-math.log(p if cell in held[row] else 1 - p))
        for cell in range(CELLS):
            p = float(cells[row, cell])
            entropy.append(-math.log(p if cell in held[row] else 1 - p))
        p = float(anywhere[row])
        telling.append(-math.log(p if held[row] else 1 - p))
        if held[row] and 4 not in held[row]:
            odds = {c: float(following[row, c] / (1 - following[row, c])) for c in range(CELLS) if c not in (4, 9)}
            landing.append(-math.log(sum(odds[c] for c in held[row]) / sum(odds.values())))
    expected = 4 * sum(entropy) / len(entropy) + 0.4 * sum(telling) / 3
    expected += 0.3 * sum(gazing) / 3
    expected += 0.7 * sum(landing) / len(landing) if landing else 0
    belief = Target(TargetEvidence(4, 4)).start(3, GRID, cells)
    belief = replace(belief, present=cells, following=following, anywhere=anywhere)
    got = evidence_objective(config, SimpleNamespace(belief=belief, visited=visited, next_cell=following_cell), goal)
    assert float(got) == pytest.approx(expected, rel=1e-6)


def test_gradients_of_certain_beliefs_are_finite():
    """Wrong probabilities of exactly 0 and 1 have a large but finite loss."""
    cells = torch.tensor([[0.0, 1.0] * 8, [1.0, 0.0] * 8]).requires_grad_()
    goal = torch.zeros(2, CELLS, dtype=torch.bool)
    goal[0, 2] = True
    belief = Target(TargetEvidence(4, 4)).start(2, GRID, cells.detach())
    belief = replace(belief, present=cells, following=cells, anywhere=cells[:, 0])
    visited, following_cell = goal.new_zeros(2, CELLS), torch.tensor([0, 1])
    visited[:, [2, 3]] = True
    step = SimpleNamespace(belief=belief, visited=visited, next_cell=following_cell)
    loss = evidence_objective(FitSearchConfig(), step, goal)
    loss.backward()
    assert bool(loss.isfinite())
    assert bool(cells.grad.isfinite().all())


def best_thresholds_by_loop(config, anywhere, place, left, there):
    """The best thresholds among all combinations, applied look by look."""

    def found(search, confirm, least, stop_below):
        for look in range(len(anywhere)):
            known = float(place[look, search])
            if float(anywhere[look, search]) >= confirm and known > 0 and known >= least:
                return True
            if float(left[look, search]) < stop_below:
                return False
        return False

    holding = there.nonzero()[:, 0].tolist()
    others = (~there).nonzero()[:, 0].tolist()

    def confirm_and_hits(least):
        passing = []
        for confirm in torch.arange(0.99, 0.49, -0.01).tolist():
            if sum(found(search, confirm, least, 0.0) for search in others) > config.false_alarms * len(others):
                break
            passing.append(confirm)
        confirm = min(passing, default=1.0)
        return confirm, sum(found(search, confirm, least, 0.0) for search in holding)

    wherever, least = confirm_and_hits(0.0)[1], 0.0
    for candidate in torch.arange(0.95, 0.04, -0.05).tolist():
        if candidate > least and wherever - confirm_and_hits(candidate)[1] <= config.lost * len(holding):
            least = candidate
    confirm, hits = confirm_and_hits(least)
    kept = [
        stop_below
        for stop_below in (0.3, 0.25, 0.2, 0.15, 0.1, 0.07, 0.05, 0.03, 0.02, 0.01, 0.007, 0.005, 0.003, 0.002, 0.001)
        if hits - sum(found(search, confirm, least, stop_below) for search in holding) <= config.lost * len(holding)
    ]
    return Thresholds(confirm, max(kept, default=0.0), least)


@pytest.mark.parametrize("seed", range(6))
def test_thresholds_equal_the_best_of_all_combinations(seed):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    looks, searched = 5, 25
    there = draw(searched) < 0.5
    scale = 0.4 + 0.6 * draw(searched)
    anywhere = (draw(looks, searched) * 0.5 + 0.5 * there) * (scale if seed % 2 else 1)
    left = draw(looks, searched).pow(2 + 4 * (seed % 3)) * draw(searched)
    looked = draw(looks, searched) < torch.linspace(0.2, 0.9, looks)[:, None]
    place = looked * (0.3 * draw(looks, searched) + 0.7 * anywhere)
    config = FitSearchConfig(false_alarms=(0.0, 0.03, 0.2)[seed % 3], lost=(0.0, 0.05)[seed % 2])
    got = choose_thresholds(config, anywhere, place, left, there)
    assert got == best_thresholds_by_loop(config, anywhere, place, left, there)


def test_thresholds_of_uninformative_and_perfect_searches():
    """Uninformative searches confirm nothing; perfect ones confirm from a probability of one half on."""
    there = torch.tensor([True, False])
    place, left = torch.tensor([[0.72, 0.72]]), torch.tensor([[0.4, 0.005]])
    config = FitSearchConfig()
    blind = choose_thresholds(config, torch.tensor([[1.0, 1.0]]), place, left, there)
    assert blind.confirm == 1
    sharp = choose_thresholds(config, torch.tensor([[1.0, 0.0]]), place, left, there)
    assert sharp.confirm == pytest.approx(0.5, abs=0.001)
    assert sharp.stop_below == 0.3
    assert sharp.place == pytest.approx(0.7, abs=0.001)


@pytest.mark.usefixtures("one_thread")
def test_training_is_repeatable_and_keeps_the_global_random_state(examples):
    config = FitSearchConfig(columns=4, rows=4, steps=12, batch=4, looks=3)
    torch.manual_seed(5)
    state = torch.random.get_rng_state()
    first = _train_evidence(config, examples, GRID, {"some": "metadata"}, len(CLASSES) + 1)
    assert torch.equal(torch.random.get_rng_state(), state)
    torch.manual_seed(6)
    second = _train_evidence(config, examples, GRID, {}, len(CLASSES) + 1)
    assert not first.training
    assert first.metadata == {"some": "metadata"}
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
        assert bool(value.isfinite().all()), name


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_more_training_lowers_the_evaluated_loss(examples):
    """More steps lower the cross entropy of cells on the training examples."""
    nll = []
    for steps in (1, 60):
        config = FitSearchConfig(columns=4, rows=4, steps=steps, batch=8, looks=4)
        model = _train_evidence(config, examples, GRID, {}, len(CLASSES) + 1)
        judged, thresholds = judge_evidence(config, model, examples, GRID)
        assert [row["looks"] for row in judged] == list(_JUDGED)
        assert 0.49 < thresholds.confirm <= 1
        assert 0 <= thresholds.stop_below <= 0.3
        for row in judged:
            assert all(math.isfinite(value) for value in row.values())
        nll.append(judged[-1]["cells_nll"])
        found = [row["found"] for row in judged]
        assert found == sorted(found)
    assert nll[1] < nll[0] - 0.1


def test_the_report_has_the_measures_and_the_thresholds():
    names = ("found", "cells_nll", "cells_ece", "visited_ece", "presence_area", "presence_ece")
    judged = [{"looks": looks, **{name: looks / 20 + n / 100 for n, name in enumerate(names)}} for looks in _JUDGED]
    report = _evidence_report(judged, Thresholds(0.7, 0.05, 0.4), 8, 3)
    assert "presence is at least 0.700 and that of a fixated cell at least 0.40" in report
    assert "no other cell has a probability of at least 0.05" in report
    rows = cells_of(report)[2:]
    assert rows == [
        [str(row["looks"]), f"{100 * row['found']:.1f}", *(f"{row[name]:.4f}" for name in names[1:])] for row in judged
    ]
