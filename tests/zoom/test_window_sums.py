"""Sums over windows: those of one product for short sides, of blocks for long ones."""

import numpy as np
import pytest
import torch
from torch import Tensor

from semfov.zoom import window_sums
from semfov.zoom.window_sums import WindowSums
from tests.zoom.memory import MemoryPeak


def plain(cells, weight):
    """The definition, with what lies beyond the picture as 0."""
    span = len(weight)
    rows, columns = cells.shape
    padded = np.pad(cells.astype(np.float64), ((0, max(span - rows, 0)), (0, max(span - columns, 0))))
    windows = np.lib.stride_tricks.sliding_window_view(padded, (span, span))
    return np.einsum("abij,i,j->ab", windows, weight, weight)


@pytest.mark.parametrize("shape", [(1, 50), (50, 1), (3, 40), (17, 23), (8, 8), (40, 5)])
@pytest.mark.parametrize("span", [1, 4, 8])
@pytest.mark.parametrize("block", [1, 5, 1024])
def test_sums_of_blocks_are_those_of_the_definition(monkeypatch, shape, span, block):
    monkeypatch.setattr(window_sums, "_BLOCK", block)
    rng = np.random.default_rng(0)
    cells = rng.random(shape, np.float32)
    weight = rng.random(span, np.float32)
    sums = WindowSums(torch.from_numpy(weight), shape, lambda slices: torch.from_numpy(cells[slices]))
    np.testing.assert_allclose(sums.update(), plain(cells, weight), rtol=1e-5)
    x, y = shape[1] // 2, shape[0] // 2
    cells[y, x:] += 1
    sums.mark((x, y, shape[1], y + 1))
    np.testing.assert_allclose(sums.update(), plain(cells, weight), rtol=1e-5)


def test_a_long_strip_takes_memory_in_proportion_to_its_cells():
    shape = 8, 200_000
    cells = torch.ones(shape)
    sums = WindowSums(torch.ones(8), shape, lambda slices: cells[slices])
    with MemoryPeak() as peak:
        found = sums.update()
    assert peak.bytes < 16 * cells.nbytes
    assert (found == 64).all()


def test_empty_cells_take_no_memory_and_sums_that_become_empty_are_0():
    cells = torch.zeros(900, 900)
    with MemoryPeak() as peak:
        sums = WindowSums(torch.ones(400), (900, 900), lambda slices: cells[slices] if cells.any() else None)
        assert not sums.update().any()
    assert peak.bytes < 501**2 * 4
    cells[450, 450] = 1
    sums.mark((450, 450, 451, 451))
    assert sums.update().sum() == 400**2
    cells[450, 450] = 0
    sums.mark((450, 450, 451, 451))
    assert not sums.update().any()


def test_sums_are_differentiable_in_cells_and_weights():
    generator = torch.Generator().manual_seed(0)
    inputs = [
        torch.rand(shape, dtype=torch.float64, generator=generator, requires_grad=True)
        for shape in ((6, 7), (4, 3), (3,))
    ]

    def summed(cells: Tensor, changed: Tensor, weight: Tensor) -> Tensor:
        present = [cells]
        sums = WindowSums(weight, (6, 7), lambda slices: present[-1][slices])
        sums.update()
        present.append(torch.cat([torch.cat([changed, cells[:4, 3:]], 1), cells[4:]]))
        sums.mark((0, 0, 3, 4))
        return sums.update()

    assert torch.autograd.gradcheck(summed, inputs)
