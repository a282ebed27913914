"""The fit of searches: beliefs and thresholds against loops, the presence against SciPy, training, reports."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from semfov import EmbeddedScenes, FovealObservationModel, Grid
from semfov.belief.observers import SemanticSearch
from semfov.fit.logistic import logistic_regression
from semfov.fit.presence import BeliefsOfSearches, fit_presence, judge_presence
from semfov.fit.search import FitSearchConfig, fit_places, fit_search, search_photographs, shares_drawn
from semfov.fit.thresholds import choose_thresholds
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import ProtocolConfig
from semfov.runs.protocols import choose_classes, choose_searches, numbers_drawn
from tests.refusals import refused, unusable
from tests.small import cells_of, looking, rand

GRID = Grid(4, 4, (640, 480))
CELLS = 16
CLASSES = ("person", "dog", "boat", "truck", "zebra", "banana", "kite", "toaster")
CONFIG = FitSearchConfig(columns=4, rows=4, classes=2, absent=2, max_target_area=0.5, looks=5, steps=3)


@pytest.fixture(scope="module")
def run():
    """A stand-in for a run with stored looks at five embedded scenes."""
    stand_in = looking(CLASSES, GRID, 5)
    stand_in.eye = SimpleNamespace(settings=lambda: {"detector": {"name": "toy"}})
    stand_in.cells = (GRID.columns, GRID.rows)
    return stand_in


@pytest.fixture(scope="module")
def model():
    """An observation model of searches, in which classes are missed less often near the fovea."""
    odds = (torch.tensor([-3.0, -2.0, -1.0]) + rand(9, 3)).exp()
    return FovealObservationModel.identity(CLASSES, [0.2, 0.5], miss_odds=odds, refutation=0.7).requires_grad_(False)


def scores_of(seen, cell, target):
    """Scores of a class in the look from a cell."""
    return [float(seen.scores[cell, d, target]) for d in range(seen.scores.shape[1]) if seen.mask[cell, d]]


def searched_alone(model, run, index, drawn):
    """The facts of one search after each look, by loops over looks and cells."""
    observer, seen = SemanticSearch(model), run.detections(index)
    belief = observer.start(1, GRID, seen.scores)
    cell, visited, facts, highest = int(drawn.start), [], [], 0.0
    for look in range(CONFIG.looks):
        belief = observer(belief, seen[cell : cell + 1], GRID.centres[cell : cell + 1], GRID, drawn.target)
        visited.append(cell)
        cells = belief.probability(drawn.target)[0].tolist()
        chance = belief.chance(drawn.target)[0].tolist()
        fixated = max(cells[each] for each in visited)
        left = {each: chance[each] for each in range(CELLS) if each not in visited}
        highest = max([highest, *scores_of(seen, cell, drawn.target)])
        facts.append(
            (
                math.log(max(cells) / (1 - max(cells))),
                math.log(1 + highest / 3e-4),
                fixated,
                max(left.values()),
                bool(drawn.goal[cells.index(max(cells))]),
                bool(drawn.goal[max(left, key=left.__getitem__)]),
                any(bool(drawn.goal[each]) for each in visited),
            )
        )
        ties = [each for each, value in left.items() if value == max(left.values())]
        cell = max(ties, key=lambda each: float(drawn.noise[0, look, each]))
    return facts


def test_searches_side_by_side_equal_each_search_alone(run, model):
    found = search_photographs(model, run, CONFIG, [1, 3])
    protocol = ProtocolConfig(shifts=CONFIG.looks - 1, seed=CONFIG.seed)
    expected, about = [], []
    for index in (1, 3):
        for drawn in choose_searches(run.scenes, index, GRID, protocol, 2, 0.5, 2):
            expected.append(searched_alone(model, run, index, drawn))
            held = drawn.target in run.scenes.annotation(index).labels.tolist()
            about.append((held, index, drawn.target))
    assert len(found) == len(about) >= 6
    facts = [*found.facts, found.place, found.hit_chance, found.holds, found.hits, found.on_target]
    torch.testing.assert_close(
        torch.stack([each.float() for each in facts], -1), torch.tensor(expected).transpose(0, 1).float()
    )
    assert [*zip(found.there.tolist(), found.photograph.tolist(), found.target.tolist(), strict=True)] == about
    assert {held for held, *_ in about} == {True, False}
    assert found.place.count_nonzero() > 0
    assert found.on_target[-1].any()


def test_photographs_without_classes_to_search_for_are_refused(run, model):
    unusable("raise max_target_area", search_photographs, model, run, replace(CONFIG, absent=1), [])
    nothing = replace(CONFIG, max_target_area=1e-9)
    unusable("raise max_target_area", fit_search, model, nothing, run)


def beliefs(count=80, looks=13, seed=0):
    """What beliefs of searches may say; targets that are there have more probable cells, and higher scores."""
    generator = torch.Generator().manual_seed(seed)
    there = torch.rand(count, generator=generator) < 0.4
    facts = 2 * torch.randn(2, looks, count, generator=generator) - 2 + there * torch.tensor([2.5, 1.5])[:, None, None]
    target = torch.randint(1, 4, (count,), generator=generator)
    on_target = there & (torch.rand(looks, count, generator=generator) < 0.6).cummax(0).values
    peak = facts[0].sigmoid()
    holds, hits = there & (torch.rand(2, looks, count, generator=generator) < torch.tensor([0.7, 0.2])[:, None, None])
    photograph = torch.arange(count) // 4
    return BeliefsOfSearches(facts, 0.95 * peak, 0.3 * peak, holds, hits, on_target, there, photograph, target)


SHARES = torch.tensor([0.2, 0.5, 0.7])


@pytest.mark.parametrize("looks", [13, 4])
def test_the_presence_maximises_the_likelihood_given_the_shares_of_classes(looks):
    searches = beliefs(looks=looks)
    presence = fit_presence(searches, SHARES, FitSearchConfig())
    counted = [number - 1 for number in (1, 3, 5, 8, 12) if number <= looks]
    peak, score = searches.facts.double().numpy()
    share = SHARES[searches.target - 1].double().numpy()
    there = searches.there.numpy()

    def loss(numbers):
        odds = numbers[0] + numbers[1] * peak[counted] + numbers[2] * score[counted] + np.log(share / (1 - share))
        cost = np.logaddexp(0, np.where(there, -odds, odds)).sum() / len(counted)
        # Half a case for and against without any facts.
        cost += 0.5 * (np.logaddexp(0, numbers[0]) + np.logaddexp(0, -numbers[0]))
        return cost + 0.5 * (1e-6 * numbers[0] ** 2 + 1e-3 * (numbers[1:] ** 2).sum())

    best = minimize(loss, np.zeros(3), tol=1e-12).x
    assert [float(presence.offset), *presence.slopes.tolist()] == pytest.approx(list(best), abs=1e-3)
    assert torch.equal(presence.shares, SHARES)
    assert not any(parameter.requires_grad for parameter in presence.parameters())
    # Thresholds are those of targets that are there in half of the pictures.
    odds = torch.from_numpy(best[0] + best[1] * peak + best[2] * score)
    place, chance = (presence.of_cells(each, "box_centre") for each in (searches.place, searches.hit_chance))
    known = place >= 0.9 * presence.of_cells(searches.facts[0].sigmoid(), "box_centre")
    expected = choose_thresholds(FitSearchConfig(), odds.sigmoid(), place * known, chance, searches.there)
    assert presence.thresholds == expected


@pytest.mark.parametrize("looks", [13, 4])
def test_the_cells_that_decisions_read_are_made_true_given_the_shares_of_classes(looks):
    searches = beliefs(looks=looks)
    presence = fit_presence(searches, SHARES, FitSearchConfig())
    share = SHARES[searches.target - 1].double().logit().tolist()
    rows = []
    for look in (number - 1 for number in (1, 3, 5, 8, 12) if number <= looks):
        for search in range(len(searches)):
            peak, chance = float(searches.facts[0, look, search]), float(searches.hit_chance[look, search])
            rows.append((peak, searches.holds[look, search], share[search]))
            if not searches.on_target[look, search]:
                rows.append((math.log(chance / (1 - chance)), searches.hits[look, search], share[search]))
    odds, holds, known = np.array(rows, dtype=float).T
    count = sum(number <= looks for number in (1, 3, 5, 8, 12))

    def loss(numbers):
        log_odds = numbers[0] + numbers[1] * odds + known
        cost = np.logaddexp(0, np.where(holds > 0, -log_odds, log_odds)).sum() / count
        cost += 0.5 * (np.logaddexp(0, numbers[0]) + np.logaddexp(0, -numbers[0]))
        return cost + 0.5 * (1e-6 * numbers[0] ** 2 + 1e-3 * numbers[1] ** 2)

    best = minimize(loss, np.zeros(2), tol=1e-12).x
    assert presence.centre.tolist() == pytest.approx(list(best), abs=1e-3)


def test_a_surer_cell_stays_the_more_probable_one_whatever_few_searches_say():
    """Where surer cells hold the target more rarely, the slope is the least one, and the offset its best."""
    searches = beliefs(looks=1)
    surer = searches.facts[0] > searches.facts[0].median()
    searches = replace(searches, holds=~surer & searches.there, hits=~surer & searches.there)
    presence = fit_presence(searches, SHARES, FitSearchConfig())
    share = SHARES[searches.target - 1].double().logit().numpy()
    peak, chance = searches.facts[0, 0].double().numpy(), searches.hit_chance[0].double().logit().numpy()
    goes_on = ~searches.on_target[0].numpy()

    def loss(offset, slope):
        costs = [
            np.logaddexp(0, np.where(answers, -1, 1) * (offset + slope * odds + share))
            for odds, answers in ((peak, searches.holds[0].numpy()), (chance, searches.hits[0].numpy()))
        ]
        cost = costs[0].sum() + costs[1][goes_on].sum()
        return cost + 0.5 * (np.logaddexp(0, offset) + np.logaddexp(0, -offset)) + 0.5e-6 * offset**2

    free = minimize(lambda numbers: loss(*numbers) + 0.5e-3 * numbers[1] ** 2, np.zeros(2), tol=1e-12).x
    assert free[1] < 0
    best = minimize(lambda numbers: loss(numbers[0], 0.1), np.zeros(1), tol=1e-12).x
    assert presence.centre.tolist() == pytest.approx([best[0], 0.1], abs=1e-3)


@pytest.mark.parametrize("held", [True, False])
def test_a_presence_needs_searches_with_and_without_their_target(held):
    searches = beliefs()
    unusable("only one kind", fit_presence, searches[searches.there == held], SHARES, FitSearchConfig())


def test_a_presence_is_measured_as_by_loops():
    searches = beliefs(seed=3)
    presence = Presence(torch.tensor(0.4), torch.tensor([0.8, 0.3]), SHARES).requires_grad_(False)
    rows = judge_presence(presence, searches)
    assert [row["looks"] for row in rows] == [1, 3, 5, 8, 12]
    for row in rows:
        look = row["looks"] - 1
        chances, costs = [], []
        for (peak, score), target, there in zip(
            searches.facts[:, look].mT.tolist(), searches.target.tolist(), searches.there.tolist(), strict=True
        ):
            share = float(SHARES[target - 1])
            odds = math.exp(0.4 + 0.8 * peak + 0.3 * score) * share / (1 - share)
            chances.append((odds / (1 + odds), there))
            costs.append(-math.log(odds / (1 + odds) if there else 1 / (1 + odds)))
        present = [chance for chance, there in chances if there]
        absent = [chance for chance, there in chances if not there]
        wins = [(one > other) + (one == other) / 2 for one in present for other in absent]
        assert row["area"] == pytest.approx(sum(wins) / len(wins), abs=1e-4)
        assert row["nll"] == pytest.approx(sum(costs) / len(costs), rel=1e-4)
        hits = searches.on_target[look][searches.there].tolist()
        assert row["found"] == pytest.approx(sum(hits) / len(hits))
        assert 0 <= row["ece"] <= 1


def test_without_steps_the_odds_of_a_miss_stay(run, model):
    fitted = fit_search(model, replace(CONFIG, steps=0), run).model
    kept = model.state_dict()
    assert all(torch.equal(value, kept[name]) for name, value in fitted.state_dict().items() if name in kept)
    assert fitted.presence.thresholds is not None
    assert model.presence is None
    without = FovealObservationModel.identity(CLASSES, [0.2, 0.5])
    refused("steps is 0, such as .*, got one without", fit_search, without, replace(CONFIG, steps=0), run)


def test_the_shares_of_a_fit_add_half_a_search_for_and_against():
    scenes = EmbeddedScenes(CLASSES, count=4)
    there, missing = numbers_drawn(scenes, 2, 0.5, 2)
    expected = [(a + 0.5) / (a + b + 1) for a, b in zip(there.tolist(), missing.tolist(), strict=True)]
    assert shares_drawn(scenes, CONFIG, CONFIG.absent).tolist() == pytest.approx(expected)


def test_as_many_absent_as_present_classes_are_chosen(run):
    for index in range(len(run.scenes)):
        labels = set(run.scenes.annotation(index).labels.tolist())
        annotation = run.scenes.annotation(index)
        chosen = choose_classes(run.scenes, index, annotation, 2, 0.5, 0)
        there = [target for target in chosen if target in labels]
        assert len(chosen) == len(set(chosen)) == 2 * len(there)
        assert 1 <= len(there) <= 2
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
def test_the_fit_is_repeatable_and_keeps_the_global_random_state(run, model):
    state = torch.random.get_rng_state()
    kept = {name: value.clone() for name, value in model.state_dict().items()}
    first, second = (fit_search(model, CONFIG, run) for _ in range(2))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(value, kept[name]) for name, value in model.state_dict().items())
    for name, value in first.model.state_dict().items():
        assert torch.equal(value, second.model.state_dict()[name]), name
        assert bool(value.isfinite().all()), name
    assert not torch.equal(first.model.log_miss, model.log_miss)
    assert torch.equal(first.model.log_alpha, model.log_alpha)
    held_out = sum(index % 5 == 0 for index in range(5))
    assert first.model.metadata["search"] == {"looks": 5, "steps": 3, "photographs": 5 - held_out}
    assert first.model.metadata["detector"] == {"name": "toy"}
    assert first.model.metadata["training"]["absent"] == 2
    assert first.trained + first.held_out == len(search_photographs(model, run, CONFIG, range(5)))


def test_a_fitted_model_is_read_as_it_was_saved(run, model, tmp_path):
    fitted = fit_search(model, CONFIG, run).model
    fitted.save(tmp_path / "search.safetensors")
    read = FovealObservationModel.from_pretrained(tmp_path / "search.safetensors")
    assert {name: value.tolist() for name, value in read.state_dict().items()} == {
        name: value.tolist() for name, value in fitted.state_dict().items()
    }
    assert read.presence.thresholds == fitted.presence.thresholds
    assert read.metadata == fitted.metadata


def test_the_report_has_the_measures_and_the_thresholds(run, model):
    fitted = fit_search(model, CONFIG, run)
    presence = fitted.model.presence
    thresholds = presence.thresholds
    said = f"presence is at least {thresholds.confirm:.3f} and that of a fixated cell at least {thresholds.place:.2f}"
    assert said in fitted.report
    assert f"no other cell has a probability of at least {thresholds.stop_below:.3f}" in fitted.report
    cell, score = presence.slopes.tolist()
    said = f"logit P = {float(presence.offset):.2f} + {cell:.2f} logit of the most probable cell + {score:.2f} ln(1 + s"
    assert said in fitted.report
    names = ("area", "ece", "nll")
    assert cells_of(fitted.report)[2:] == [
        [str(row["looks"]), f"{100 * row['found']:.1f}", *(f"{row[name]:.3f}" for name in names)]
        for row in fitted.judged
    ]


def test_a_surer_cell_never_speaks_against_the_class():
    """Where few searches say so by chance, the weight is 0, and the other numbers are those without that fact."""
    searches = beliefs()
    misleading = replace(searches, facts=searches.facts * torch.tensor([-1.0, 1.0])[:, None, None])
    presence = fit_presence(misleading, SHARES, FitSearchConfig())
    alone = fit_presence(
        replace(searches, facts=searches.facts * torch.tensor([0.0, 1.0])[:, None, None]), SHARES, FitSearchConfig()
    )
    assert presence.slopes[0] == 0
    assert presence.slopes[1] > 0
    assert presence.slopes[1].item() == pytest.approx(alone.slopes[1].item(), abs=1e-4)
    assert presence.offset.item() == pytest.approx(alone.offset.item(), abs=1e-4)


def test_the_probabilities_of_cells_are_fitted_to_what_the_cells_hold(run, model, monkeypatch):
    """On all cells after the looks that count, of as many absent classes as present ones."""
    given = []

    def remembered(facts, right, **options):
        given.append((facts, right))
        return logistic_regression(facts, right, **options)

    monkeypatch.setattr("semfov.fit.search.logistic_regression", remembered)
    presence = Presence(torch.tensor(0.4), torch.tensor([0.8, 0.3]), SHARES, place=fit_places(model, run, CONFIG))
    ((facts, right),) = given
    # A fit with a free offset has the mean of its answers.
    mean = presence.of_cells(facts[:, 0].sigmoid(), "overlap").mean().detach()
    assert float(mean) == pytest.approx(float(right.double().mean()), abs=2e-3)
    observer, cells = SemanticSearch(model, footprint="overlap"), len(run.grid(0))
    assert len(facts) % cells == 0
    grid, looks = run.grid(0), run.detections(0)
    drawn = choose_searches(
        run.scenes,
        0,
        grid,
        ProtocolConfig(shifts=CONFIG.looks - 1, seed=CONFIG.seed),
        CONFIG.classes,
        CONFIG.max_target_area,
        CONFIG.classes,
    )
    start = int(drawn[0].start)
    belief = observer(observer.start(1, grid, facts.float()), looks[start : start + 1], grid.centres[[start]], grid)
    first = belief.probability(drawn[0].target)[0].double().clamp(1e-6, 1 - 1e-6).logit()
    torch.testing.assert_close(facts[:cells, 0], first, atol=1e-4, rtol=1e-4)
    assert torch.equal(right[:cells], drawn[0].goal)
