"""The lattice: cells, windows of all levels, actions."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.zoom.lattice import CELLS, Lattice

sizes = st.tuples(st.integers(200, 9000), st.integers(200, 9000))


@given(sizes)
def test_windows_tile_the_picture(size):
    lattice = Lattice.over(size, (416, 416))
    wide, high = lattice.pitch
    assert lattice.columns * wide >= size[0] - 0.1 > (lattice.columns - 1) * wide - 0.2
    assert lattice.rows * high >= size[1] - 0.1 > (lattice.rows - 1) * high - 0.2
    for level in range(lattice.levels):
        assert lattice.window(level)[0] == pytest.approx(lattice.span(level) * wide)
    assert lattice.span(lattice.levels - 1) == CELLS
    whole = lattice.boxes(torch.tensor([0, 0, 0]))
    assert whole[2] >= size[0] - 0.5
    assert whole[3] >= size[1] - 0.5


@given(sizes)
def test_a_single_fixation_equals_its_row_among_all(size):
    lattice = Lattice.over(size, (416, 320))
    some = lattice.actions[:: max(len(lattice) // 20, 1)]
    fixations = [lattice.fixation(*action) for action in some.tolist()]
    assert torch.equal(torch.tensor(fixations), lattice.fixations(some))


def test_actions_are_numbered_and_fixations_are_centres_of_boxes():
    lattice = Lattice.over((2560, 1920), (416, 416))
    assert len(lattice.actions) == len(lattice) == 579
    for number in (0, 1, 153, 154, 578):
        assert lattice.number(*lattice.actions[number].tolist()) == number
    lattice = Lattice.over((3840, 2160), (416, 416))
    boxes, fixations = lattice.boxes(lattice.actions), lattice.fixations(lattice.actions)
    torch.testing.assert_close((boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5, fixations[:, :2])
    torch.testing.assert_close(416 / (boxes[:, 2] - boxes[:, 0]), fixations[:, 2])
