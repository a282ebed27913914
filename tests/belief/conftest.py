"""Shared by the tests of learned evidence: random looks."""

import pytest
import torch

from semfov import Detections, Grid, TargetEvidence
from semfov.belief.evidence import Gathered


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


@pytest.fixture
def toy_evidence():
    """A small model of target evidence with random parameters."""

    def make(components=5, widths=(8, 6), seed=1, metadata=None):
        generator = torch.Generator().manual_seed(seed)
        model = TargetEvidence(*widths, components=components, metadata=metadata)
        with torch.no_grad():
            for parameter in model.parameters():
                parameter.copy_(0.6 * torch.randn(parameter.shape, generator=generator))
        return model.eval()

    return make


@pytest.fixture
def gathered():
    """Random evidence gathered for some episodes and classes; the rows of an episode share their looks."""

    def make(episodes=2, classes=4, cells=24, seed=5, dtype=torch.float64):
        generator = torch.Generator().manual_seed(seed)

        def draw(*shape):
            return torch.randn(*shape, generator=generator, dtype=dtype)

        def of_class(values):
            return values.repeat_interleave(classes, 0)

        rows = episodes * classes
        nearest = 2 * draw(rows, cells)
        best, mean = nearest + draw(rows, cells).abs(), draw(rows, cells)
        distance, looks = of_class(draw(episodes, cells).abs() / 4), of_class(torch.arange(1, episodes + 1).to(dtype))
        visited = of_class(draw(episodes, cells) > 1)
        targets = torch.arange(1, classes + 1).repeat(episodes)
        return Gathered(nearest, best, mean, distance, draw(rows).sigmoid(), looks, visited, targets)

    return make
