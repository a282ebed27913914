"""Gaze habits against loops, and frequencies of drawn fixations against probabilities."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eval.human.habits.gaze_habits import GazeHabits, Habitual, standardised
from semfov import Detections, Grid, rollout
from semfov.belief.observers import Semantic
from semfov.episode import StoredLooks
from semfov.errors import InputError
from semfov.gaze import acquisition
from semfov.gaze.choice import drawn_by

GRID = Grid(4, 3, (80, 60))
EDGES, AGES = (0.1, 0.3, 0.6), (1.0, 3.0)


def make_habits(dtype=torch.float32, **changes):
    generator = torch.Generator().manual_seed(0)
    tables = {"place": 12, "step": 4, "back": 3}
    given = {name: torch.randn(size, generator=generator, dtype=torch.float64) for name, size in tables.items()}
    given |= {"pull": 0.8, "edges": EDGES, "ages": AGES, "columns": 4, **changes}
    return GazeHabits(**{k: v.to(dtype) if isinstance(v, torch.Tensor) else v for k, v in given.items()})


def make_state(batch=3, dtype=torch.float32):
    generator = torch.Generator().manual_seed(1)
    age = torch.randint(1, 8, (batch, 12), generator=generator).to(dtype)
    age[torch.rand(batch, 12, generator=generator) < 0.5] = torch.inf
    cell = torch.randint(12, (batch,), generator=generator)
    return torch.randn(batch, 12, generator=generator).to(dtype), cell, age.scatter(-1, cell[:, None], 0.0)


def test_logits_equal_the_loop():
    habits, (values, cell, age) = make_habits(), make_state()
    got = habits(values, cell, age, GRID)
    for episode in range(3):
        mean, deviation = float(values[episode].mean()), float(values[episode].std(unbiased=False))
        here = GRID.centres[cell[episode]]
        for x in range(12):
            length = math.dist(GRID.centres[x], here) / 80
            total = 0.8 * (float(values[episode, x]) - mean) / deviation + float(habits.place[x])
            total += float(habits.step[sum(length > edge for edge in EDGES)])
            ago = float(age[episode, x])
            if 0 < ago < math.inf:
                total += float(habits.back[0 if ago <= 1 else 1 if ago <= 3 else 2])
            assert float(got[episode, x]) == pytest.approx(total, abs=1e-5)


@given(st.integers(0, 1000), st.floats(0.01, 100), st.floats(-100, 100))
def test_standardised_values_do_not_depend_on_scale_and_offset(seed, scale, shift):
    values = torch.randn(2, 9, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    z = standardised(values)
    torch.testing.assert_close(standardised(scale * values + shift), z, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(z.mean(-1), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-12)
    torch.testing.assert_close(z.std(-1, unbiased=False), torch.ones(2, dtype=torch.float64))


@pytest.mark.parametrize("level", [0.0, 0.1, -3e7])
def test_equal_values_are_standardised_to_zero(level):
    assert torch.equal(standardised(torch.full((1, 7), level)), torch.zeros(1, 7))


def test_standardised_gradients():
    values = torch.randn(2, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(standardised, (values,))


def empty_looks():
    """Looks without any detection."""
    mask = torch.zeros(12, 1, dtype=torch.bool)
    return StoredLooks(Detections(torch.zeros(12, 1, 4), torch.zeros(12, 1, 3), mask), GRID)


def walk(choice, episodes, most, values=None):
    """Fixated cells of episodes that start at cell 5, `(episodes, most)`."""
    values = torch.linspace(0, 1, 12) if values is None else values
    start = torch.full((episodes,), 5)
    steps = rollout(empty_looks(), Semantic(3), acquisition.Static(values), start, choice, most=most)
    return torch.stack([step.cell for step in steps], 1)


def noise(seed=0):
    return drawn_by(torch.Generator().manual_seed(seed), 12, torch.zeros(()))


def test_second_fixations_follow_the_softmax_of_the_logits():
    habits, count = make_habits(), 20_000
    cells = walk(Habitual(noise(), habits, GRID), count, 2)
    age = torch.full((1, 12), torch.inf)
    age[0, 5] = 0
    share = habits(torch.linspace(0, 1, 12)[None], torch.tensor([5]), age, GRID).softmax(-1)[0]
    counts = torch.bincount(cells[:, 1], minlength=12)
    assert bool(((counts - count * share).abs() <= 5 * (count * share * (1 - share)).sqrt() + 1).all())


def test_returns_are_drawn_by_the_number_of_fixations_since():
    """With only the table of returns, a cell left two fixations ago has the probability given by that table."""
    back, count = torch.tensor([1.0, -1.0, 0.0]), 20_000
    flat = {"pull": 0.0, "place": torch.zeros(12), "step": torch.tensor([-30.0, 0.0, 0.0, 0.0]), "back": back}
    cells = walk(Habitual(noise(1), make_habits(**flat), GRID), count, 4)
    assert not bool((cells[:, 1:] == cells[:, :-1]).any())
    first, second = cells[:, 2] == cells[:, 0], (cells[:, 2] != cells[:, 0]) & (cells[:, 3] == cells[:, 0])
    expected = math.e / (math.e + 10)
    assert float(first.double().mean()) == pytest.approx(expected, abs=5 * (0.25 / count) ** 0.5)
    # Two cells were left by then: the last one, with weight e, and the start, with weight 1 / e.
    expected = (1 - expected) * math.exp(-1) / (math.e + math.exp(-1) + 9)
    assert float(second.double().mean()) == pytest.approx(expected, abs=5 * (0.05 / count) ** 0.5)


def test_the_same_seed_gives_the_same_scanpaths():
    once, again, other = (walk(Habitual(noise(seed), make_habits(), GRID), 6, 8) for seed in (0, 0, 1))
    assert torch.equal(once, again)
    assert not torch.equal(once, other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"columns": 5}, "columns"),
        ({"edges": (0.3, 0.1, 0.6)}, "edges"),
        ({"edges": (0.3,)}, "edges"),
        ({"ages": (0.5, 3.0)}, "ages"),
        ({"step": torch.full((4,), torch.nan)}, "step"),
    ],
)
def test_invalid_tables_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        make_habits(**changes)


def test_another_grid_is_refused():
    with pytest.raises(InputError, match="grid"):
        make_habits()(*make_state(), Grid(3, 4, (80, 60)))
