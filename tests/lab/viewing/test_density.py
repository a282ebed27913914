"""Densities of the next fixation, against loops, closed forms and known weights."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize

from eval.human.viewing.density import (
    Habits,
    blurred,
    enlarged,
    events_of,
    fit_density,
    log_densities,
    standardised_maps,
    values_in_bins,
)
from eval.human.viewing.rows import people_maps
from semfov import Grid
from semfov.data.fixations import Fixations
from semfov.errors import InputError


def person(points, subject="1"):
    return Fixations("a.jpg", subject, np.array(points, dtype=np.float64), (80, 60))


PEOPLE = [person([[40, 30], [5, 5], [79, 59]]), person([[40, 30], [41, 31], [5, 5], [-3, 70]], "2")]


def test_fit_recovers_the_weights_that_generated_the_fixations():
    generator = torch.Generator().manual_seed(0)
    terms = [torch.randn(4000, 6, 8, generator=generator) for _ in range(2)]
    truth = torch.tensor([0.8, -0.5])
    density = log_densities(terms, truth)
    drawn = density.flatten(1).exp().multinomial(1, generator=generator)[:, 0]
    bins = torch.stack([drawn % 8, drawn // 8], -1)
    found = fit_density(["a", "b"], terms, bins)
    torch.testing.assert_close(found.values, truth, atol=0.06, rtol=0)
    assert found.bits > 0
    # The same optimum as scipy's, which is found without a gradient.
    flat = [term[:500].double().flatten(1).numpy() for term in terms]

    def cost(weights):
        score = sum(w * f for w, f in zip(weights, flat, strict=True))
        return float(np.mean(np.log(np.exp(score).sum(1)) - score[np.arange(500), drawn[:500].numpy()]))

    small = fit_density(["a", "b"], [term[:500] for term in terms], bins[:500])
    np.testing.assert_allclose(small.values, minimize(cost, [0, 0]).x, atol=2e-3)
    assert small.bits == pytest.approx((math.log(48) - cost(small.values.tolist())) / math.log(2), abs=1e-4)


def test_densities_sum_to_one_and_terms_are_broadcast():
    terms = [torch.rand(1, 5, 4), torch.rand(3, 5, 4)]
    density = log_densities(terms, torch.tensor([2.0, -1.0]))
    torch.testing.assert_close(density.exp().sum((1, 2)), torch.ones(3))
    assert values_in_bins(density, torch.tensor([[3, 4], [0, 0], [1, 2]]))[0] == density[0, 4, 3]
    with pytest.raises(InputError, match=r"^terms:"):
        fit_density([], [], torch.zeros(1, 2).long())


def test_standardised_maps_have_mean_zero_and_deviation_one_or_are_zero_if_uniform():
    maps = torch.rand(3, 5, 4) * 7 + 3
    maps[1] = 0.1
    found = standardised_maps(maps)
    torch.testing.assert_close(found.mean((1, 2)), torch.zeros(3), atol=1e-5, rtol=0)
    torch.testing.assert_close(found[[0, 2]].std((1, 2), correction=0), torch.ones(2))
    assert found[1].eq(0).all()


def test_every_fixation_after_the_first_is_an_event():
    raster, grid = Grid(8, 6, (80, 60)), Grid(2, 2, (80, 60))
    events = events_of(PEOPLE, raster, grid, longest=20)
    assert events.bins.tolist() == [[0, 0], [7, 5], [4, 3], [0, 0], [0, 5]]
    assert events.before.tolist() == [[4, 3], [0, 0], [4, 3], [4, 3], [0, 0]]
    assert events.number.tolist() == [0, 1, 0, 1, 2]
    assert events.person.tolist() == [0, 0, 1, 1, 1]
    assert events.visited.tolist() == [
        [0, 0, 0, 1], [1, 0, 0, 1], [0, 0, 0, 1], [0, 0, 0, 1], [1, 0, 0, 1],
    ]  # fmt: skip
    assert [cells.tolist() for cells in events.cells] == [[3, 0, 3], [3, 3, 0, 2]]
    assert [cells.tolist() for cells in events.fine] == [[28, 0, 47], [28, 28, 0, 40]]
    assert len(events_of(PEOPLE, raster, grid, longest=2)) == 2


def test_habits_are_logarithms_of_blurred_counts():
    raster, grid = Grid(8, 6, (80, 60)), Grid(2, 2, (80, 60))
    events = events_of(PEOPLE, raster, grid, longest=20)
    habits = Habits.of([events], 8, 6, blur=0.7, floor=0.05)
    centre, jump = np.zeros((6, 8)), np.zeros((11, 15))
    for (x, y), (a, b) in zip(events.bins.tolist(), events.before.tolist(), strict=True):
        centre[y, x] += 1
        jump[y - b + 5, x - a + 7] += 1
    for counts, sigma, found in ((centre, 1.4, habits.centre), (jump, 0.7, habits.jump)):
        smooth = gaussian_filter(counts, sigma, mode="mirror", truncate=int(3 * sigma + 0.5) / sigma) + 0.05
        np.testing.assert_allclose(found, np.log(smooth / smooth.sum()), atol=1e-4)
    near = habits.near(events.before)
    for number, (a, b) in enumerate(events.before.tolist()):
        for y in range(6):
            for x in range(8):
                assert near[number, y, x] == habits.jump[y - b + 5, x - a + 7]


def test_blurring_keeps_the_sum_and_zero_width_keeps_the_map():
    maps = torch.rand(2, 9, 12)
    assert blurred(maps, 0.0) is maps
    inner = torch.zeros(1, 21, 21)
    inner[0, 10, 10] = 1
    assert blurred(inner, 1.0).sum() == pytest.approx(1)


def test_cell_values_are_interpolated_between_cell_centres():
    grid = Grid(2, 2, (80, 60))
    values = torch.tensor([[0.0, 1.0, 2.0, 3.0]])
    maps = enlarged(values, grid, 6, 8)
    assert maps.shape == (1, 6, 8)
    assert maps[0, 0, 0] == 0
    assert maps[0, -1, -1] == pytest.approx(3)
    assert maps[0, 2:4, 3:5].mean() == pytest.approx(1.5)
    assert enlarged(values, grid, 2, 2).tolist() == [[[0, 1], [2, 3]]]


def test_maps_of_other_people_exclude_the_same_person():
    events = events_of(PEOPLE, Grid(8, 6, (80, 60)), Grid(2, 2, (80, 60)), longest=20)
    maps = people_maps(events, 6, 8)
    for number, who in enumerate(events.person.tolist()):
        expected = torch.zeros(6, 8)
        for (x, y), other in zip(events.bins.tolist(), events.person.tolist(), strict=True):
            expected[y, x] += other != who
        assert torch.equal(maps[number], expected)
