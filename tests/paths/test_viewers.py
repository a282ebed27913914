"""First fixations of drawn viewers, against the closed form of a product of densities."""

import pytest
import torch

from semfov.gaze.saliency import FixationDensity
from semfov.paths.viewers import AreaVisits, drawn_starts

MEAN, SPREAD = (0.45, 0.55), (0.1, 0.08)  # shares of the sides
SIZE = (640, 480)
ROWS, COLUMNS = 39, 52


@pytest.fixture
def model():
    density = FixationDensity({"map": 1})
    density.start = torch.tensor([MEAN, SPREAD])
    return density


@pytest.mark.parametrize("slope", [(0.0, 0.0), (8.0, 0.0), (-5.0, 10.0)])
def test_first_fixations_are_where_middle_and_picture_agree(model, slope):
    """A normal density times exp(k u) is the normal density with its mean moved by k times the variance."""
    x = (torch.arange(COLUMNS) + 0.5) / COLUMNS
    y = (torch.arange(ROWS) + 0.5) / ROWS
    log_density = slope[0] * x + slope[1] * y[:, None] + 7.0  # up to a constant
    starts = drawn_starts(model, log_density, SIZE, 20_000, torch.Generator().manual_seed(0))
    shares = (starts + 0.5) / torch.tensor(SIZE)
    spread = torch.tensor(SPREAD)
    expected = torch.tensor(MEAN) + torch.tensor(slope) * spread.square()
    torch.testing.assert_close(shares.mean(0), expected, atol=0.003, rtol=0)
    torch.testing.assert_close(shares.std(0), spread, atol=0.004, rtol=0)


def test_a_place_that_nobody_looks_at_is_no_first_fixation_either(model):
    log_density = torch.zeros(ROWS, COLUMNS)
    log_density[:, COLUMNS // 2 :] = -50.0  # the right half
    starts = drawn_starts(model, log_density, SIZE, 500, torch.Generator().manual_seed(0))
    assert float(starts[:, 0].max()) < SIZE[0] / 2


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (9000, 3)])
def test_first_fixations_stay_in_pictures_of_any_size(model, size):
    starts = drawn_starts(model, torch.full((1, 1), -1e6), size, 1000, torch.Generator().manual_seed(0))
    assert bool((starts >= -0.5).all())
    assert bool((starts < torch.tensor(size) - 0.5).all())


def test_a_time_stands_beside_the_share_of_viewers_that_it_is_of():
    visits = AreaVisits(0.02, 1.841)
    assert repr({"logo": visits}) == "{'logo': AreaVisits: seen by 2 % of viewers, by these first after 1.8 s}"
    assert visits == (0.02, 1.841)
