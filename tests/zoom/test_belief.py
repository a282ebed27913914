"""Belief and policy: sums against plain loops, no look twice, jointly chosen batches."""

import numpy as np
import pytest
import torch

from semfov.agents import ZoomAgent
from semfov.settings import FindSettings, SearchSettings
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.episode import look_for
from semfov.zoom.lattice import CELLS
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.policy import best_find, best_hit, jointly
from semfov.zoom.pooling import pool, pool_spans
from semfov.zoom.window_sums import WindowSums
from tests.zoom import plain
from train.zoom_slices import odds_of


@pytest.fixture
def source(detector, picture):
    eye = WindowEye(detector)
    return LiveWindowLooks(eye, eye.open(picture))


@pytest.fixture
def evidence():
    torch.manual_seed(3)
    return GlimpseEvidence(3, 8).eval().requires_grad_(False)


@pytest.fixture
def belief(source, evidence):
    known = ZoomBelief(source.lattice, evidence, 1)
    known.add(source.see([Window.on(source.lattice, (0, 0, 0))])[0])
    return known


def test_cached_window_sums_equal_recomputed_sums():
    generator = np.random.default_rng(0)
    for span, shape in ((3, (9, 14)), (8, (20, 8)), (16, (5, 40))):
        weight, cells = generator.random(span, np.float32), generator.random(shape, np.float32)
        kept = WindowSums(weight, shape, cells.__getitem__)
        for _ in range(6):
            padded = np.pad(cells, [(0, max(span - n, 0)) for n in shape])
            windows = np.lib.stride_tricks.sliding_window_view(padded, (span, span))
            expected = np.einsum("ijkl,k,l->ij", windows.astype(np.float64), weight, weight)
            np.testing.assert_allclose(kept.update(), expected, rtol=1e-5)
            row, column = int(generator.integers(shape[0])), int(generator.integers(shape[1]))
            cells[row : row + 2, column : column + 3] = generator.random()
            kept.changed = (column, row, min(column + 3, shape[1]), min(row + 2, shape[0]))


@pytest.mark.parametrize("size", [(4096, 200), (4096, 530), (300, 4096)])
def test_long_pictures_are_searched(detector, evidence, size):
    """At some levels windows are higher than the picture, and cells of coarse looks reach beyond the last cell."""
    image = torch.rand(3, size[1], size[0], generator=torch.Generator().manual_seed(0)) * 0.6
    agent = ZoomAgent(WindowEye(detector), evidence)
    path = agent.search(image, "red", SearchSettings(passes=10, confirm=1.0, stop_below=0.0))
    assert path.passes == 10
    assert path.lattice.levels > 4


def test_pooling_of_several_sizes_at_once_equals_pooling_of_each_window():
    """Also of windows that are longer than a side of the map."""
    scores = torch.rand(9, 20, 4, generator=torch.Generator().manual_seed(1)) ** 8
    scores[torch.rand(9, 20, generator=torch.Generator().manual_seed(2)) < 0.6] = 0
    spans = [16, 5, 8]
    for span, (top, summary) in zip(spans, pool_spans(scores, spans), strict=True):
        assert top.shape[:2] == summary.shape[:2] == (max(9 - span, 0) + 1, 20 - span + 1)
        for row in range(top.shape[0]):
            for column in range(top.shape[1]):
                one, one_summary = pool(scores, (column, row, column + span, row + span))
                torch.testing.assert_close(top[row, column], one)
                torch.testing.assert_close(summary[row, column], one_summary)


@pytest.mark.parametrize("seed", range(3))
def test_what_is_kept_equals_what_is_computed_from_all_looks(detector, evidence, seed):
    """After every look of an episode of looks of all levels in any order, with plans that were dropped in between."""
    generator = torch.Generator().manual_seed(seed)
    eye = WindowEye(detector)
    source = LiveWindowLooks(eye, eye.open(torch.rand(3, 300, 560, generator=generator) * 0.7))
    lattice, target = source.lattice, 1 + seed
    belief, seen = ZoomBelief(lattice, evidence, target), []
    actions = [[0, 0, 0], *lattice.actions[torch.randint(len(lattice), (7,), generator=generator)].tolist()]
    for step, action in enumerate(actions):
        seen += source.see([Window.on(lattice, tuple(action))])
        belief.add(seen[-1])
        jointly(lambda taken: best_find(belief, taken, 0.5), belief, set(), 1 + step % 3)
        jointly(lambda taken: best_hit(belief, taken), belief, set(), 1 + step % 2)
        left, closest = plain.left(lattice, seen), plain.closest(lattice, seen)
        expected = plain.expected(lattice, evidence, target, seen)
        np.testing.assert_array_equal(belief.unexplored, left)
        np.testing.assert_array_equal(belief.closest_level, closest)
        for level in range(1, lattice.levels):
            np.testing.assert_allclose(belief.expected(level), expected[level], rtol=1e-4, atol=1e-7)
            taper, ones = evidence.taper(lattice.span(level)).numpy(), np.ones(lattice.span(level))
            finds = plain.sums(lattice, expected[level], level, taper)
            np.testing.assert_allclose(belief.value(level, 0.0), finds, rtol=1e-3, atol=1e-6)
            if level + 1 < lattice.levels:
                finds += 0.5 * plain.sums(lattice, expected[level + 1] * (closest < level), level, ones)
            np.testing.assert_allclose(belief.value(level, 0.5), finds, rtol=1e-3, atol=1e-6)
            whole = min(lattice.span(level), lattice.rows) * min(lattice.span(level), lattice.columns)
            unseen = plain.sums(lattice, left * (closest < level), level, ones) / whole
            np.testing.assert_allclose(belief.unseen(level), unseen, atol=1e-6)
            odds = plain.odds(lattice, evidence, target, seen, level)
            np.testing.assert_allclose(belief._level_odds(level), odds, rtol=1e-3, atol=1e-4)
            np.testing.assert_allclose(belief.chances(level), unseen / (1 + np.exp(-odds)), atol=1e-4)
        most = np.max([expected[level] for level in range(1, lattice.levels)], 0)
        remaining = most[most >= 0.1].sum(), most[most < 0.1].sum()
        np.testing.assert_allclose(belief.remaining(), remaining, rtol=1e-3, atol=1e-4)


def test_changes_in_cells_without_hints_change_no_odds(belief):
    """They are not computed anew there, and elsewhere they are."""
    lattice, look = belief.lattice, belief.gists[0]
    finest = lattice.levels - 1
    before = {level: belief._level_odds(level).copy() for level in range(1, lattice.levels)}
    shown = look.scores.amax(-1) > 0
    empty = [
        (row, column)
        for row in range(lattice.rows - CELLS)
        for column in range(lattice.columns - CELLS)
        if not shown[
            row // look.scale : -(-(row + CELLS) // look.scale),
            column // look.scale : -(-(column + CELLS) // look.scale),
        ].any()
    ]
    row, column = empty[len(empty) // 2]
    belief.discount(Window.on(lattice, (finest, column, row)))
    assert all(np.array_equal(belief._level_odds(level), odds) for level, odds in before.items())
    row, column = (int(n) * look.scale for n in shown.nonzero()[0])
    belief.discount(Window.on(lattice, (finest, min(column, lattice.columns - CELLS), min(row, lattice.rows - CELLS))))
    assert not all(np.array_equal(belief._level_odds(level), odds) for level, odds in before.items())


def test_odds_of_one_window_equal_those_in_the_table_of_all_windows(belief):
    lattice = belief.lattice
    table = torch.from_numpy(belief._level_odds(lattice.levels - 1).copy())
    # The picture ends inside a cell of the overview, so only windows on whole cells are compared.
    for row, column in ((0, 0), (6, 8), (12, 4)):
        window = Window.on(lattice, (lattice.levels - 1, column, row))
        assert odds_of(belief, window) == pytest.approx(float(table[row, column]), abs=1e-4)


@pytest.mark.parametrize("target", [1, 2, 3])
def test_every_look_of_a_search_shows_a_place_closer_than_all_looks_before_it(source, evidence, target):
    lattice = source.lattice
    closest = np.full((lattice.rows, lattice.columns), -1)
    count = 0
    for step in look_for(source, evidence, target):
        window = step.look.window
        x1, y1, x2, y2 = window.cells
        shown = closest[y1:y2, x1:x2]
        assert (shown < window.level).any()
        shown[:] = np.maximum(shown, window.level)
        count += 1
    assert count > lattice.levels
    # Only when nothing is left to see does a search without thresholds end.
    assert (closest == lattice.levels - 1).all()


def test_no_window_is_chosen_twice(belief):
    done = set()
    for _ in range(20):
        window, _ = best_hit(belief, done, closest=True)
        assert window not in done
        done.add(window)


def test_batches_are_chosen_jointly(belief):
    left = belief.unexplored.clone()
    chosen = jointly(lambda taken: best_find(belief, taken), belief, set(), 4)
    assert len({window for window, _ in chosen}) == 4
    assert torch.equal(belief.unexplored, left)
    first, _ = best_find(belief, set())
    assert chosen[0][0] == first
    values = [value for _, value in chosen]
    assert values == sorted(values, reverse=True)


def test_rates_are_the_same_whenever_they_are_asked_for(source, evidence):
    """They are predicted at once for all looks since the last question."""
    asked, waiting = (ZoomBelief(source.lattice, evidence, 1) for _ in range(2))
    looks = [(0, 0, 0), (1, 0, 0), (source.lattice.levels - 1, 1, 1), (1, 1, 0)]
    levels = range(1, source.lattice.levels)
    for action in looks:
        (look,) = source.see([Window.on(source.lattice, action)])
        for belief in (asked, waiting):
            belief.add(look)
        for level in levels:
            asked.value(level, 0.0)
    for level in levels:
        np.testing.assert_array_equal(waiting.expected(level), asked.expected(level))
        np.testing.assert_allclose(waiting.value(level, 0.0), asked.value(level, 0.0), rtol=1e-6)


def test_a_search_for_one_object_predicts_no_rates(detector, picture, evidence, monkeypatch):
    def rates(*_):
        raise AssertionError("rates are predicted")

    monkeypatch.setattr(GlimpseEvidence, "rates", rates)
    agent = ZoomAgent(WindowEye(detector), evidence)
    assert agent.search(picture, "green", SearchSettings(passes=4, stop_below=0.0)).passes == 4
    with pytest.raises(AssertionError, match="rates are predicted"):
        agent.find_all(picture, "green", FindSettings(passes=4))
