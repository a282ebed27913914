"""Belief and policy: sums against plain loops, no look twice, jointly chosen batches."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from semfov.agents import ZoomAgent
from semfov.settings import FindSettings, SearchSettings
from semfov.zoom import GlimpseEvidence, Lattice, WindowEye
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.episode import look_for
from semfov.zoom.hints import Gist
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook
from semfov.zoom.policy import best_find, jointly
from semfov.zoom.window_sums import WindowSums
from tests.refusals import refused
from tests.zoom import plain
from tests.zoom.memory import MemoryPeak


@pytest.fixture
def source(detector, picture):
    eye = WindowEye(detector)
    return LiveWindowLooks(eye, eye.open(picture))


@pytest.fixture
def evidence():
    torch.manual_seed(3)
    return GlimpseEvidence(3).eval().requires_grad_(False)


@pytest.fixture
def belief(source, evidence):
    known = ZoomBelief(source.lattice, evidence, 1)
    known.add(source.see([Window.on(source.lattice, (0, 0, 0))])[0])
    return known


def test_cached_window_sums_equal_recomputed_sums():
    generator = np.random.default_rng(0)
    for span, shape in ((3, (9, 14)), (8, (20, 8)), (16, (5, 40))):
        weight, cells = generator.random(span, np.float32), generator.random(shape, np.float32)
        kept = WindowSums(torch.from_numpy(weight), shape, lambda slices, cells=cells: torch.from_numpy(cells[slices]))
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
        most = np.max([expected[level] for level in range(1, lattice.levels)], 0)
        remaining = most[most >= 0.1].sum(), most[most < 0.1].sum()
        np.testing.assert_allclose(belief.remaining(), remaining, rtol=1e-3, atol=1e-4)


def test_a_belief_that_is_made_anew_predicts_changed_looks_alone(source, evidence, monkeypatch):
    """It equals a new belief of the same looks, also where the first of them, on which others rest, is another one."""
    lattice = source.lattice
    looks = source.see([Window.on(lattice, action) for action in ((0, 0, 0), (1, 0, 0), (1, 3, 2))])
    gist = looks[0].gist
    changed = replace(looks[0], gist=replace(gist, scores=gist.scores.roll(2, 1)))
    predicted = []
    rates = evidence.rates
    monkeypatch.setattr(evidence, "rates", lambda look, *more: predicted.append(look) or rates(look, *more))

    def values(belief: ZoomBelief, seen: Sequence[WindowLook]) -> list[np.ndarray]:
        belief.clear()
        predicted.clear()
        for look in seen:
            belief.add(look)
        return [belief.value(level, 0.5).numpy().copy() for level in range(1, lattice.levels)]

    belief = ZoomBelief(lattice, evidence, 1)
    for seen, count in ((looks, 3), (looks, 0), (looks[:2], 0), (looks, 1), ([changed, *looks[1:]], 3)):
        found = values(belief, seen)
        assert len(predicted) == count
        np.testing.assert_equal(found, values(ZoomBelief(lattice, evidence, 1), seen))


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
        window, _ = best_find(belief, done)
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


def some_looks(source, convert):
    """Looks at some windows, with converted tensors, and at last one that points to no closer ones."""
    looks = source.see([Window.on(source.lattice, action) for action in ((0, 0, 0), (1, 0, 0), (1, 3, 2))])
    converted = []
    for look in looks:
        gist = look.gist
        scores, size, found = (convert(tensor) for tensor in (gist.scores, gist.size, gist.found))
        converted.append(replace(look, gist=replace(gist, scores=scores, size=size, found=found)))
    last = Window.on(source.lattice, (source.lattice.levels - 1, 1, 1))
    return [*converted, *source.see([last])]


def test_gradients_of_values_reach_the_network_and_the_border(source):
    """The slope along a random direction is that of finite differences, although later looks write to the belief."""
    torch.manual_seed(3)
    evidence = GlimpseEvidence(3).double().eval()
    lattice = source.lattice
    looks = some_looks(source, lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)

    def summed() -> torch.Tensor:
        belief = ZoomBelief(lattice, evidence, 1)
        found = []
        for look in looks:
            belief.add(look)
            found += [belief.value(level, 0.5).square().sum() for level in range(1, lattice.levels)]
        return torch.stack(found).sum()

    parameters = [*evidence.rate.parameters(), evidence.border]
    directions = [torch.randn_like(parameter) for parameter in parameters]
    gradients = torch.autograd.grad(summed(), parameters)
    assert all(gradient.any() for gradient in gradients)
    slope = sum((gradient * direction).sum() for gradient, direction in zip(gradients, directions, strict=True))
    sides = []
    with torch.no_grad():
        for shift in (1e-5, -2e-5):
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter.add_(direction, alpha=shift)
            sides.append(summed())
    torch.testing.assert_close(slope, (sides[0] - sides[1]) / 2e-5, rtol=1e-5, atol=0)


def gradients_of_a_value(belief, looks, *, with_policy):
    """Gradients of the last value of a belief in the network, after looks between which a policy may ask."""
    values = torch.zeros(())
    for look in looks:
        belief.add(look)
        if with_policy:
            with torch.no_grad():
                best_find(belief, set(), 0.5)
                belief.remaining()
        else:
            belief.value(1, 0.5)
        values = belief.value(1, 0.5).sum()
    return torch.autograd.grad(values, [*belief.evidence.rate.parameters()])


@pytest.mark.parametrize("learns_border", [True, False])
def test_what_a_policy_asks_for_in_between_changes_no_gradient(source, learns_border):
    torch.manual_seed(3)
    evidence = GlimpseEvidence(3).eval()
    evidence.border.requires_grad_(learns_border)
    looks = some_looks(source, torch.clone)
    belief = ZoomBelief(source.lattice, evidence, 1)
    plain = gradients_of_a_value(belief, looks, with_policy=False)
    assert any(gradient.any() for gradient in plain)
    belief.clear()  # and the graph of one backward pass is not used for the next one
    for anew in (belief, ZoomBelief(source.lattice, evidence, 1)):
        again = gradients_of_a_value(anew, looks, with_policy=True)
        for gradient, expected in zip(again, plain, strict=True):
            torch.testing.assert_close(gradient, expected)


def test_values_are_exact_under_automatic_mixed_precision(source, evidence):
    belief, mixed = (ZoomBelief(source.lattice, evidence, 1) for _ in range(2))
    for look in some_looks(source, torch.clone):
        belief.add(look)
        mixed.add(look)
        belief.expected(1)
        mixed.expected(1)
        with torch.autocast("cpu", torch.bfloat16):
            value = mixed.value(1, 0.5)
        assert torch.equal(value, belief.value(1, 0.5))


def test_a_belief_is_on_the_device_of_its_looks(source, evidence, device):
    lattice = source.lattice
    plain_belief = ZoomBelief(lattice, evidence, 1)
    belief = ZoomBelief(lattice, copy.deepcopy(evidence).to(device), 1, device=device)
    looks = some_looks(source, lambda tensor: tensor.to(device))
    for look, plain_look in zip(looks, some_looks(source, torch.clone), strict=True):
        belief.add(look)
        plain_belief.add(plain_look)
        for level in range(1, lattice.levels):
            value = belief.value(level, 0.5)
            assert value.device.type == device.type
            torch.testing.assert_close(value.cpu(), plain_belief.value(level, 0.5), rtol=1e-3, atol=1e-5)
        assert belief.remaining() == pytest.approx(plain_belief.remaining(), rel=1e-3, abs=1e-4)
    chosen = jointly(lambda taken: best_find(belief, taken, 0.5), belief, set(), 3)
    expected = jointly(lambda taken: best_find(plain_belief, taken, 0.5), plain_belief, set(), 3)
    assert [window for window, _ in chosen] == [window for window, _ in expected]


@pytest.mark.parametrize("learns", [False, True])
def test_a_belief_that_began_in_inference_mode_goes_on_outside(source, evidence, learns):
    lattice = source.lattice
    evidence = copy.deepcopy(evidence).requires_grad_(learns)
    first, *others = some_looks(source, torch.clone)
    with torch.inference_mode():
        belief = ZoomBelief(lattice, evidence, 1)
        belief.add(first)
        belief.value(1, 0.5)
    anew = ZoomBelief(lattice, evidence, 1)
    anew.add(first)
    for look in others:
        belief.add(look)
        anew.add(look)
        for level in range(1, lattice.levels):
            assert torch.equal(belief.value(level, 0.5), anew.value(level, 0.5))


def test_a_search_looks_where_most_objects_are_expected(detector, picture, evidence):
    """At the windows that finding all objects of the class looks at, whose values are expected numbers of objects."""
    agent = ZoomAgent(WindowEye(detector), evidence)
    search = agent.search(picture, "green", SearchSettings(passes=6, confirm=1.0, stop_below=0.0))
    finding = agent.find_all(picture, "green", FindSettings(passes=6, min_gain=0.0))
    assert [look.window for look in search.window_looks] == [look.window for look in finding.window_looks]
    expected = np.array([look.value for look in finding.looks[1:]])
    np.testing.assert_allclose([look.value for look in search.looks[1:]], 1 - np.exp(-expected), rtol=1e-6)


@pytest.mark.parametrize("size", [(16_000_000, 1), (1, 16_000_000), (20_000_000, 1000), (20_000_000, 20_000_000)])
def test_a_picture_with_too_many_cells_in_all_or_along_a_side_is_refused(size):
    words = "picture: expected at most .* cells of a belief, 16,384 along a side, .*; divide the picture, or reduce it$"
    refused(words, Lattice.over, size, (416, 416))


@pytest.mark.parametrize("size", [(52 << 14, 1), (1, 52 << 14), (3, 50_000), (900, 700)])
def test_strips_are_valued_in_half_a_gigabyte(size):
    lattice = Lattice.over(size, (416, 416))
    evidence = GlimpseEvidence(3).eval().requires_grad_(False)
    with MemoryPeak() as peak:
        belief = ZoomBelief(lattice, evidence, 1)
        belief.add(overview_look(lattice))
        assert best_find(belief, set(), belief.foresight) is not None
    assert peak.bytes < 2**29


def overview_look(lattice):
    """A look at the whole picture, in whose every cell there may be something."""
    scale = max(1, lattice.span(0) // 32)
    rows, columns = -(-lattice.rows // scale), -(-lattice.columns // scale)
    scores = torch.full((rows, columns, 3), 0.5)
    gist = Gist(0, (0, 0), scale, scores, torch.ones(rows, columns), scores > 1)
    return SimpleNamespace(gist=gist)
