"""A search of three fixations with two detections in each, for figures."""

import pytest
import torch

from semfov import Detections, Grid
from tests import small


@pytest.fixture
def scanpath():
    seen = Detections(
        torch.tensor([[[10.0, 10, 30, 30], [50, 40, 70, 55]]]),
        torch.tensor([[[0.1, 0.8, 0.1], [0.3, 0.1, 0.6]]]),
        torch.ones(1, 2, dtype=torch.bool),
    )
    grid, cells = Grid(4, 3, (80, 60)), torch.tensor([0, 6, 11])
    return small.scanpath(grid, cells, target=2, detections=(seen,) * 3, found=True)
