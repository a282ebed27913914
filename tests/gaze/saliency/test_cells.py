"""Cells of a saliency map against a brute force on repeated pixels."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import Grid
from semfov.gaze.saliency import cell_saliency
from tests.refusals import refused


@given(st.integers(1, 23), st.integers(1, 23), st.integers(1, 8), st.integers(1, 8))
def test_mean_and_max_equal_a_brute_force(height: int, width: int, columns: int, rows: int) -> None:
    saliency = np.random.default_rng(height + 100 * width).random((2, height, width))
    # Split every pixel into rows x columns pieces: then every cell consists of height x width whole pieces.
    pieces = saliency.repeat(rows, 1).repeat(columns, 2)
    cells = pieces.reshape(2, rows, height, columns, width).transpose(0, 1, 3, 2, 4).reshape(2, rows * columns, -1)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
        tensor = torch.from_numpy(saliency).to(dtype)
        mean, largest = cell_saliency(tensor, columns, rows), cell_saliency(tensor, columns, rows, "max")
        np.testing.assert_allclose(mean.numpy(), cells.mean(-1), atol=tolerance)
        np.testing.assert_allclose(largest.numpy(), cells.max(-1), atol=tolerance)


def test_gradients_and_compilation() -> None:
    saliency = torch.rand(2, 5, 7, dtype=torch.float64, requires_grad=True)
    for reduction in ("mean", "max"):
        assert torch.autograd.gradcheck(lambda x, how=reduction: cell_saliency(x, 3, 2, how), saliency)
        compiled = torch.compile(cell_saliency, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(saliency, 3, 2, reduction), cell_saliency(saliency, 3, 2, reduction))


def test_bad_input():
    refused("saliency", cell_saliency, torch.zeros((4, 4)), 2, 2, "mean")
    refused("saliency", cell_saliency, torch.zeros((1, 1, 4, 4)), 2, 2, "mean")
    refused("saliency", cell_saliency, torch.zeros((1, 0, 4)), 2, 2, "mean")
    refused("columns", cell_saliency, torch.zeros((1, 4, 4)), 0, 2, "mean")
    refused("reduction", cell_saliency, torch.zeros((1, 4, 4)), 2, 2, "sum")


def test_cells_are_those_of_the_grid_and_maps_of_integers_are_refused():
    saliency = torch.zeros(1, 47, 61)
    saliency[0, 33, 50] = 1.0
    expected = Grid(7, 5, (61, 47)).cell_of(torch.tensor([50.0, 33.0]))
    for reduction in ("mean", "max"):
        assert cell_saliency(saliency, 7, 5, reduction).argmax() == expected
    refused("saliency", cell_saliency, torch.zeros(1, 4, 4, dtype=torch.long), 2, 2)
