"""Shared by the tests of beliefs: random looks."""

import pytest
import torch

from semfov import Detections, Grid


@pytest.fixture
def random_looks():
    """Random looks at a grid: boxes overlap, some are padding, and the third look has no detections."""

    def make(grid=None, looks=4, most=5, components=5, seed=0, dtype=torch.float32):
        generator = torch.Generator().manual_seed(seed)
        width, height = (grid or Grid(6, 4, (90, 60))).extent.tolist()
        size = torch.tensor([width, height], dtype=dtype)

        def draw(*shape):
            return torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)

        corner = draw(looks, most, 2) * 0.7 * size
        boxes = torch.cat([corner, corner + (0.02 + 0.35 * draw(looks, most, 2)) * size], -1)
        mask = torch.arange(most) < torch.randint(1, most + 1, (looks, 1), generator=generator)
        mask[2:3] = False
        return Detections(boxes, (3 * draw(looks, most, components)).softmax(-1), mask)

    return make
